"""The benchmarks of whole frames, of harmonics and of backdrops: what is played, and what the rows hold."""

import dataclasses
import json

import numpy as np
import pytest

from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import validation
from tests.support import benchmark_modules


@pytest.fixture
def load(monkeypatch):
    """Imports a benchmark by name, see `benchmark_modules.importing`."""
    with benchmark_modules.importing(monkeypatch) as load:
        yield load


def test_the_scene_that_is_played_is_valid_and_its_bodies_move(load):
    frame_rate = load("frame_rate")
    camera = frame_rate.make_camera(64)
    scene = frame_rate.make_scene(300, 6, 1, 2, camera)
    validation.check(scene, "benchmark")
    for t in (0.2, 1.2):
        frame = scene_player.frame(scene, t)
        moved = np.linalg.norm(frame.means - scene.gaussians.means, axis=-1)
        assert (moved[:100] == 0).all() and (moved[100:] > 1e-3).all()
        assert len(np.unique(frame.motion_ids)) == 7
        output = scene_renderer.render_frame(scene, frame, camera)
        assert float(output.alpha.mean()) > 0.1


def test_bodies_in_the_room_are_small_and_before_walls_that_stay(load):
    frame_rate = load("frame_rate")
    camera = frame_rate.make_camera(64)
    scene = frame_rate.make_scene(500, 4, 1, 2, camera, kind="room", share=0.2)
    validation.check(scene, "benchmark")
    assert [one.count for one in scene.objects] == [400, 25, 25, 25, 25]
    walls = scene.gaussians.means[:400]
    assert (np.abs(walls).max(-1) == 1).all() and (walls.min(-1) >= -1).all()
    for one in scene.objects[1:]:
        ball = scene.gaussians.means[one.start : one.start + one.count]
        assert np.linalg.norm(ball - ball.mean(0), axis=-1).max() <= 2 * frame_rate.BALL
        assert ball[:, 2].max() < 0
    moved = np.linalg.norm(scene_player.frame(scene, 0.2).means - scene.gaussians.means, axis=-1)
    assert (moved[:400] == 0).all() and (moved[400:] > 1e-3).all()


@pytest.mark.parametrize("kind", ["cube", "room"])
def test_what_a_stage_is_sent_places_the_gaussians_as_playback_does(load, kind):
    frame_rate = load("frame_rate")
    scene = frame_rate.make_scene(300, 3, 0, 0, frame_rate.make_camera(32), kind=kind)
    for t in (0.3, 1.1):
        posed = scene_renderer.pose_instances(scene, frame_rate.instances_at(scene, t))
        np.testing.assert_allclose(posed.means, scene_player.frame(scene, t).means, atol=1e-6)


def test_a_picture_of_a_stage_that_differs_is_noticed(load):
    frame_rate = load("frame_rate")
    camera = frame_rate.make_camera(32)
    scene = frame_rate.make_scene(100, 2, 0, 0, camera)
    instances = frame_rate.instances_at(scene, 0.4)
    picture = scene_renderer.render_frame(scene, scene_renderer.pose_instances(scene, instances), camera)
    frame_rate.compare(picture, scene, instances, camera)
    with pytest.raises(AssertionError, match="alpha"):
        frame_rate.compare(dataclasses.replace(picture, alpha=picture.alpha * 0.999), scene, instances, camera)


def test_a_row_of_frames_splits_its_time(load, tmp_path, capsys):
    frame_rate, target = load("frame_rate"), tmp_path / "rows.json"
    options = ["--count", "200", "--size", "32", "--frames", "3", "--degrees", "0,0", "1,2", "--json", str(target)]
    frame_rate.main([*options, "--threads", "1,2"])
    rows = json.loads(target.read_text())
    assert [(r["threads"], r["sh_degree"], r["sky_degree"]) for r in rows] == [
        (1, 0, 0),
        (2, 0, 0),
        (1, 1, 2),
        (2, 1, 2),
    ]
    for row in rows:
        assert set(row) == set(frame_rate.COLUMNS)
        assert (row["kind"], row["share"]) == ("cube", 0.667)
        assert row["ms_motion"] + row["ms_colors"] + row["ms_raster"] == pytest.approx(row["ms_frame"], abs=2e-3)
        for rate, time in (("fps", "ms_frame"), ("fps_stage", "ms_stage")):
            assert row[rate] == pytest.approx(1e3 / row[time], rel=1e-2)
    assert len(capsys.readouterr().out.splitlines()) == 5


def test_kernels_and_plain_ways_take_the_same_work(load, tmp_path):
    harmonics, target = load("harmonics"), tmp_path / "rows.json"
    harmonics.main(["--count", "50", "--size", "16", "--turns", "1", "--json", str(target)])
    rows = json.loads(target.read_text())
    assert len(rows) == 3 * 3 * 2 and all(set(row) == set(harmonics.COLUMNS) for row in rows)
    assert all(row["ratio"] == 1 for row in rows if row["way"] == "kernel")
    for degree in (1, 2, 3):
        for work in (harmonics.colors(50, degree, True), harmonics.sky(16, degree, True)):
            plain = {**harmonics.colors(50, degree, False), **harmonics.sky(16, degree, False)}
            for name, function in work.items():
                if name != "forward_backward":
                    np.testing.assert_allclose(np.asarray(function()), np.asarray(plain[name]()), atol=2e-6)


def test_a_row_of_backdrops_says_how_much_of_the_image_what_moves_covers(load, tmp_path, capsys):
    backdrop, target = load("backdrop"), tmp_path / "rows.json"
    options = ["--workloads", "train", "--moving", "0,0.002,1", "--threads", "1", "--repeats", "1"]
    backdrop.main([*options, "--json", str(target)])
    rows = json.loads(target.read_text())
    assert all(list(row) == list(backdrop.COLUMNS) for row in rows)
    assert [(row["workload"], row["threads"], row["moving"]) for row in rows] == [
        ("train", 1, share) for share in (0, 0.002, 1)
    ]
    assert rows[0]["covered"] == 0 and 0 < rows[1]["covered"] < rows[2]["covered"] == 1
    for row in rows:
        assert row["ratio"] == pytest.approx(row["all_ms"] / row["backdrop_ms"], rel=2e-2)
    assert len(capsys.readouterr().out.splitlines()) == 4
