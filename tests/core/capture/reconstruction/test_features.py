"""Cameras from features of a drawn room, with exact poses."""

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.capture.reconstruction import features, reconstruct, recording
from r5dgs_core.capture.reconstruction.request import Request
from tests.support.room import Film, look_at, picture, pose_errors, textures

pytestmark = pytest.mark.heavy
SIZE = 320, 240
LENS = Lens("brown", 290.0, 290.0, 160.0, 120.0, (-0.1, 0.0, 0.0, 0.0))
WALLS = textures()


def fixed(count: int = 4) -> tuple[list[Film], list[np.ndarray]]:
    """Fixed cameras, in front of which a noisy square moves."""
    rng = np.random.default_rng(1)
    films, poses = [], []
    for k in range(count):
        angle = 0.3 * (k - 1.5)
        poses.append(look_at((1.2 * np.sin(angle), -0.3 + 0.1 * k, -1.2 * np.cos(angle)), (0.1 * k, 0.1, 1.5)))
        room = picture(LENS, SIZE, poses[-1], WALLS)
        frames = []
        for time in range(7):
            frames.append(room.copy())
            frames[-1][80:150, 40 * time : 40 * time + 50] = rng.integers(0, 255, (70, 50, 3))
        films.append(Film(f"cam{k}", frames, np.arange(7) / 10))
    return films, poses


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    films, poses = fixed()
    request = Request(shared_lens=True, distance=("cam0", "cam2", 1.5))
    found = reconstruct.reconstruct(films, request, tmp_path_factory.mktemp("work"))
    return films, request, poses, found


@pytest.mark.slow
def test_fixed_cameras_are_found_behind_moving_things(solved):
    _, _, poses, found = solved
    shifts, angles = pose_errors([camera.camera_to_world for camera in found.cameras], poses)
    assert shifts.max() < 0.05 and angles.max() < 0.5
    assert found.cameras[0].lens.fx == pytest.approx(LENS.fx, rel=0.03)
    apart = found.cameras[0].camera_to_world[:3, 3] - found.cameras[2].camera_to_world[:3, 3]
    assert np.linalg.norm(apart) * found.meters_per_unit == pytest.approx(1.5)
    assert found.world_convention == "blender" and len(found.points) > 100


@pytest.mark.slow
def test_the_same_images_give_the_same_cameras(solved, tmp_path):
    films, request, _, first = solved
    second = reconstruct.reconstruct(films, request, tmp_path / "work")
    points = first.points[:50]
    for a, b in zip(first.cameras, second.cameras, strict=True):
        pixels = [c.lens.project((points - c.camera_to_world[:3, 3]) @ c.camera_to_world[:3, :3]) for c in (a, b)]
        assert np.nanmax(np.abs(pixels[0] - pixels[1])) < 0.01


@pytest.mark.slow
def test_known_lenses_are_kept(tmp_path):
    films, poses = fixed()
    found = features.reconstruct(films, Request(lenses={film.name: LENS for film in films}), tmp_path / "work")
    shifts, angles = pose_errors([camera.camera_to_world for camera in found.cameras], poses)
    assert shifts.max() < 0.02 and angles.max() < 0.2
    assert found.cameras[0].lens.fx == LENS.fx and found.cameras[0].lens.coefficients[0] == -0.1


@pytest.mark.slow
def test_a_moving_camera_has_a_pose_for_each_frame(tmp_path):
    angles = np.linspace(-0.3, 0.3, 6)
    poses = [look_at((np.sin(a), -0.3, -np.cos(a)), (0.5 * np.sin(a), 0.1, 1.5)) for a in angles]
    film = Film("phone", [picture(LENS, SIZE, pose, WALLS) for pose in poses], np.arange(6) / 5)
    found = reconstruct.reconstruct([film], Request(moving=frozenset({"phone"})), tmp_path / "work")
    (camera,) = found.cameras
    assert camera.moves and [frame.path.stem for frame in camera.frames] == [f"{k:06d}" for k in range(6)]
    assert [frame.time for frame in camera.frames] == pytest.approx(list(film.times))
    shifts, turns = pose_errors([frame.camera_to_world for frame in camera.frames], poses)
    assert shifts.max() < 0.02 and turns.max() < 0.2


def test_cameras_that_cannot_be_connected_are_named_with_a_remedy(tmp_path):
    films, _ = fixed(3)
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (*SIZE[::-1], 3)).astype(np.uint8)] * 3
    films.append(Film("alone", noise, np.arange(3) / 10))
    with pytest.raises(errors.DatasetError, match=r"cameras alone \(.*match.*Remedy: film a ChArUco board"):
        features.reconstruct(films, Request(shared_lens=True), tmp_path / "work")


def test_a_shared_lens_needs_images_of_one_size(tmp_path):
    films = [
        Film("a", [np.zeros((8, 8, 3), np.uint8)], np.zeros(1)),
        Film("b", [np.zeros((8, 9, 3), np.uint8)], np.zeros(1)),
    ]
    with pytest.raises(errors.DatasetError, match="a shared lens: expected videos of one size"):
        features.reconstruct(films, Request(shared_lens=True), tmp_path / "work")


def test_moving_pixels_are_not_static():
    films, _ = fixed(1)
    still = recording.still(films[0])
    assert not still.static[90:140, 0:290].any() and still.static[:70].all() and still.static[165:].all()


def test_indices_are_spread_over_all_frames():
    assert recording.spread(100, 3) == [0, 50, 99] and recording.spread(2, 10) == [0, 1]
