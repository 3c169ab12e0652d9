"""The command ``r5dgs export``."""

import dataclasses
import json
import os

import numpy as np
import pytest

from r5dgs_core.cli import main
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.data import transforms
from r5dgs_core.formats import ply, registry
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import cameras, scene_file
from tests.support.command_line import complaint


@pytest.fixture
def path(scene, tmp_path):
    return scene_file.write(scene, tmp_path / "scene.r5dgs", precision="exact")


def export(path, *arguments):
    return main.main(["export", str(path), *map(str, arguments)])


def test_ply_holds_the_gaussians_of_a_time(path, scene, tmp_path):
    out = tmp_path / "a.ply"
    for t in (0.3, scene.t_max + 0.4):
        assert export(path, "--to", "ply", "--out", out, "--time", t, "--overwrite") == 0
        frame, found = scene_player.Player(scene).frame(t), ply.read(out)
        np.testing.assert_array_equal(found.means, frame.means)
        np.testing.assert_allclose(found.quats, frame.quats, atol=1e-6)
        np.testing.assert_array_equal(found.object_ids, scene.gaussians.object_ids)


def test_without_a_time_the_gaussians_at_t_max_are_written(path, scene, tmp_path):
    assert export(path, "--to", "ply", "--out", tmp_path / "a.ply") == 0
    np.testing.assert_array_equal(ply.read(tmp_path / "a.ply").means, scene.gaussians.means)
    assert export(path, "--to", "ply", "--out", tmp_path / "b.ply", "--plain") == 0
    plain = ply.read(tmp_path / "b.ply")
    assert plain.object_ids is None and plain.identities is None
    np.testing.assert_array_equal(plain.means, scene.gaussians.means)


def test_each_frame_of_a_range_is_a_file(path, scene, tmp_path, capsys):
    arguments = ("--to", "ply", "--out", tmp_path / "a.ply", "--frames", "9:11", "--progress", "json")
    assert export(path, *arguments) == 0
    paths = [str(tmp_path / f"a_{number:04d}.ply") for number in (9, 10, 11)]
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["paths"] == paths
    means = scene_player.Player(scene).frame(9 / scene.frames_per_unit).means
    np.testing.assert_array_equal(ply.read(paths[1]).means, means)


def test_a_quantised_scene_stays_one_when_its_objects_are_named(path, tmp_path, capsys):
    out = tmp_path / "small.r5dgs"
    assert export(path, "--to", "r5dgs", "--out", out) == 0
    assert "not kept: the precision of the scene file" in capsys.readouterr().out
    assert out.stat().st_size < path.stat().st_size
    before = scene_file.read(out)
    assert main.main(["name", str(out), "2", "big apple"]) == 0
    after = scene_file.read(out)
    assert scene_file.precision_of(out) == "quantised" and after.object(2).name == "big apple"
    for name, array in before.arrays().items():
        np.testing.assert_array_equal(after.arrays()[name], array)


@pytest.mark.parametrize("words", ["", " , ", "not", "everything but"])
def test_words_that_name_no_object_are_wrong_usage_of_query_and_export(path, tmp_path, capsys, words):
    given = ("export", path, "--to", "ply", "--out", tmp_path / "a.ply", "--objects", words)
    for arguments in (given, ("query", path, words)):
        line = complaint(capsys, *arguments, status=ExitStatus.USAGE)
        assert "expected w" in line or "nothing to exclude after" in line


def test_objects_are_chosen_by_words(path, scene, tmp_path, capsys):
    assert export(path, "--to", "ply", "--out", tmp_path / "a.ply", "--objects", "cup and toy car") == 0
    assert set(ply.read(tmp_path / "a.ply").object_ids) == {1, 3}
    for words in ("zebra", "cup and zebra"):
        line = complaint(capsys, "export", path, "--to", "ply", "--out", tmp_path / "b.ply", "--objects", words)
        assert "zebra" in line and not (tmp_path / "b.ply").exists()


def test_an_unknown_excluded_object_is_named_with_the_option(path, tmp_path, capsys):
    words = "all except the zebra"
    line = complaint(capsys, "export", path, "--to", "ply", "--out", tmp_path / "a.ply", "--objects", words)
    assert line.startswith(f"r5dgs: --objects: {words!r} excludes an unknown object")


