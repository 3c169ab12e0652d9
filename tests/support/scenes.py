"""Small, completely valid synthetic scenes for tests of playback, files, rendering and the add-on."""

from __future__ import annotations

import dataclasses

import numpy as np

from r5dgs_core.motion import models, rotations
from r5dgs_core.scene import cameras
from r5dgs_core.scene.scene import Gaussians, MotionGroup, Scene, SceneObject, Shading, Tracks

T_MAX = 0.75
TIMES = np.array([0.0, 0.05, 0.1, 0.17, 0.22, 0.3, 0.35, 0.4, 0.5, 0.55, 0.62, 0.68, T_MAX])
NAMES = ("mug", "red apple", "toy car", "lemon", "wooden block", "globe")
ALIASES = (("cup",), ("fruit",), ("vehicle", "racer"), ("citrus", "fruit"), (), ("earth", "sphere"))


def body_model(index: int, rng: np.random.Generator) -> models.MotionModel:
    """One of five smooth motions, in turn: thrown with spin, sliding, screw, hinge, static; offsets are small."""
    kind = index % 5
    small = {
        "offset_rotvec": rng.normal(scale=0.01, size=3),
        "offset_displacement": rng.normal(scale=0.003, size=3),
        "radius": 0.3,
    }
    if kind == 0:
        return models.MotionModel(
            "ballistic_spin",
            velocity=[0.5, 0.2, -0.4],
            acceleration=[0, 0, -1.5],
            angular_velocity=[0.4, -1.0, 2.0],
            angular_acceleration=[0.3, 0.1, -0.5],
            **small,
        )
    if kind == 1:
        return models.MotionModel("translation", velocity=[-0.4, 0.3, 0.0], acceleration=[0.2, 0.1, 0.0], radius=0.3)
    if kind == 2:
        return models.MotionModel("constant_twist", velocity=[0.0, 0.5, 0.1], angular_velocity=[0, 0, 1.5], **small)
    if kind == 3:
        return models.MotionModel("ballistic_spin", angular_velocity=[0, 3.0, 0], center_offset=[0.2, 0, 0.1], **small)
    return models.MotionModel(radius=0.3)


