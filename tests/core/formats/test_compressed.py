"""SPZ and SOG files, read back by splat-transform and gsply."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest
from scipy.spatial import cKDTree

from r5dgs_core import errors
from r5dgs_core.cli import main
from r5dgs_core.formats import ply, registry, sog, spz
from r5dgs_core.motion import rotations
from r5dgs_core.playback import played_splats
from r5dgs_core.playback.scene_player import Player
from r5dgs_core.scene import scene_file, spherical_harmonics
from tests.support import player, scenes
from tests.support.command_line import complaint

gsply = pytest.importorskip("gsply", reason="gsply is not installed; it comes with the extra 'export'")

T = 0.9
OPTIONS = registry.Options((T,))
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from z up
Y_DOWN = np.diag([1.0, -1, -1]) @ Y_UP


@pytest.fixture
def program(monkeypatch):
    player.put_splat_transform_on_path(monkeypatch)


def colors(sh, axes, direction):
    """Colours in a direction of the world of the scene, which the file's world is turned from."""
    return spherical_harmonics.to_rgb(np.asarray(sh, float), axes @ direction)


def assert_same(found, scene, axes, *, place, size, color, turn):
    """Compare splats in other axes with those of playback, in any order; tolerances by kind."""
    wanted = played_splats.at(Player(scene), T)
    distances, rows = cKDTree(wanted.means @ axes.T).query(found.means)
    assert distances.max() < place and len(set(rows)) == len(wanted.means)
    np.testing.assert_allclose(found.log_scales, wanted.log_scales[rows], atol=size)
    first, second = (rotations.quats_to_rotmats(q.astype(float)) for q in (found.quats, wanted.quats[rows]))
    assert np.abs((first * (axes @ second)).sum(1)).min() > 1 - turn  # columns are axes of ellipsoids, up to signs
    direction = np.array([0.6, -0.64, 0.48])
    mine = spherical_harmonics.to_rgb(wanted.sh[rows].astype(float), direction)
    error = np.abs(colors(found.sh, axes, direction) - mine)
    inside = (np.abs(wanted.sh[rows, 0]) < 3).all(-1) & (np.abs(wanted.sh[rows, 1:]) < 0.99).all((1, 2))
    assert inside.sum() > 20 and np.median(error[inside]) < color and error[inside].max() < 10 * color


def through_splat_transform(path, tmp_path):
    out = tmp_path / "read.ply"
    subprocess.run([player.splat_transform() / "splat-transform", "-q", "-w", "-g", "cpu", path, out], check=True)
    return ply.read(out)


@pytest.mark.parametrize("degree", [0, 3])
def test_gsply_reads_spz_with_y_up(tmp_path, degree):
    scene = scenes.make_scene(n=200, objects=2, sh_degree=degree)
    (path,) = spz.export(scene, tmp_path / "a.spz", OPTIONS)
    found = gsply.read_spz(path)
    rest = [found.shN] if degree else []
    sh = np.concatenate([found.sh0[:, None], *rest], axis=1)
    splats = played_splats.Splats(found.means, found.quats, found.scales, found.opacities, sh)
    assert_same(splats, scene, Y_UP, place=1e-5, size=0.04, color=0.03, turn=1e-4)
    wanted = played_splats.at(Player(scene), T)
    opacity = [1 / (1 + np.exp(-logits)) for logits in (found.opacities, wanted.opacity_logits)]
    np.testing.assert_allclose(*opacity, atol=0.005)


@pytest.mark.browser
def test_splat_transform_reads_spz(tmp_path):
    scene = scenes.make_scene(n=200, objects=2, sh_degree=3)
    (path,) = spz.export(scene, tmp_path / "a.spz", OPTIONS)
    found = through_splat_transform(path, tmp_path)  # a PLY with y down
    assert_same(found, scene, Y_DOWN, place=1e-5, size=0.04, color=0.03, turn=1e-4)


@pytest.mark.browser
def test_splat_transform_writes_sog_that_it_and_gsply_read(tmp_path, program):
    scene = scenes.make_scene(n=200, objects=2, world_convention="opengl")
    (path,) = sog.export(scene, tmp_path / "a.sog", OPTIONS)
    axes = np.diag([1.0, -1, -1])
    assert_same(through_splat_transform(path, tmp_path), scene, axes, place=1e-3, size=0.05, color=0.02, turn=1e-3)
    pytest.importorskip("imagecodecs", reason="imagecodecs, which gsply reads SOG with, is not installed")
    from gsply import sog_reader

    found = sog_reader.sogread(str(path))
    splats = played_splats.Splats(found.means, found.quats, found.scales, found.opacities, found.sh0[:, None])
    assert_same(splats, scene, axes, place=1e-3, size=0.05, color=0.02, turn=1e-3)
    assert [p.name for p in tmp_path.iterdir() if p.suffix == ".sog"] == ["a.sog"]


