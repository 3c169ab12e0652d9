import dataclasses
import importlib
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core.data import dataset

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCENES = ("dining", "chessboard", "darkroom", "factory", "nonrigid")
LOOKS = (0.0, 0.25, 0.5, 0.75, 1.0)  # shares of the timeline at which objects must not touch


@pytest.fixture
def examples(monkeypatch):
    """The builders of `examples/` as modules, forgotten afterwards."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield importlib.import_module
    for name in [name for name in sys.modules if name.split(".")[0] in ("building", "rooms", "build_rooms")]:
        del sys.modules[name]


@pytest.fixture(params=SCENES)
def built(request, examples, blender):
    """A scene's name and its actors; the scene is the open file."""
    return request.param, examples("rooms").SCENES[request.param]()


def parts(actor):
    return [ob for ob in (actor.ob, *actor.ob.children_recursive) if ob.type == "MESH"]


def surface(blender, obs, depsgraph):
    """Search tree of all faces of some objects, and their bounding box, world frame."""
    from mathutils.bvhtree import BVHTree

    vertices, faces = [], []
    for ob in obs:
        evaluated = ob.evaluated_get(depsgraph)
        mesh = evaluated.to_mesh()
        first = len(vertices)
        vertices += [evaluated.matrix_world @ vertex.co for vertex in mesh.vertices]
        faces += [[first + index for index in polygon.vertices] for polygon in mesh.polygons]
        evaluated.to_mesh_clear()
    corners = np.array(vertices)
    return BVHTree.FromPolygons(vertices, faces), corners.min(axis=0), corners.max(axis=0)


def apart(a, b):
    (tree_a, low_a, high_a), (tree_b, low_b, high_b) = a, b
    return bool((low_a > high_b).any() or (low_b > high_a).any()) or not tree_a.overlap(tree_b)


def test_a_scene_has_its_objects_numbered_and_the_rest_is_background(built, blender):
    name, actors = built
    assert 5 <= len(actors) <= 12
    assert len({actor.ob.name for actor in actors}) == len(actors)
    assert all(parts(actor) for actor in actors)
    members = {part for actor in actors for part in parts(actor)}
    for number, actor in enumerate(actors, start=1):
        assert {part.pass_index for part in parts(actor)} == {number}, actor.ob.name
    assert {ob.pass_index for ob in blender.data.objects if ob.type == "MESH" and ob not in members} == {0}
    assert any(actor.law is None for actor in actors) and sum(actor.law is not None for actor in actors) >= 2


def test_objects_touch_neither_each_other_nor_the_room(built, blender):
    name, actors = built
    scene = blender.context.scene
    members = {part for actor in actors for part in parts(actor)}
    background = [ob for ob in scene.objects if ob.type == "MESH" and ob not in members]
    for share in LOOKS:
        scene.frame_set(round(scene.frame_start + share * (scene.frame_end - scene.frame_start)))
        depsgraph = blender.context.evaluated_depsgraph_get()
        surfaces = {actor.ob.name: surface(blender, parts(actor), depsgraph) for actor in actors}
        low = np.minimum.reduce([box[1] for box in surfaces.values()])
        room = importlib.import_module("rooms.room")
        assert (low > np.array(room.LOW) - 1e-6).all(), (name, share)
        assert (np.maximum.reduce([box[2] for box in surfaces.values()]) < room.HIGH).all(), (name, share)
        for a, b in itertools.combinations(surfaces, 2):
            assert apart(surfaces[a], surfaces[b]), f"{name}: {a} and {b} touch at t = {share}"
        standing = {ob.name: surface(blender, [ob], depsgraph) for ob in background}
        for a, b in itertools.product(surfaces, standing):
            assert apart(surfaces[a], standing[b]), f"{name}: {a} touches {b} at t = {share}"


def test_motion_is_smooth_from_the_first_frame_to_the_last(built, blender):
    """Third difference quotients grow with smaller steps if velocity or acceleration jumps, else they stay bounded."""
    name, _ = built
    compat = importlib.import_module("r5dgs.r5dgs_addon.compat")  # from 5.0 on curves lie deeper
    curves = [curve for ob in blender.data.objects for curve in compat.fcurves(ob)]
    assert curves
    for curve in curves:
        values = np.array([curve.evaluate(frame) for frame in range(1, 62)])
        fine, coarse = (
            np.abs(
                values[3 * step :] - 3 * values[2 * step : -step] + 3 * values[step : -2 * step] - values[: -3 * step]
            ).max()
            * (60 / step) ** 3
            for step in (1, 2)
        )
        assert fine < 1.1 * coarse + 1.0, (name, curve.id_data.name, curve.data_path, curve.array_index)  # 1: float32


def test_keyed_poses_match_the_laws_at_the_frames(built, blender):
    from mathutils import Matrix

    name, actors = built
    scene = blender.context.scene
    for share in LOOKS:
        scene.frame_set(round(scene.frame_start + share * (scene.frame_end - scene.frame_start)))
        for actor in (actor for actor in actors if actor.law is not None):
            place, turn = actor.law(share)
            pose = np.array(actor.ob.matrix_world)
            np.testing.assert_allclose(pose, Matrix.LocRotScale(place, turn, None), atol=1e-5, err_msg=actor.ob.name)


@pytest.mark.default_cases("dining", "nonrigid")
def test_most_views_show_every_object_large_enough_to_follow(built, examples, blender, tmp_path):
    name, actors = built
    script, stage = examples("build_rooms"), examples("building.stage")
    service = stage.capture_service()
    settings = script.room_settings(
        service, name, tmp_path / "set", size=64, samples=1, views=5, novel=0, frame_step=30
    )
    result = service.capture(blender.context, dataclasses.replace(settings, denoise=False, test_views=0))
    assert result.unseen == () and len(result.objects) == len(actors)
    views = dataset.read(tmp_path / "set").train
    assert len(views) == 10
    masks = np.stack([dataset.load_mask(view) for view in views])
    for number, actor in enumerate(actors, start=1):
        across = np.sqrt((masks == number).sum(axis=(1, 2)))  # pixels of 64
        assert np.median(across) >= 4.0 and (across > 0).mean() >= 0.8, (name, actor.ob.name, across.round(1))
