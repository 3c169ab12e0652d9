"""Evidence of a body in images: rotation from texture, visibility from masks, presence from background images."""

import numpy as np
import pytest

from r5dgs_core.scene import cameras
from r5dgs_core.train import train_views
from r5dgs_core.train.initialization import evidence, triangulation
from tests.support import scenes

TIMES = np.linspace(0.0, 1.0, 5)
RADIUS = 0.5
BALL = 3


def ball_view(camera, t, center, paint, light=None, marked=True, shown=True, wall=(0.5, 0.5, 0.5)):
    """A view of a ball before a wall; ``paint`` gives the colours of normals [n, 3], ``light`` shades them."""
    rays = cameras.pixel_rays(camera)
    arm = np.asarray(center) - camera.center
    along = rays @ arm
    gap = RADIUS**2 - (arm @ arm - along**2)
    hit = (gap > 0) & shown
    image = np.tile(np.asarray(wall, np.float64), (*hit.shape, 1))
    normals = (camera.center + rays * (along - np.sqrt(np.maximum(gap, 0)))[..., None] - center)[hit] / RADIUS
    shade = 1.0 if light is None else np.clip(0.7 + 0.3 * normals @ np.asarray(light), 0, 1)[:, None]
    image[hit] = paint(normals) * shade
    mask = np.where(hit & marked, BALL, 0).astype(np.uint16)
    return train_views.of_arrays(
        "v", camera, float(t), np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), mask, None
    )


def plain(normals):
    return np.tile([0.8, 0.7, 0.2], (len(normals), 1))


def checkered(normals):
    cells = np.floor(4 * normals).astype(int).sum(1) % 2
    return np.where(cells[:, None] == 1, [0.8, 0.7, 0.2], [0.3, 0.2, 0.6])


def banded(normals):
    """Rings about the z axis: a turn about it does not show."""
    return 0.5 + np.sin(5 * normals[:, 2:]) * [0.3, 0.3, -0.2]


def ring(count=4):
    return [scenes.orbit_camera(2 * np.pi * k / count) for k in range(count)]


def stiffness(paint, light=None):
    seen = [ball_view(c, t, [0, 0, 0.3], paint, light) for t in TIMES for c in ring()]
    return evidence.turn_stiffness(seen, triangulation.locate(seen, TIMES, 5e-4), TIMES)[0]


def test_texture_leaves_rotations_free_and_its_absence_makes_them_stiff():
    for matrix in stiffness(checkered):
        assert np.linalg.eigvalsh(matrix)[-1] < 1.5
    for light in (None, [0.4, 0.3, 0.8]):  # shading is no texture: it stays as the ball turns
        for matrix in stiffness(plain, light):
            assert np.linalg.eigvalsh(matrix)[0] > 30


@pytest.mark.parametrize("paint", [checkered, banded, plain])
def test_long_captures_read_a_part_of_their_images(monkeypatch, paint):
    seen = [ball_view(c, t, [0, 0, 0.3], paint) for t in TIMES for c in ring(12)]
    places = triangulation.locate(seen, TIMES, 5e-4)
    expected = evidence.turn_stiffness(seen, places, TIMES)
    calls, change = [], evidence._change_per_turn
    monkeypatch.setattr(evidence, "_change_per_turn", lambda *a: calls.append(1) or change(*a))
    monkeypatch.setattr(evidence, "MAX_SAMPLE", 0)
    found = evidence.turn_stiffness(seen, places, TIMES)
    assert len(calls) == evidence.ENOUGH * len(TIMES)
    np.testing.assert_allclose(np.linalg.eigvalsh(found), np.linalg.eigvalsh(expected), rtol=0.2)


def test_a_body_that_few_cameras_of_a_long_capture_show_is_found_in_them(monkeypatch):
    seen = [ball_view(c, t, [0, 0, 0.3], checkered, shown=k in (3, 8)) for t in TIMES for k, c in enumerate(ring(12))]
    places = triangulation.locate(seen, TIMES, 5e-4)
    expected = evidence.turn_stiffness(seen, places, TIMES)
    monkeypatch.setattr(evidence, "MAX_SAMPLE", 0)
    np.testing.assert_allclose(evidence.turn_stiffness(seen, places, TIMES), expected, rtol=1e-9)


def test_an_invisible_rotation_is_stiff_only_about_its_own_axis():
    for matrix in stiffness(banded):
        values, axes = np.linalg.eigh(matrix)
        assert abs(axes[2, -1]) > 0.98 and values[-1] > 5 * values[1]


def test_stiffness_grows_as_less_is_visible_up_to_a_limit():
    found = evidence.shift_stiffness(np.array([[1.0, 0.5, 0.1, 0.0]]))[0]
    assert found.tolist() == [1.0, 2.0, 10.0, evidence.STIFFEST]


@pytest.mark.parametrize(("shown", "gone"), [(False, True), (True, False)])
def test_an_object_without_masks_is_absent_only_if_its_place_looks_empty(shown, gone):
    """Before time 0.5 no mask shows the ball: either it is absent, or it is not marked."""
    path = np.array([-0.8, 0.0, 0.3]) + TIMES[:, None] * np.array([1.6, 0.2, 0.0])
    seen = [
        ball_view(c, t, p, checkered, marked=t >= 0.5, shown=shown or t >= 0.5)
        for t, p in zip(TIMES, path, strict=True)
        for c in ring()
    ]
    places = triangulation.locate(seen, TIMES, 5e-4)
    assert places.measured[0].tolist() == [False, False, True, True, True]
    found = evidence.absent(seen, places, TIMES)
    assert found[0].tolist() == [gone, gone, False, False, False]


def test_an_unmarked_resting_object_is_not_absent():
    seen = [ball_view(c, t, [0, 0, 0.3], checkered, marked=t > 0.6) for t in TIMES for c in ring()]
    places = triangulation.locate(seen, TIMES, 5e-4)
    assert not evidence.absent(seen, places, TIMES).any()


def test_an_object_behind_another_or_out_of_the_frame_is_not_absent():
    hidden, outside = [], []
    for t in TIMES:
        for camera in ring():
            view = ball_view(camera, t, [0, 0, 0.3], checkered, marked=t > 0.3)
            cover = np.where(t > 0.3, view.mask, 7).astype(np.uint16)  # something else fills the picture
            hidden.append(view.with_arrays(mask=cover))
            outside.append(ball_view(camera, t, [0, 0, 0.3 if t > 0.3 else 9.0], checkered))
    for seen in (hidden, outside):
        places = triangulation.locate(seen, TIMES, 5e-4)
        row = places.object_ids.tolist().index(BALL)
        if seen is outside:
            places.centers[row, :2, 2] = 9.0
        assert not places.measured[row, :2].any()
        assert not evidence.absent(seen, places, TIMES)[row].any()
