"""Poses of objects: the three kinds of files by readers of other libraries, against playback and exact motions."""

from __future__ import annotations

import csv
import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from r5dgs_core.cli import main
from r5dgs_core.cli.commands import export
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.motion import history, models
from r5dgs_core.playback import object_poses
from r5dgs_core.playback.scene_player import Player
from r5dgs_core.scene import scene_file
from r5dgs_core.scene.units import Units
from tests.support import arms, scenes
from tests.support.command_line import complaint

TIMES = (0.0, 0.021, 0.333, scenes.T_MAX, 0.97, 1.21)
BAND = history.Band((scenes.T_MAX, 1.0, 1.5), (0.0, 0.1, 0.4), (0.0, 0.2, 0.3))


def with_band(scene):
    group = dataclasses.replace(scene.groups[1], history=history.History(band=BAND))
    return dataclasses.replace(scene, groups=(scene.groups[0], group, *scene.groups[2:]))


def write(scene, tmp_path, to, out, *arguments):
    source = scene_file.write(scene, tmp_path / "a.r5dgs", precision="exact")
    return main.main(["export", str(source), "--to", to, "--out", str(tmp_path / out), *arguments])


def columns(path):
    rows = csv.DictReader(line for line in path.read_text().splitlines() if not line.startswith("#"))
    return list(rows)


@pytest.mark.parametrize("scene", [scenes.make_scene(n=200, objects=4), arms.make_arm("hinge")], ids=["bodies", "arm"])
def test_poses_carry_the_gaussians_from_t_max(scene, tmp_path):
    given = ",".join(map(str, TIMES))
    assert write(scene, tmp_path, "poses", "a.json", "--time", given) == 0
    found = json.loads((tmp_path / "a.json").read_text())
    assert found["times"] == found["scene_times"] == list(TIMES)
    assert found["predicted"] == [t > scene.t_max for t in TIMES]
    frames = [Player(scene).frame(t) for t in TIMES]
    bodies = [group for group in scene.groups if group.role == "body"]
    assert len(found["objects"]) == len(bodies)
    last = TIMES.index(scene.t_max)
    for one, group in zip(found["objects"], bodies, strict=True):
        rows = scene.gaussians.motion_ids == group.id
        own = frames[last].means[rows] - one["positions"][last]
        assert one["id"] == group.object_id and one["quaternions_wxyz"][last] == [1, 0, 0, 0]
        for frame, place, quat in zip(frames, one["positions"], one["quaternions_wxyz"], strict=True):
            turn = Rotation.from_quat(quat, scalar_first=True)
            np.testing.assert_allclose(turn.apply(own) + place, frame.means[rows], atol=1e-5)


def test_velocities_are_those_of_the_motion_model_and_that_after_an_impact():
    scene = scenes.make_scene(n=200, objects=1, shadows=False)
    rates = {"velocity": [0.3, 0, -1.0], "acceleration": [0, 0, -6.0], "bounce_time": 0.08, "restitution": 0.7}
    group = dataclasses.replace(scene.groups[1], model=models.MotionModel("bounce", **rates, radius=0.3))
    falling = dataclasses.replace(scene, groups=(scene.groups[0], group))
    t_max, impact = scene.t_max, scene.t_max + 0.08
    (found,) = object_poses.at(falling, [t_max, t_max + 0.05, impact + 1e-9])
    np.testing.assert_allclose(found.velocities[0], [0.3, 0, -1.0], atol=1e-6)
    np.testing.assert_allclose(found.velocities[1], [0.3, 0, -1.3], atol=1e-6)
    np.testing.assert_allclose(found.velocities[2], [0.3, 0, 0.7 * 1.48], atol=1e-3)
    spin = models.MotionModel("constant_twist", angular_velocity=[0.2, -1.0, 1.5], radius=0.3)
    turning = dataclasses.replace(scene, groups=(scene.groups[0], dataclasses.replace(group, model=spin)))
    (found,) = object_poses.at(turning, [t_max, 1.1])
    np.testing.assert_allclose(found.angular_velocities, [[0.2, -1.0, 1.5]] * 2, atol=1e-6)


def test_an_object_at_rest_has_its_frame_at_the_centre_of_its_gaussians():
    scene = scenes.make_scene(n=120, objects=2, shadows=False)
    ids, poses = scene.gaussians.motion_ids % 2, scene.tracks.poses[:2]
    resting = dataclasses.replace(scene.with_arrays(motion_ids=ids, track_poses=poses), groups=scene.groups[:2])
    found = object_poses.at(resting, [0.1, 1.2])[1]
    item = scene.object(2)
    center = scene.gaussians.means[item.start : item.start + item.count].mean(0)
    np.testing.assert_allclose(found.positions, [center] * 2, atol=1e-6)
    assert found.group == 0 and not found.velocities.any() and np.isnan(found.half_widths).all()