def make_scene(
    n: int = 600,
    objects: int = 3,
    seed: int = 0,
    *,
    sh_degree: int = 0,
    shadows: bool = True,
    shading: bool = True,
    identities: bool = True,
    unassigned: int = 2,
    world_convention: str = "blender",
) -> Scene:
    """A scene of n Gaussians: a floor, ``objects`` moving bodies, a shadow group for the first, some unassigned.

    Args:
        n: Gaussians in all; about a third are the floor.
        objects: Bodies; body k is object k and motion group k.
        seed: Of the random numbers.
        sh_degree: Of the colours.
        shadows: Add a motion group that follows body 1 and belongs to the background.
        shading: Add shading vectors and a light.
        identities: Add identity encodings.
        unassigned: Gaussians with object id -1, pinned.
        world_convention: Written into the scene.
    """
    rng = np.random.default_rng(seed)
    shadow_count = min(20, n // 10) if shadows and objects else 0
    floor_count = (n - unassigned - shadow_count) // 3 if objects else n - unassigned - shadow_count
    per_body = np.diff(np.linspace(0, n - unassigned - shadow_count - floor_count, objects + 1).astype(int))
    shadow_id = objects + 1

    angles = np.linspace(0, 2 * np.pi, objects, endpoint=False)
    centers = np.stack([np.cos(angles), np.sin(angles), np.full(objects, 0.4)], -1) if objects else np.zeros((0, 3))
    pieces = [(-1, 0, rng.uniform(-1, 1, (unassigned, 3)) + [0, 0, 1.2])]
    pieces.append((0, 0, rng.uniform(-2, 2, (floor_count, 3)) * [1, 1, 0]))
    pieces.append(
        (0, shadow_id, rng.normal(scale=0.15, size=(shadow_count, 3)) * [1, 1, 0.01] + centers[:1].sum(0) * [1, 1, 0])
    )
    for k, count in enumerate(per_body):
        pieces.append((k + 1, k + 1, centers[k] + rng.uniform(-0.25, 0.25, (count, 3))))
    means = np.concatenate([p for _, _, p in pieces]).astype(np.float32)
    object_ids = np.concatenate([np.full(len(p), o, np.int32) for o, _, p in pieces])
    motion_ids = np.concatenate([np.full(len(p), g, np.int32) for _, g, p in pieces])

    groups = [MotionGroup(0, 0, "pinned", 0 if n else -1, np.zeros(3), models.STATIC)]
    poses = [np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(TIMES), 1))]
    for k in range(objects):
        model = body_model(k, rng)
        quats, displacements, _, _ = models.curve(model, TIMES - T_MAX)
        poses.append(np.concatenate([rotations.normalize(quats), displacements], -1))
        rows = np.flatnonzero(motion_ids == k + 1)
        anchor = int(rows[np.argmin(np.linalg.norm(means[rows] - centers[k], axis=-1))]) if len(rows) else -1
        groups.append(MotionGroup(k + 1, k + 1, "body", anchor, centers[k], model, rigid_rms=0.001, rigid_max=0.004))
    if shadow_count:
        follow = np.diag([1.0, 1.0, 0.0])
        follow[0, 2] = 0.3
        shadow = np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(TIMES), 1))
        shadow[:, 4:] = poses[1][:, 4:] @ follow.T
        poses.append(shadow)
        anchor = int(np.flatnonzero(motion_ids == shadow_id)[0])
        pivot = centers[0] * [1, 1, 0]
        groups.append(MotionGroup(shadow_id, 1, "shadow", anchor, pivot, models.STATIC, 1, follow))

    table, start = [], 0
    for object_id in ([-1] if unassigned else []) + list(range(objects + 1)):
        count = int((object_ids == object_id).sum())
        name, aliases = ("unassigned", "background")[object_id + 1] if object_id < 1 else _name(object_id), ()
        if object_id >= 1:
            aliases = ALIASES[(object_id - 1) % len(ALIASES)]
        color = tuple(np.round(rng.uniform(0.1, 1, 3), 3).tolist())
        table.append(SceneObject(object_id, name, aliases, "", color, start, count))
        start += count
    light = np.array([0.3, -0.2, 1.0])
    return Scene(
        name="synthetic",
        gaussians=Gaussians(
            means=means,
            quats=rotations.normalize(rng.normal(size=(n, 4))).astype(np.float32),
            log_scales=np.log(rng.uniform(0.01, 0.06, (n, 3))).astype(np.float32),
            opacity_logits=rng.normal(2.0, 1.0, n).astype(np.float32),
            sh=rng.normal(
                scale=0.6 / (1 + np.arange((sh_degree + 1) ** 2))[None, :, None], size=(n, (sh_degree + 1) ** 2, 3)
            ).astype(np.float32),
            object_ids=object_ids,
            motion_ids=motion_ids,
            identities=rng.normal(size=(n, 16)).astype(np.float16) if identities else None,
        ),
        objects=tuple(table),
        groups=tuple(groups),
        tracks=Tracks(times=TIMES.copy(), poses=np.stack(poses)),
        t_max=T_MAX,
        frames_per_unit=60.0,
        world_convention=world_convention,
        cameras=(orbit_camera(0.3), orbit_camera(1.4)),
        background_sh=np.array([[0.9, 1.0, 1.2]], np.float32),
        shading=Shading((0.2 * rng.normal(size=(n, 3))).astype(np.float32), light / np.linalg.norm(light))
        if shading
        else None,
        provenance={"generator": "tests/scenes.py", "seed": seed},
        needs=({"name": "tracks", "value": 0.5, "threshold": 0.01, "decision": "on", "reason": "bodies move"},),
    )


def with_absence(scene: Scene, *absent: tuple[float, float], object_id: int = 1) -> Scene:
    """The scene with an object and its shadow absent at some times."""
    groups = (
        dataclasses.replace(group, absent=absent) if group.id and group.object_id == object_id else group
        for group in scene.groups
    )
    return dataclasses.replace(scene, groups=tuple(groups))


def orbit_camera(angle_rad: float, width: int = 96, height: int = 72) -> cameras.Camera:
    """A camera 4 units from the origin that looks at it from above, at an angle about the z axis."""
    position = np.array([3.5 * np.cos(angle_rad), 3.5 * np.sin(angle_rad), 2.0])
    return looking_camera(position, -position, 0.9, width, height, f"orbit_{angle_rad:.2f}")


def looking_camera(position, forward, angle_x_rad, width, height, name="", up=(0, 0, 1.0)) -> cameras.Camera:
    """A camera at a place that looks along a direction."""
    back = -np.asarray(forward, np.float64) / np.linalg.norm(forward)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], -1)
    matrix[:3, 3] = position
    return camera_from_field_of_view(matrix, angle_x_rad, width, height, name)


def _name(object_id: int) -> str:
    turn, index = divmod(object_id - 1, len(NAMES))
    return NAMES[index] if turn == 0 else f"{NAMES[index]} {turn + 1}"


def camera_from_field_of_view(
    matrix_world: np.ndarray, angle_x_rad: float, width: int, height: int, name: str = ""
) -> cameras.Camera:
    """A camera with square pixels from its pose (camera to world, OpenGL axes) and horizontal field of view."""
    focal = 0.5 * width / np.tan(0.5 * angle_x_rad)
    intrinsics = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]])
    return cameras.Camera(width, height, intrinsics, cameras.opengl_to_cam_world(matrix_world), name)
