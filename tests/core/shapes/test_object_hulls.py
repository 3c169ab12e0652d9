"""Hulls of objects: one for each body, enclosing its Gaussians, stored in scene files as an optional feature."""

import dataclasses
import json
import zipfile

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.scene import cameras, scene_file
from r5dgs_core.scene.hull import Hull
from r5dgs_core.shapes import object_hulls, solid
from tests.support import contact_scenes, scenes, solid_gaussians


def mixed():
    """A scene in which Gaussians of the mug also rest, move with the apple, and move with the mug's shadow."""
    scene = scenes.make_scene(n=900)
    motions, mug = scene.gaussians.motion_ids.copy(), scene.object(1)
    motions[mug.start : mug.start + 60] = np.repeat([0, 2, 4], 20)
    rows = np.arange(mug.start, mug.start + mug.count)
    motions[rows] = np.sort(motions[rows])
    assert scene.groups[4].role == "shadow"
    return scene.with_arrays(motion_ids=motions)


def test_each_body_has_a_hull_and_shadows_and_foreign_motions_have_none():
    assert {(hull.object_id, hull.motion_id) for hull in object_hulls.of(mixed())} == {(1, 1), (2, 2), (3, 3)}


def test_a_resting_object_has_a_hull():
    scene = scenes.make_scene(n=300)
    ids = np.where(scene.gaussians.object_ids == 2, 0, scene.gaussians.motion_ids)
    scene = scene.with_arrays(motion_ids=ids.astype(np.int32))
    assert (2, 0) in {(hull.object_id, hull.motion_id) for hull in object_hulls.of(scene)}


def test_hulls_enclose_the_solid_gaussians_of_their_object():
    scene = scenes.make_scene(n=900)
    for hull in object_hulls.of(scene):
        assert 4 <= len(hull.vertices) <= 64
        rows = scene.gaussians.object_ids == hull.object_id
        means = scene.gaussians.means[rows & (scene.gaussians.opacity_logits > 0)]
        towards = np.random.default_rng(0).normal(size=(200, 3))
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        beyond = (means @ towards.T).max(0) - (hull.vertices @ towards.T).max(0)
        assert beyond.max() < 0.02


def box_scene():
    """A scene of a box of Gaussians, seen by one camera."""
    scene = contact_scenes.scene(contact_scenes.resting())
    rows = scene.gaussians.object_ids == 1
    box = solid_gaussians.box((0.5, 0.4, 0.3), int(rows.sum()))
    arrays = {name: getattr(scene.gaussians, name).copy() for name in ("means", "quats", "log_scales")}
    for name, values in zip(arrays, (box[0], box[1], np.log(box[2])), strict=True):
        arrays[name][rows] = values
    return dataclasses.replace(scene.with_arrays(**arrays), cameras=(cameras.resized(scene.cameras[0], 200),))


def test_boxes_are_as_large_as_in_pictures_with_their_low_pass_filter():
    coarse = box_scene()
    camera, place = coarse.cameras[0], coarse.gaussians.means[coarse.gaussians.object_ids == 1].mean(axis=0)
    depth = camera.T_cam_world[2, :3] @ place + camera.T_cam_world[2, 3]
    variance = 0.3 * (depth / camera.intrinsics[0, 0]) ** 2
    larger = 0.5 * np.log(np.exp(2 * coarse.gaussians.log_scales) + variance)
    filtered = dataclasses.replace(coarse.with_arrays(log_scales=larger.astype(np.float32)), cameras=())
    sharp = dataclasses.replace(coarse, cameras=())
    (first,), (second,), (small,) = (object_hulls.of(one) for one in (coarse, filtered, sharp))
    assert len(first.vertices) == len(small.vertices) == 8
    np.testing.assert_allclose(first.vertices, second.vertices, atol=1e-5)
    assert solid.of(small.vertices).volume < 0.98 * solid.of(first.vertices).volume


def test_hulls_are_an_optional_feature_of_scene_files(tmp_path):
    scene = scenes.make_scene(n=300)
    with_hulls = dataclasses.replace(scene, hulls=object_hulls.of(scene))
    path = scene_file.write(with_hulls, tmp_path / "hulls.r5dgs")
    with zipfile.ZipFile(path) as archive:
        tree = json.loads(archive.read("scene.json"))
    assert {"name": "hulls", "required": False, "since": "0.2.0"} in tree["features"]
    back = scene_file.read(path)
    for hull, stored in zip(with_hulls.hulls, back.hulls, strict=True):
        assert (hull.object_id, hull.motion_id) == (stored.object_id, stored.motion_id)
        np.testing.assert_allclose(stored.vertices, hull.vertices, atol=1e-6)
    assert scene_file.write(back, tmp_path / "again.r5dgs").read_bytes() == path.read_bytes()
    assert scene_file.read(scene_file.write(scene, tmp_path / "none.r5dgs")).hulls == ()


@pytest.mark.parametrize(
    ("hull", "message"),
    [
        (Hull(1, 1, np.zeros((65, 3))), "hull 0: expected vertices of shape"),
        (Hull(1, 1, np.zeros((3, 3))), "hull 0: expected vertices of shape"),
        (Hull(1, 1, np.full((4, 3), np.nan)), "hull 0: expected vertices up to"),
        (Hull(9, 1, np.zeros((4, 3))), "hull 0: expected the id of an object"),
        (Hull(1, 4, np.zeros((4, 3))), "hull 0: expected a motion group that is no shadow"),
        (Hull(1, -1, np.zeros((4, 3))), "hull 0: expected a motion group that is no shadow"),
    ],
)
def test_faulty_hulls_are_refused(tmp_path, hull, message):
    with pytest.raises(errors.SceneFileError, match=message):
        scene_file.write(dataclasses.replace(scenes.make_scene(n=60), hulls=(hull,)), tmp_path / "faulty.r5dgs")