def test_a_folder_without_write_access_is_named_before_the_scene_is_read(path, tmp_path, capsys, monkeypatch):
    path.write_bytes(b"damaged")
    monkeypatch.setattr(os, "access", lambda folder, mode: folder != tmp_path)
    line = complaint(capsys, "export", path, "--to", "html", "--out", tmp_path / "a.html")
    assert f"--out {tmp_path / 'a.html'}: no write access to the folder {tmp_path}" in line
    line = complaint(capsys, "import", tmp_path, "--out", tmp_path / "a.r5dgs")
    assert f"{tmp_path / 'a.r5dgs'}: no write access to the folder {tmp_path}" in line


def test_cameras_are_those_of_the_scene(path, scene, tmp_path):
    out = tmp_path / "transforms_train.json"
    assert export(path, "--to", "cameras", "--out", out, "--frames", "1:2") == 0
    entries, _ = transforms.read(out)
    assert [entry.t for entry in entries] == pytest.approx([0, 0, 1 / 60, 1 / 60])
    assert entries[2].file_path == f"images/{scene.cameras[0].name}/0002.png"
    for entry, camera in zip(entries, scene.cameras * 2, strict=True):
        np.testing.assert_allclose(cameras.opengl_to_cam_world(entry.matrix), camera.T_cam_world, atol=1e-12)


def test_files_are_replaced_only_on_demand(path, tmp_path, capsys):
    (tmp_path / "a_0002.ply").write_text("mine")
    arguments = ("export", path, "--to", "ply", "--out", tmp_path / "a.ply", "--frames", "1:3")
    assert "a_0002.ply" in complaint(capsys, *arguments) and "--overwrite" in complaint(capsys, *arguments)
    assert (tmp_path / "a_0002.ply").read_text() == "mine" and not (tmp_path / "a_0001.ply").exists()
    assert main.main([*map(str, arguments), "--overwrite"]) == 0
    assert len(ply.read(tmp_path / "a_0002.ply").means) > 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--to", "unknown", "--out", "a.unknown"), "ply, cameras"),
        (("--to", "ply", "--out", "a.json"), ".ply"),
        (("--to", "cameras", "--out", "a.json", "--objects", "mug"), "--objects"),
        (("--to", "cameras", "--out", "a.json", "--plain"), "--plain"),
        (("--to", "r5dgs", "--out", "a.r5dgs", "--time", "1"), "--time: files of format r5dgs hold all times"),
        (("--to", "r5dgs", "--out", "a.r5dgs", "--until", "9"), "--until: files of format r5dgs hold all times"),
        (("--to", "ply", "--out", "a.ply", "--frames", "5:1"), "'5:1'"),
        (("--to", "ply", "--out", "a.ply", "--frames", "all"), "'all'"),
        (("--to", "ply", "--out", "a.ply", "--time", "nan"), "--time"),
        (("--to", "ply", "--out", "a.ply", "--time", "1", "--frames", "1:2"), "--time"),
    ],
)
def test_wrong_arguments_are_named(path, capsys, arguments, named):
    assert named in complaint(capsys, "export", path, *arguments, status=ExitStatus.USAGE)


@pytest.mark.parametrize(
    "arguments",
    [
        ("--to", "ply", "--time", "-3"),
        ("--to", "ply", "--frames=-3:2"),
        ("--to", "poses", "--time", "0.1,-3"),
    ],
)
def test_times_before_the_first_observed_one_are_refused(path, tmp_path, capsys, arguments):
    out = tmp_path / ("a.ply" if "ply" in arguments else "a.json")
    assert "from the first observed one" in complaint(capsys, "export", path, *arguments, "--out", out)
    assert not out.exists()


def test_losses_are_those_of_the_selected_objects(scene):
    bright = scene.gaussians.sh.copy()
    bright[scene.gaussians.object_ids == 3, 0] = 5.0
    bright = dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, sh=bright))
    count = int((scene.gaussians.object_ids == 3).sum())
    for ids, number in ((None, count), (frozenset({3}), count), (frozenset({1}), 0)):
        said = " ".join(registry.get("spz").losses(bright, registry.Options((scene.t_max,), object_ids=ids)))
        assert said == (f"{number} Gaussians have colours beyond the range of SPZ, which are clipped" if number else "")


def test_losses_are_in_the_event(path, tmp_path, capsys):
    assert export(path, "--to", "usd", "--out", tmp_path / "a.usd", "--progress", "json") == 0
    event = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert event["not_kept"] == registry.get("usd").loses and "the sky" in event["lost"]