def test_known_units_are_seconds_and_metres(tmp_path):
    plain = with_band(scenes.make_scene(n=100, objects=2))
    scene = dataclasses.replace(plain, units=Units(2.5, 0.4))
    (one, _), (wanted, _) = (object_poses.at(s, (0.3, 1.1)) for s in (scene, plain))
    assert write(scene, tmp_path, "poses_csv", "a.csv", "--time", "0.3,1.1", "--overwrite") == 0
    text = (tmp_path / "a.csv").read_text()
    assert "# time_unit: second\n# length_unit: metre\n" in text and "# frame: T_world_object: maps" in text
    past, future = columns(tmp_path / "a.csv")[:2]
    assert (past["name"], past["part"], past["predicted"], past["half_width"]) == ("mug", "", "0", "")
    assert float(future["time"]) == pytest.approx(2.75) and float(future["scene_time"]) == 1.1
    for names, values, factor in (
        (("x", "y", "z"), wanted.positions, 0.4),
        (("qw", "qx", "qy", "qz"), wanted.quats, 1),
        (("vx", "vy", "vz"), wanted.velocities, 0.4 / 2.5),
        (("wx", "wy", "wz"), wanted.angular_velocities, 1 / 2.5),
    ):
        np.testing.assert_allclose([float(future[name]) for name in names], factor * values[1], rtol=1e-9)
    assert float(future["half_width"]) == pytest.approx(0.4 * float(np.interp(1.1, BAND.times, BAND.half_width)))
    assert float(future["half_angle_rad"]) == pytest.approx(0.22) and future["band_level"] == "0.95"
    assert write(plain, tmp_path, "poses", "a.json", "--time", "1.1") == 0
    found = json.loads((tmp_path / "a.json").read_text())
    assert found["time_unit"] == "unit of scene time" and found["length_unit"] == "unit of the scene"
    np.testing.assert_allclose(found["objects"][0]["positions"], one.positions[1:])
    assert found["objects"][1]["half_widths"] == [None] and found["objects"][1]["band_level"] is None


def test_tum_has_a_file_for_each_object_and_part(tmp_path, capsys):
    scene = arms.make_arm("hinge", n=300, objects=3)
    assert write(scene, tmp_path, "tum", "a.txt", "--time", "1.1,0.2", "--progress", "json") == 0
    paths = json.loads(capsys.readouterr().out.splitlines()[-1])["paths"]
    assert len(paths) == 3 and paths[0].endswith("_part_1.txt")
    for path, one in zip(paths, object_poses.at(scene, (0.2, 1.1)), strict=True):
        table = np.loadtxt(path)
        np.testing.assert_array_equal(table[:, 0], [0.2, 1.1])
        np.testing.assert_allclose(table[:, 1:4], one.positions)
        turns = Rotation.from_quat(table[:, 4:]) * Rotation.from_quat(one.quats, scalar_first=True).inv()
        assert turns.magnitude().max() < 1e-7
    again = complaint(capsys, "export", tmp_path / "a.r5dgs", "--to", "tum", "--out", tmp_path / "a.txt")
    assert "a_" in again and "--overwrite" in again


def test_the_default_times_are_the_frames_up_to_the_end_of_the_prediction(tmp_path):
    scene = scenes.make_scene(n=100, objects=1)
    assert export.default_frames(scene) == (1, 61)
    assert write(scene, tmp_path, "poses_csv", "a.csv", "--objects", "mug") == 0
    assert [float(row["time"]) for row in columns(tmp_path / "a.csv")] == [k / 60 for k in range(61)]


def test_wrong_times_and_empty_selections_leave_no_file(tmp_path, capsys):
    scene = scenes.make_scene(n=100, objects=1)
    source = scene_file.write(scene, tmp_path / "a.r5dgs")

    def refusal(to, out, *arguments, status=ExitStatus.USAGE):
        given = ("export", source, "--to", to, "--out", tmp_path / out, *arguments)
        return complaint(capsys, *given, status=status)

    assert "hold one time" in refusal("ply", "a.ply", "--time", "0,1")
    assert "finite numbers" in refusal("poses", "a.json", "--time", "0,inf")
    assert "expected a number, or several" in refusal("poses", "a.json", "--time", "0,,1")
    assert "at most 1000000 frames" in refusal("poses", "a.json", "--frames", "1:9000000")
    assert "found none in the selection" in refusal(
        "poses", "a.json", "--objects", "background", status=ExitStatus.ERROR
    )
    (tmp_path / "locked").mkdir()
    (tmp_path / "locked" / "b.json").mkdir()
    assert "expected a file" in refusal("poses", "locked/b.json", status=ExitStatus.ERROR)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.r5dgs", "locked"]
