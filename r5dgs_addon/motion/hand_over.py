"""Hand-over of anchors to Blender's rigid bodies: proxies play the keys up to a frame, and are simulated after it.

A proxy is the convex hull of an object, with its origin at the centre of mass, as Bullet expects it. Up to the frame of
release it is animated (kinematic). Bullet then continues with the velocity of the last animated frames, so these move
with exactly the velocity to continue with. From the release on, the anchor copies the pose of a child of its proxy.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...r5dgs_core import errors
from ...r5dgs_core.formats import rigid_bodies
from ...r5dgs_core.motion import models, rotations
from ...r5dgs_core.scene import gravity
from ...r5dgs_core.shapes import solid
from .. import compat
from ..scene import hull_meshes, loaded_scenes, timeline
from . import curve_place, duplicate_delete, extrapolate, motion_fields, physics

NAME = "R5DGS Rigid Bodies"  # of the collection of proxies, and of the constraint of each anchor
FRAME = "r5dgs_release"  # custom property of the collection: frame of release
_BEFORE = "r5dgs_before_hand_over"  # of the Blender scene: its gravity before, and frames of the cache of its own world
_SUBSTEPS = 20  # per frame, in a world that is made here
_RAMP = 2  # animated frames before the release that move with the velocity to continue with
_STEP = 0.25  # frames between the poses from which the velocity of edited keys is taken
_FLAT = 1e-6  # volume of a hull over the cube of its size, below which it is flat
_NO_HULL = "expected enough Gaussians for a hull, found too few or flat ones; leave it out of the selection"


@dataclass(frozen=True)
class _Body:
    """An anchor to hand over, in the world of Blender, at the frame of release.

    Attributes:
        anchor: The anchor.
        corners: Vertices of its hull. [V, 3]
        velocity: Velocity of the anchor's origin per frame. [3]
        spin: Angular velocity, rad per frame. [3]
        matrices: Poses of the anchor at the frames up to the release. [F, 4, 4]
    """

    anchor: bpy.types.Object
    corners: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    matrices: np.ndarray


def proxies_of(scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """Collection of the proxies in a Blender scene, or None."""
    return next((one for one in scene.collection.children_recursive if FRAME in one), None)


def anchors_of(proxies: bpy.types.Collection) -> list[bpy.types.Object]:
    """Anchors that follow the proxies of a collection."""
    helpers = set(proxies.objects)
    bound = [obj for obj in bpy.data.objects if NAME in obj.constraints]
    return [obj for obj in bound if obj.constraints[NAME].target in helpers]


def hand_over(context: bpy.types.Context, anchors: Sequence[bpy.types.Object], frame: int) -> bpy.types.Collection:
    """Turn objects into rigid bodies from a frame on. Parts move with the object that carries them.

    Args:
        context: Context with the Blender scene.
        anchors: Anchors of loaded scenes. Those that follow another object, such as shadows, are left out.
        frame: Frame of release.

    Returns:
        The collection of the proxies.

    Raises:
        ConfigError: There is nothing to hand over, or an anchor has no hull or cannot be written. Nothing was changed,
            except that the remains of a hand-over whose collection was deleted are removed.
    """
    scene = context.scene
    if proxies_of(scene) is not None:
        raise errors.ConfigError("objects are rigid bodies already; bake them back to keys first")
    movers = dict.fromkeys(_carrier(anchor) for anchor in anchors)
    movers = [anchor for anchor in movers if physics.follow_matrix(anchor.r5dgs_motion) is None]
    if not movers:
        raise errors.ConfigError("expected an object with a motion of its own, found none in the selection")
    for anchor in movers:
        place = curve_place.find(anchor)
        if place.strip is not None:
            raise errors.ConfigError(f"{anchor.name}: its action is in the NLA; make it active again first")
    _clean(context)
    for anchor in movers:
        if NAME in anchor.constraints:
            raise errors.ConfigError(f"{anchor.name}: it is a rigid body in another Blender scene; bake it back there")
    with loaded_scenes.nothing_left_after_error():
        bodies = _bodies(context, movers, min(scene.frame_start, frame - _RAMP), frame)
        return _create(context, bodies, frame)


def remove_proxies(context: bpy.types.Context, proxies: bpy.types.Collection) -> None:
    """Remove the proxies and all that `hand_over` added; other rigid bodies of the scene are kept."""
    objects = list(proxies.objects)
    bpy.data.collections.remove(proxies)
    _delete(objects)
    _clean(context)


def _delete(proxies: Iterable[bpy.types.Object]) -> None:
    """Delete proxies and children of proxies with their meshes and actions."""
    objects = list(proxies)
    actions = [obj.animation_data.action for obj in objects if obj.animation_data and obj.animation_data.action]
    bpy.data.batch_remove([*objects, *(obj.data for obj in objects if obj.data is not None), *actions])


def _clean(context: bpy.types.Context) -> None:
    """Remove what belongs to no collection of proxies, and restore the Blender scene if it has none."""
    kept = {obj for scene in bpy.data.scenes if (proxies := proxies_of(scene)) for obj in proxies.objects}
    lost: set[bpy.types.Object] = set()
    for obj in bpy.data.objects:
        constraint = obj.constraints.get(NAME)
        if constraint is None or constraint.target in kept:
            continue
        if constraint.target is not None:  # the collection was deleted without its objects
            lost |= {constraint.target, constraint.target.parent} - {None}
        path = f'constraints["{NAME}"].influence'
        owned = compat.own_fcurves(obj, obj.name)
        for curve in [curve for curve in owned if curve.data_path == path]:
            owned.remove(curve)
        obj.constraints.remove(constraint)
    _delete(lost)
    if proxies_of(context.scene) is None and _BEFORE in context.scene:
        _restore(context)


def _restore(context: bpy.types.Context) -> None:
    """Restore the gravity of the Blender scene, and its rigid-body world as far as no other object uses it."""
    scene, before = context.scene, context.scene[_BEFORE].to_dict()
    del scene[_BEFORE]
    scene.gravity = before["gravity"]
    world = scene.rigidbody_world
    if world is not None and "cache" in before:
        world.point_cache.frame_start, world.point_cache.frame_end = before["cache"]
    elif world is not None and not (world.collection and len(world.collection.objects)):
        collection = world.collection
        with context.temp_override(scene=scene):
            bpy.ops.rigidbody.world_remove()
        if collection is not None:
            bpy.data.collections.remove(collection)


def _carrier(anchor: bpy.types.Object) -> bpy.types.Object:
    """The anchor that carries a part, or the anchor itself."""
    while anchor.parent is not None and anchor.parent.r5dgs.role == "ANCHOR":
        anchor = anchor.parent
    return anchor


def _bodies(context: bpy.types.Context, anchors: Sequence[bpy.types.Object], first: int, frame: int) -> list[_Body]:
    scene = context.scene
    now, subframe = scene.frame_current, scene.frame_subframe

    def at(when: float) -> list[np.ndarray]:
        scene.frame_set(int(np.floor(when)), subframe=float(when % 1))
        return [np.array(anchor.matrix_world) for anchor in anchors]

    try:
        later = [at(frame + k * _STEP) for k in (1, 2)]
        poses = [at(one) for one in range(first, frame + 1)]
        found = []
        for k, anchor in enumerate(anchors):
            corners = _corners(anchor)
            if len(corners) < 4:
                raise errors.ConfigError(f"{anchor.name}: {_NO_HULL}")
            keyed = [poses[-1][k], later[0][k], later[1][k]]
            velocity, spin = _learned_rates(anchor, frame) or _keyed_rates(keyed)
            found.append(_Body(anchor, corners, velocity, spin, np.array([one[k] for one in poses])))
        return found
    finally:
        scene.frame_set(now, subframe=subframe)


def _corners(anchor: bpy.types.Object) -> np.ndarray:
    """Vertices of the hulls of an anchor's own clouds, in the world, now. [V, 3]"""
    found = [np.zeros((0, 3))]
    for cloud in duplicate_delete.clouds_of(anchor):
        if cloud.r5dgs.object_id == anchor.r5dgs.object_id:
            matrix = np.array(cloud.matrix_world)
            found.append(hull_meshes.corners(cloud) @ matrix[:3, :3].T + matrix[:3, 3])
    return np.concatenate(found)