def test_each_frame_is_a_file_and_clipped_colours_are_told(tmp_path, capsys):
    scene = scenes.make_scene(n=100, objects=1)
    sh = scene.gaussians.sh.copy()
    sh[:5, 0] = 9
    source = scene_file.write(scene.with_arrays(sh=sh), tmp_path / "a.r5dgs", precision="exact")
    arguments = ["export", str(source), "--to", "spz", "--out", str(tmp_path / "a.spz"), "--frames", "3:4"]
    assert main.main(arguments) == 0
    assert "5 Gaussians have colours beyond the range of SPZ" in capsys.readouterr().out
    assert (tmp_path / "a_0003.spz").exists() and (tmp_path / "a_0004.spz").exists()
    arguments[-3:] = [str(tmp_path / "b.spz"), "--objects", "mug"]
    assert main.main(arguments) == 0
    assert len(gsply.read_spz(tmp_path / "b.spz").means) == scene.object(1).count


def late(tmp_path, n=120):
    """A scene whose mug enters at 0.123, and its file."""
    scene = scenes.with_absence(scenes.make_scene(n=n), (-np.inf, 0.123))
    return scene, scene_file.write(scene, tmp_path / "late.r5dgs", precision="exact")


@pytest.mark.parametrize("name", ["ply", "spz"])
def test_frames_without_any_selected_object_are_not_written(tmp_path, capsys, name):
    scene, source = late(tmp_path)
    arguments = ["export", str(source), "--to", name, "--out", str(tmp_path / f"a.{name}"), "--objects", "mug"]
    assert main.main([*arguments, "--frames", "1:12"]) == 0
    assert "8 frames from 1 to 8 are not written" in capsys.readouterr().out
    assert [p.name for p in sorted(tmp_path.glob(f"a*.{name}"))] == [f"a_{n:04d}.{name}" for n in range(9, 13)]
    for target in tmp_path.glob(f"a*.{name}"):
        found = gsply.read_spz(target) if name == "spz" else ply.read(target)
        assert len(found.means) == scene.object(1).count


@pytest.mark.parametrize("name", ["ply", "spz", "sog"])
def test_an_absent_selection_is_an_error_that_names_the_time_of_its_entry(tmp_path, capsys, name, monkeypatch):
    monkeypatch.setattr(sog.shutil, "which", lambda program: "found")
    _, source = late(tmp_path)
    given = ["export", source, "--to", name, "--out", tmp_path / f"a.{name}", "--objects", "mug"]
    assert "Gaussians at t = 0, but all selected objects are absent: mug enters at 0.12" in complaint(
        capsys, *given, "--time", 0
    )
    assert "Gaussians from t = 0 to 0.0333333" in complaint(capsys, *given, "--frames", "1:3")
    assert not list(tmp_path.glob(f"a*.{name}"))


def test_clipped_colours_are_counted_in_objects_that_enter(tmp_path):
    scene, _ = late(tmp_path)
    rows = np.flatnonzero(scene.gaussians.object_ids == 1)[:4]
    sh = scene.gaussians.sh.copy()
    sh[rows, 0] = 9
    told = [spz.losses(scene.with_arrays(sh=sh), registry.Options(times)) for times in ((0.0,), (0.0, 0.5))]
    assert told == [[], ["4 Gaussians have colours beyond the range of SPZ, which are clipped"]]


def test_errors_leave_no_file(scene, tmp_path, capsys, monkeypatch):
    source = scene_file.write(scene, tmp_path / "a.r5dgs")
    out = tmp_path / "out"
    out.mkdir()
    nothing = registry.Options((T,), object_ids=frozenset({77}))
    with pytest.raises(errors.ConfigError, match="expected Gaussians to export"):
        list(spz.export(scene, out / "a.spz", nothing))
    with pytest.raises(errors.SceneFileError, match="cannot be written"):
        list(spz.export(scene, out / "missing" / "a.spz", OPTIONS))
    far = scene.with_arrays(means=scene.gaussians.means + np.float32(1e8))
    with pytest.raises(errors.SceneFileError, match="SPZ holds positions up to"):
        list(spz.export(far, out / "a.spz", OPTIONS))
    bin_folder = tmp_path / "bin"
    bin_folder.mkdir()
    monkeypatch.setenv("PATH", str(bin_folder))
    given = ("export", source, "--to", "sog", "--out", out / "a.sog")
    assert "remedy: npm install -g @playcanvas/splat-transform" in complaint(capsys, *given)
    (bin_folder / "splat-transform").write_text("#!/bin/sh\necho first >&2\necho no space >&2\nexit 3\n")
    (bin_folder / "splat-transform").chmod(0o755)
    assert "splat-transform failed: no space" in complaint(capsys, *given)
    assert not list(out.iterdir())
