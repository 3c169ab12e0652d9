"""Frames of films: cameras and times."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.film import camera_path, schedule
from r5dgs_core.film.settings import Settings
from r5dgs_core.scene import predictability
from r5dgs_core.scene.units import Units

FOLDER = Settings(Path("frames"))


def made(scene, **changes):
    return schedule.make(scene, dataclasses.replace(FOLDER, **changes))


def test_a_film_covers_the_observed_and_the_predicted_time(scene):
    plan = made(scene)
    times = [shot.t for shot in plan.shots]
    assert times[0] == scene.tracks.times[0] and times[-1] == predictability.horizon(scene) > scene.t_max
    assert [shot.number for shot in plan.shots] == list(range(1, len(times) + 1))
    assert np.ptp(np.diff(times)) < 1e-12 and plan.fps == 24
    assert len(times) == round(times[-1] * scene.frames_per_unit)


def test_a_film_is_in_real_time_if_the_unit_is_known(scene):
    plan = made(dataclasses.replace(scene, units=Units(seconds_per_unit=4.0)), time=(0.0, 0.5), fps=10.0)
    assert len(plan.shots) == 20


def test_a_moment_lasts_while_the_camera_moves_and_is_one_frame_otherwise(scene):
    plan = made(scene, time=(0.4, 0.4), camera=("orbit",))
    assert {shot.t for shot in plan.shots} == {0.4} and len(plan.shots) == 5 * 24
    assert len(made(scene, time=(0.4, 0.4)).shots) == 1
    assert len(made(scene, time=(0.4, 0.4), seconds=0.5).shots) == 12


def test_a_picture_shows_t_max_or_the_given_time(scene):
    for time, t in ((None, scene.t_max), ((1.5, 1.5), 1.5)):
        (shot,) = made(scene, out=Path("a.png"), time=time).shots
        assert shot.t == t and shot.camera.name == scene.cameras[0].name


def test_cameras_are_chosen_by_name_and_number(scene):
    for which in ("1", scene.cameras[1].name):
        assert made(scene, camera=(which,)).shots[-1].camera.name == scene.cameras[1].name
    plan = made(scene, camera=("0", "1"), seconds=1.0)
    np.testing.assert_allclose(plan.shots[-1].camera.T_cam_world, scene.cameras[1].T_cam_world, atol=1e-9)


@pytest.mark.parametrize(
    ("out", "size", "found"),
    [
        ("frames", None, (96, 72)),
        ("frames", (0, 48), (48, 36)),
        ("frames", (100, 51), (100, 51)),
        ("a.mp4", (0, 49), (48, 36)),
        ("a.mov", (0, 49), (49, 37)),
    ],
)
def test_pictures_have_the_size_that_is_asked_for(scene, out, size, found):
    (shot, *_) = made(scene, out=Path(out), size=size).shots
    assert (shot.camera.width, shot.camera.height) == found


def test_times_before_the_first_observed_one_are_outside(scene, monkeypatch):
    with pytest.raises(errors.ConfigError, match="--time -0.5: expected scene times from the first observed one, 0"):
        made(scene, time=(-0.5, 0.5))
    path = camera_path.lines([scene.cameras[0]] * 2, np.array([-1.0, 0.5]), None)
    monkeypatch.setattr(schedule.path_file, "read", lambda *_: path)
    with pytest.raises(errors.ConfigError, match="--camera path.json: 'render_time' -1: expected scene times"):
        made(scene, camera=("path.json",))
    with pytest.raises(errors.ConfigError, match="more than 100000"):
        made(scene, seconds=1e6)
    with pytest.raises(errors.ConfigError, match="--camera 7: expected 0 to 1"):
        made(scene, camera=("7",))
    with pytest.raises(errors.ConfigError, match=r"--camera back: .*; or orbit, or a camera path \(.json\)"):
        made(scene, camera=("back",))
    with pytest.raises(errors.ConfigError, match="--camera orbit: .*; orbits and camera paths are given alone"):
        made(scene, camera=("0", "orbit"))