def _learned_rates(anchor: bpy.types.Object, frame: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Velocity and angular velocity per frame of the motion that wrote the keys; None before it or if edited."""
    times = extrapolate.times_of(anchor)
    span = times.time(frame) - times.t_max
    if span <= -1 / times.frames_per_unit or not physics.is_written(anchor) or physics.hand_edited(anchor, times):
        return None
    # The offset fades in after t_max: it corrects the last observed pose, and is no motion of the body.
    steady = replace(physics.model(physics.mover(anchor)), offset_rotvec=np.zeros(3), offset_displacement=np.zeros(3))
    _, _, spins, velocities = models.curve(steady, np.array([span]))
    parent = np.eye(4) if anchor.parent is None else np.array(anchor.parent.matrix_world)
    _, turn, _ = Matrix(parent).decompose()
    turn = np.array(turn.to_matrix())
    per = times.frames_per_unit
    return parent[:3, :3] @ velocities[0] / per, turn @ spins[0] / per


def _keyed_rates(matrices: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The same from a pose and those one and two steps later, by differences of second order."""
    places = [matrix[:3, 3] for matrix in matrices]
    quats = [np.array(Matrix(matrix).to_quaternion()) for matrix in matrices]
    once, twice = (rotations.quats_to_rotvecs(rotations.multiply(q, rotations.conjugate(quats[0]))) for q in quats[1:])
    return (4 * places[1] - 3 * places[0] - places[2]) / (2 * _STEP), (4 * once - twice) / (2 * _STEP)


def _create(context: bpy.types.Context, bodies: Sequence[_Body], frame: int) -> bpy.types.Collection:
    scene = context.scene
    proxies = bpy.data.collections.new(NAME)
    proxies[FRAME] = frame
    made = [_proxy(proxies, body) for body in bodies]  # before anything else that an error would have to undo
    scene.collection.children.link(proxies)
    before = {"gravity": list(scene.gravity)}
    if scene.rigidbody_world is None:
        bpy.ops.rigidbody.world_add()
        scene.rigidbody_world.substeps_per_frame = _SUBSTEPS
    else:
        cache = scene.rigidbody_world.point_cache
        before["cache"] = [cache.frame_start, cache.frame_end]
    scene[_BEFORE] = before
    world = scene.rigidbody_world
    cache = world.point_cache
    cache.frame_start, cache.frame_end = min(cache.frame_start, frame - _RAMP), max(cache.frame_end, scene.frame_end)
    _set_gravity(scene, bodies[0].anchor)
    drop = np.array(scene.gravity) * (scene.render.fps_base / scene.render.fps) ** 2  # per frame squared
    if not scene.use_gravity:
        drop = np.zeros(3)
    for body, (proxy, center) in zip(bodies, made, strict=True):
        with context.temp_override(object=proxy, active_object=proxy, selected_objects=[proxy]):
            bpy.ops.rigidbody.object_add(type="ACTIVE")
        _animate(proxy, body, center, frame, drop / (2 * world.substeps_per_frame))
        _follow(proxies, proxy, body, center, frame)
    context.view_layer.update()
    return proxies


def _set_gravity(scene: bpy.types.Scene, anchor: bpy.types.Object) -> None:
    """Set the gravity of the Blender scene to that of thrown bodies of the loaded scene; without any, keep it."""
    collection = extrapolate.scene_of(anchor)
    times = timeline.of_collection(collection)
    movers = [one for one in loaded_scenes.members(collection, "ANCHOR") if physics.has_motion(one)]
    free = [one for one in movers if physics.follow_matrix(one.r5dgs_motion) is None]
    parent = np.eye(4) if anchor.parent is None else np.array(anchor.parent.matrix_world)
    up = parent[2, :3] / np.linalg.norm(parent[2, :3])
    found = gravity.of_motions([physics.smooth(one) for one in free], up)
    if found is not None:
        scene.gravity = parent[:3, :3] @ found * motion_fields.units_per_second(times) ** 2


def _proxy(proxies: bpy.types.Collection, body: _Body) -> tuple[bpy.types.Object, np.ndarray]:
    """Create the proxy of a body, and return it with its centre of mass in the frame of the anchor. [3]"""
    name = f"{body.anchor.name.removesuffix(' anchor')} proxy"
    mesh = hull_meshes.new_mesh(name, body.corners)
    if mesh is None:
        raise errors.ConfigError(f"{body.anchor.name}: {_NO_HULL}")
    corners = np.array([[mesh.vertices[v].co for v in face.vertices] for face in mesh.polygons], np.float64)
    middle = corners.mean(axis=(0, 1))
    volume = abs(np.linalg.det(corners - middle).sum()) / 6
    if volume < _FLAT * np.ptp(corners, axis=(0, 1)).max() ** 3:
        raise errors.ConfigError(f"{body.anchor.name}: {_NO_HULL}")
    center = middle + solid.mass_properties(corners - middle)[1]
    place, turn, _ = Matrix(body.matrices[-1]).decompose()
    mesh.transform(turn.to_matrix().to_4x4().inverted() @ Matrix.Translation(-center))
    proxy = bpy.data.objects.new(name, mesh)
    proxies.objects.link(proxy)
    proxy.display_type, proxy.hide_render, proxy.rotation_mode = "WIRE", True, "QUATERNION"
    proxy["r5dgs_volume"] = volume
    return proxy, np.array(Matrix(body.matrices[-1]).inverted() @ Matrix.Translation(center))[:3, 3]


def _animate(proxy: bpy.types.Object, body: _Body, center: np.ndarray, frame: int, lag: np.ndarray) -> None:
    """Key a proxy up to the release, and make it dynamic after it.

    Bullet adds gravity before each substep moves the body, which advances it by ``lag`` per frame too far.
    """
    rigid = proxy.rigid_body
    rigid.collision_shape, rigid.mass = "CONVEX_HULL", max(rigid_bodies.DENSITY * proxy.pop("r5dgs_volume"), 1e-3)
    own, fitted = body.anchor.r5dgs_contact, physics.material(body.anchor)
    rigid.friction, rigid.restitution = fitted or (rigid.friction, rigid.restitution)
    if own.use_friction:
        rigid.friction = own.friction
    if own.use_bounciness:
        rigid.restitution = own.bounciness
    rigid.linear_damping = rigid.angular_damping = 0.0
    rigid.use_deactivation = False
    places = body.matrices[:, :3, :3] @ center + body.matrices[:, :3, 3]
    quats = np.array([Matrix(matrix).to_quaternion() for matrix in body.matrices])
    velocity = body.velocity + np.cross(body.spin, places[-1] - body.matrices[-1, :3, 3]) - lag
    for back in range(1, _RAMP + 1):
        places[-1 - back] = places[-1] - back * velocity
        quats[-1 - back] = rotations.multiply(rotations.rotvecs_to_quats(-back * body.spin), quats[-1])
    frames = frame + np.arange(1 - len(places), 1)
    owned, linear = compat.own_fcurves(proxy, proxy.name), compat.keyframe_enum("interpolation", "LINEAR")
    for path, values in (("location", places), ("rotation_quaternion", rotations.make_continuous(quats))):
        for index, column in enumerate(values.T):
            curve = owned.new(path, index=index)
            curve.keyframe_points.add(len(frames))
            curve.keyframe_points.foreach_set("co", np.stack([frames, column], axis=1).astype(np.float32).ravel())
            curve.keyframe_points.foreach_set("interpolation", np.full(len(frames), linear, np.int32))
            curve.update()
    for kinematic, when in ((True, frame), (False, frame + 1)):
        rigid.kinematic = kinematic
        proxy.keyframe_insert("rigid_body.kinematic", frame=when)


def _follow(
    proxies: bpy.types.Collection, proxy: bpy.types.Object, body: _Body, center: np.ndarray, frame: int
) -> None:
    """Let an anchor copy the pose of a child of its proxy from the release on."""
    pose = Matrix(body.matrices[-1])
    place = Matrix.LocRotScale(pose @ Vector(center), pose.to_quaternion(), None)
    helper = bpy.data.objects.new(f"{proxy.name} pose", None)
    proxies.objects.link(helper)
    helper.empty_display_size = 0.0
    helper.hide_viewport = helper.hide_render = True
    helper.parent, helper.matrix_basis = proxy, place.inverted() @ pose
    curve_place.make_own(body.anchor)
    constraint = body.anchor.constraints.new("COPY_TRANSFORMS")
    constraint.name, constraint.target = NAME, helper
    for influence, when in ((0.0, frame - 1), (1.0, frame)):
        constraint.influence = influence
        constraint.keyframe_insert("influence", frame=when)
    path = f'constraints["{NAME}"].influence'
    for curve in compat.fcurves(body.anchor):
        if curve.data_path == path:
            for point in curve.keyframe_points:
                point.interpolation = "CONSTANT"
