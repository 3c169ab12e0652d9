"""4dgs files, read back by the package fourdgs, and the way back to a scene."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from r5dgs_core import errors
from r5dgs_core.cli import main
from r5dgs_core.formats import fourdgs_file, fourdgs_reader, registry
from r5dgs_core.playback import played_splats
from r5dgs_core.playback.scene_player import Player
from r5dgs_core.scene import scene_file, spherical_harmonics
from tests.support import arms, scenes
from tests.support.command_line import complaint

fourdgs = pytest.importorskip("fourdgs", reason="fourdgs is not installed; it comes with the extra 'export'")

TIMES = (0.0, 0.021, 0.333, scenes.T_MAX, 0.79, 0.97, 1.21)
OPTIONS = registry.Options((0.0,), until=1.3)
PLACE = 2e-3  # positions are rounded to 2 % of the median size of a Gaussian


def written(scene, tmp_path, options=OPTIONS):
    (path,) = fourdgs_file.export(scene, tmp_path / "scene.4dgs", options)
    return fourdgs.read(str(path))


@pytest.mark.parametrize(
    "scene",
    [
        scenes.make_scene(n=300, objects=4, seed=3),
        scenes.make_scene(n=200, objects=2, sh_degree=3, world_convention="colmap"),
        arms.make_arm("hinge"),
    ],
    ids=["bodies", "harmonics", "hinge"],
)
def test_tracks_move_the_gaussians_as_playback_does(scene, tmp_path):
    found, shown = written(scene, tmp_path), Player(scene)
    names = {item.id: item.name for item in scene.objects}
    labels = {entry.object_id: entry.label for entry in found.objects.table.entries}
    assert set(labels.values()) <= set(names.values()) and names[1] in labels.values()
    frozen = shown.frame(scene.t_max)
    _, rows = cKDTree(frozen.means).query(found.gaussians.positions)
    assert len(set(rows)) == len(scene.gaussians.means)
    for member, row in zip(found.gaussians.object_id, rows, strict=True):
        own = int(scene.gaussians.object_ids[row])
        assert labels[int(member)] == names[own] if member else own == 0
    for t in TIMES:
        state = fourdgs.state_at_with_objects(found.gaussians, found.objects, t - scene.tracks.times[0])
        np.testing.assert_allclose(state["centers"], shown.frame(t).means[rows], atol=PLACE)
        quats = shown.frame(t).quats[rows][:, [1, 2, 3, 0]]
        assert np.abs((state["orientations"] * quats).sum(-1)).min() > 1 - 1e-4
    np.testing.assert_allclose(np.log(found.gaussians.scales), frozen.log_scales[rows], atol=0.01)


def test_import_gives_the_scene_back(tmp_path, capsys):
    scene = arms.make_arm("hinge", n=400, objects=4, sh_degree=2)
    source = scene_file.write(scene, tmp_path / "a.r5dgs", precision="exact")
    assert main.main(["export", str(source), "--to", "4dgs", "--out", str(tmp_path / "a.4dgs")]) == 0
    assert "lost here: colours other than those of t_max" in capsys.readouterr().out
    assert main.main(["import", str(tmp_path / "a.4dgs"), "--out", str(tmp_path / "b.r5dgs")]) == 0
    again = scene_file.read(tmp_path / "b.r5dgs")
    for name in ("name", "t_max", "frames_per_unit", "world_convention", "objects", "near_plane"):
        assert getattr(again, name) == getattr(scene, name), name
    assert [g.model.to_dict() for g in again.groups] == [g.model.to_dict() for g in scene.groups]
    np.testing.assert_array_equal(again.background_sh, scene.background_sh)
    np.testing.assert_allclose(again.tracks.poses, scene.tracks.poses, atol=1e-6)
    one, two = Player(scene), Player(again)
    key = np.stack([again.gaussians.object_ids, again.gaussians.motion_ids])
    np.testing.assert_array_equal(key, [scene.gaussians.object_ids, scene.gaussians.motion_ids])
    labels = 10.0 * key.T
    wanted = np.concatenate([scene.gaussians.means, labels], axis=1)
    _, rows = cKDTree(wanted).query(np.concatenate([again.gaussians.means, labels], axis=1))
    assert len(set(rows)) == len(rows)
    for t in TIMES:
        np.testing.assert_allclose(two.frame(t).means, one.frame(t).means[rows], atol=PLACE)
    frozen = played_splats.at(one, scene.t_max).sh[rows]
    assert np.abs(again.gaussians.sh[:, 1:] - frozen[:, 1:]).max() < 4.1 / 255
    rgb = [spherical_harmonics.dc_to_rgb(sh[:, 0]) for sh in (again.gaussians.sh, frozen)]
    np.testing.assert_allclose(rgb[0], rgb[1].clip(0, 1), atol=0.6 / 255)


def test_selected_objects_alone_are_written(scene, tmp_path):
    found = written(scene, tmp_path, registry.Options((0.0,), object_ids=frozenset({1, 3})))
    assert found.gaussians.count == scene.object(1).count + scene.object(3).count
    again = fourdgs_reader.read(tmp_path / "scene.4dgs")
    assert set(again.gaussians.object_ids) == {1, 3}


def test_foreign_damaged_and_empty_files_are_refused(scene, tmp_path, capsys):
    written(scene, tmp_path)
    path = tmp_path / "scene.4dgs"
    data = path.read_bytes()

    def refusal(changed):
        path.write_bytes(changed)
        with pytest.raises(errors.SceneFileError) as error:
            fourdgs_reader.read(path)
        return str(error.value)

    assert "cannot be read as 4dgs" in refusal(b"ply\n")
    assert "cannot be read as 4dgs" in refusal(data[: len(data) // 2])
    assert "none of its notes" in refusal(data.replace(b'"r5dgs 4dgs"', b'"r5dgs 5dgs"'))
    with pytest.raises(errors.ConfigError, match="expected Gaussians to export"):
        written(scene, tmp_path, registry.Options((0.0,), object_ids=frozenset({77})))
    with pytest.raises(errors.SceneFileError, match="cannot be written"):
        list(fourdgs_file.export(scene, tmp_path / "missing" / "a.4dgs", OPTIONS))
    assert [p.name for p in tmp_path.iterdir()] == ["scene.4dgs"]
    path.write_bytes(data)
    line = complaint(capsys, "import", path, "--out", tmp_path / "b.r5dgs", "--knots", "5", status=2)
    assert "--knots" in line


def test_absent_objects_have_a_window(tmp_path):
    scene = scenes.with_absence(scenes.make_scene(n=300), (-np.inf, 0.1), (0.6, np.inf))
    found = written(scene, tmp_path)
    names = {entry.object_id: entry.label for entry in found.objects.table.entries}
    own = np.array([names.get(int(member)) == scene.object(1).name for member in found.gaussians.object_id])
    shadow = int((scene.gaussians.motion_ids == 4).sum())
    assert found.gaussians.count == 300
    for t, there in ((0.0, False), (0.12, True), (0.59, True), (0.61, False), (1.2, False)):
        shown = np.zeros(300, bool)
        shown[fourdgs.state_at_with_objects(found.gaussians, found.objects, t)["indices"]] = True
        assert shown[own].all() == shown[own].any() == there
        assert (~shown).sum() == (0 if there else scene.object(1).count + shadow)
    again = fourdgs_reader.read(tmp_path / "scene.4dgs")
    assert [group.absent for group in again.groups] == [group.absent for group in scene.groups]
    twice = scenes.with_absence(scene, (0.1, 0.2))
    lost = "absence of objects between their first entry and their last exit"
    assert lost in fourdgs_file.losses(twice, OPTIONS) and lost not in fourdgs_file.losses(scene, OPTIONS)
