"""Loaded scenes for tests of motion: positions of their points and contents of their curves."""

import hashlib
import importlib
import pickle
from unittest import mock

import numpy as np

from r5dgs_core.playback import scene_player
from r5dgs_core.scene import cameras

POSITION_TOLERANCE = 1e-5  # of the scene's size: float32 in Blender and the tolerance of reduced keys
_REDUCED = {}  # curves by everything that `keyframes.curves` reads


def addon(name):
    """A module of the add-on."""
    return importlib.import_module(f"r5dgs.r5dgs_addon.{name}")


def load(bpy, path, **options):
    """Load a scene file; its collection."""
    before = set(bpy.data.collections)
    assert bpy.ops.r5dgs.load_scene(filepath=str(path), **options) == {"FINISHED"}
    return next(c for c in bpy.data.collections if c not in before and c.r5dgs.is_scene)


def load_again(bpy, path, **options):
    """`load` for fixtures: keys of a motion that another test has loaded are not reduced again.

    Reduction is most of the time of a small scene, and a function of its arguments only.
    """
    keyframes = addon("motion.keyframes")
    reduce = keyframes.curves

    def curves(*arguments):
        key = hashlib.blake2b(pickle.dumps(arguments)).digest()
        if key not in _REDUCED:
            _REDUCED[key] = reduce(*arguments)
        return _REDUCED[key]

    with mock.patch.object(keyframes, "curves", curves):
        return load(bpy, path, **options)


def choose(bpy, *objects):
    """Select objects, the last one active."""
    for obj in bpy.context.selected_objects:
        obj.select_set(False)
    for obj in objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = objects[-1]


def go_to(bpy, collection, t):
    """Set the frame of a scene time."""
    frame = collection.r5dgs.frame_zero + t * collection.r5dgs.frames_per_unit
    bpy.context.scene.frame_set(int(np.floor(frame)), subframe=float(frame % 1))


def matrix(bpy, obj):
    """World matrix of an object. [4, 4]"""
    return np.array(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world, np.float64)


def points(bpy, cloud):
    """World positions of the points of a cloud. [n, 3]"""
    evaluated = cloud.evaluated_get(bpy.context.evaluated_depsgraph_get())
    local = np.empty(3 * len(evaluated.data.points), np.float32)
    evaluated.data.attributes["position"].data.foreach_get("vector", local)
    world = np.array(evaluated.matrix_world, np.float64)
    return local.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]


def clouds(collection):
    """The point clouds of a loaded scene."""
    return [obj for obj in collection.all_objects if obj.r5dgs.role == "CLOUD"]


def all_points(bpy, collection, n):
    """World positions of the Gaussians of a loaded scene; NaN for those that no cloud holds. [n, 3]"""
    places = np.full((n, 3), np.nan)
    for cloud in clouds(collection):
        places[cloud.r5dgs.start : cloud.r5dgs.start + cloud.r5dgs.count] = points(bpy, cloud)
    return places


def offsets(bpy, collection, scene, t):
    """Distance of each Gaussian from its position in playback at a time, in sizes of the scene. [N]"""
    go_to(bpy, collection, t)
    expected = (
        scene_player.Player(scene).frame(t).means.astype(np.float64)
        @ cameras.WORLD_TO_BLENDER[scene.world_convention].T
    )
    return np.linalg.norm(all_points(bpy, collection, len(expected)) - expected, axis=-1) / scene.extent


def assert_plays_like_the_core(bpy, collection, scene, times, gone=()):
    """Assert that every Gaussian of a loaded scene matches playback, and that deleted groups have no points."""
    missing = np.isin(scene.gaussians.motion_ids, gone)
    for t in times:
        found = offsets(bpy, collection, scene, t)
        assert (found <= POSITION_TOLERANCE)[~missing].all() and np.isnan(found[missing]).all(), f"t = {t}"


def curves(anchor):
    """F-curves by path and component."""
    return {(curve.data_path, curve.array_index): curve for curve in addon("compat").fcurves(anchor)}


def keys(anchor, until=np.inf):
    """Stored data of an anchor's keys up to a frame, by path and component; of the last key only the left side."""
    found = {}
    for name, curve in curves(anchor).items():
        rows = [point for point in curve.keyframe_points if point.co[0] <= until + 1e-3]
        found[name] = [
            (tuple(p.co), tuple(p.handle_left), p.type)
            + ((tuple(p.handle_right), p.interpolation) if p is not rows[-1] else ())
            for p in rows
        ]
    return found
