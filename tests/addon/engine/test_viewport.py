"""Rendered viewports and the live preview send requests without waiting, and the latest request wins."""

import importlib
import time

import numpy as np
import pytest

from r5dgs_core.scene import cameras, scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")


@pytest.fixture
def seen(blender, tmp_path, monkeypatch):
    """Return the visible scene of the camera at a frame."""
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    motions.load_again(blender, scene_file.write(scenes.make_scene(n=300), tmp_path / "scene.r5dgs"))
    render = blender.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 64, 40, 100

    def at(frame):
        blender.context.scene.frame_set(frame)
        return picture.shown(blender.context.evaluated_depsgraph_get())

    return at


@pytest.fixture
def viewport(blender):
    module = importlib.import_module("r5dgs.r5dgs_addon.engine.viewport")
    yield module
    module.forget()


def run(module):
    """Run the timer until nothing is left to do. Returns the shapes of the received images."""
    pictures, wait, deadline = [], 0.0, time.monotonic() + 120
    while wait is not None:
        assert time.monotonic() < deadline
        time.sleep(wait)
        wait = module.poll()
        for image in module._viewports:
            if image._pixels is not None and not any(image._pixels is known for known in pictures):
                pictures.append(image._pixels)
    return [pixels.shape for pixels in pictures]


def test_a_viewport_gets_a_small_picture_at_once_and_a_full_one_when_it_rests(blender, seen, viewport):
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    color = importlib.import_module("r5dgs.r5dgs_addon.color.display_to_linear")
    image, now = viewport.ViewportImage(), seen(20)
    image.request(viewport.ImageRequest(now, sky=True, transparent=False, moving_reduction=4))
    assert run(viewport) == [(10, 16, 4), (40, 64, 4)]
    expected = color.scene_linear(picture.render(now)[1]["color"])
    np.testing.assert_array_equal(image._pixels, expected[::-1])
    image.request(viewport.ImageRequest(seen(20), sky=True, transparent=False, moving_reduction=4))
    assert image.next() is None  # the same picture is not rendered again


def test_the_latest_request_wins(blender, seen, viewport):
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    color = importlib.import_module("r5dgs.r5dgs_addon.color.display_to_linear")
    image = viewport.ViewportImage()
    for frame in (1, 20, 40, 61):
        last = seen(frame)
        image.request(viewport.ImageRequest(last, sky=True, transparent=False, moving_reduction=1))
        viewport.poll()
    run(viewport)
    np.testing.assert_array_equal(image._pixels, color.scene_linear(picture.render(last)[1]["color"])[::-1])


def test_a_viewport_shows_render_errors_and_retries_after_a_change(blender, seen, viewport, tmp_path):
    image = viewport.ViewportImage()
    request = viewport.ImageRequest(seen(20), sky=True, transparent=False, moving_reduction=1)
    (tmp_path / "scene.r5dgs").rename(tmp_path / "gone.r5dgs")
    image.request(request)
    run(viewport)
    assert image._pixels is None and "scene.r5dgs" in image._message and image.next() is None
    (tmp_path / "gone.r5dgs").rename(tmp_path / "scene.r5dgs")
    image.request(viewport.ImageRequest(seen(21), sky=True, transparent=False, moving_reduction=1))
    run(viewport)
    assert image._pixels is not None and "Gaussians in" in image._message


def test_a_closed_viewport_is_not_waited_for(blender, seen, viewport):
    image = viewport.ViewportImage()
    image.request(viewport.ImageRequest(seen(20), sky=True, transparent=False, moving_reduction=1))
    assert viewport.poll() is not None
    del image
    run(viewport)
    assert viewport.poll() is None and len(viewport._viewports) == 0


def test_smaller_pictures_show_the_same_view(blender, seen, viewport):
    request = viewport.ImageRequest(seen(20), sky=True, transparent=False, moving_reduction=4)
    camera = request.requests(4)[-1][2]["camera"]
    small = cameras.Camera(
        camera["width"], camera["height"], np.array(camera["intrinsics"]), np.array(camera["T_cam_world"])
    )
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.testing.assert_allclose(4 * cameras.project(small, points)[0], cameras.project(request.camera, points)[0])


def test_the_live_preview_follows_frame_and_edits_and_is_off_after_loading(blender, seen):
    live = importlib.import_module("r5dgs.r5dgs_addon.engine.live_preview")
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")

    def look():
        live.poll()
        deadline = time.monotonic() + 120
        while live._job is not None:
            assert time.monotonic() < deadline
            time.sleep(live.poll())
        image = blender.data.images[picture.IMAGE]
        pixels = np.empty(4 * 64 * 40, np.float32)
        image.pixels.foreach_get(pixels)
        return pixels

    assert not blender.ops.r5dgs.live_preview.poll()  # there is no window
    live.start()
    try:
        seen(1)
        first = look()
        np.testing.assert_array_equal(look(), first)
        seen(40)
        later = look()
        assert np.abs(later - first).max() > 0.1
        blender.data.objects["mug"].hide_viewport = True
        assert np.abs(look() - later).max() > 0.1
        blender.context.scene.camera.data.type = "PANO"
        live.poll()
        assert "Perspective" in live.message() and live.running()
        blender.ops.wm.read_homefile(app_template="")
        assert not live.running() and live.message() == ""
    finally:
        live.stop()
