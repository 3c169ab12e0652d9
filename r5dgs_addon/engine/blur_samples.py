"""Samples of lens and shutter. The mean of their images has depth of field and motion blur, as in Cycles.

A sample is an image through one point of the lens at one time. Lens points follow a golden-angle spiral, times are
stratified over the shutter interval. Both are the same in every frame, so that still parts of an animation do not
flicker.
"""

import dataclasses
import math
from dataclasses import dataclass

import bpy
import numpy as np

from .view_cameras import ViewCamera

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class Lens:
    """Thin lens of a camera.

    Attributes:
        radii: Half width and half height of the aperture, world units. [2]
        focus: Distance of the plane in focus from the camera along the viewing direction, world units.
        blades: Number of blades, below 3 for an elliptic aperture.
        rotation: Rotation of the blades, rad.
    """

    radii: np.ndarray
    focus: float
    blades: int
    rotation: float


@dataclass(frozen=True)
class Sample:
    """Point of the aperture and time of an image.

    Attributes:
        point: Point of the unit disk. [2]
        time: Time in the shutter interval, from 0 (opens) to 1 (closes).
    """

    point: np.ndarray
    time: float


def are_needed(depsgraph: bpy.types.Depsgraph, camera: bpy.types.Object) -> bool:
    """True if the scene has motion blur or the camera depth of field."""
    return shutter_of(depsgraph.scene) is not None or lens_of(camera, depsgraph) is not None


def samples(count: int) -> list[Sample]:
    """Return evenly distributed samples; times and lens points are uncorrelated."""
    order = np.argsort(np.argsort([int(f"{i:032b}"[::-1], 2) for i in range(count)]))
    angles = _GOLDEN_ANGLE * np.arange(count)
    points = np.sqrt((np.arange(count) + 0.5) / count)[:, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
    return [Sample(point, float(time)) for point, time in zip(points, (order + 0.5) / count, strict=True)]


def lens_of(camera: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Lens | None:
    """Return the lens of a camera at the evaluated frame, or None if it has no depth of field."""
    evaluated = camera.evaluated_get(depsgraph)
    data, dof = evaluated.data, evaluated.data.dof
    focal = 1.0 if data.type == "ORTHO" else data.lens * 1e-3  # Blender counts millimetres as 1/1000 unit at any scale
    radius = focal / (2 * max(dof.aperture_fstop, 1e-5))
    focus = dof.focus_distance
    if dof.focus_object is not None:
        world = dof.focus_object.evaluated_get(depsgraph).matrix_world
        bone = dof.focus_object.pose.bones.get(dof.focus_subtarget) if dof.focus_object.pose is not None else None
        target = (world @ bone.matrix if bone is not None else world).translation
        backwards = evaluated.matrix_world.col[2].xyz.normalized()
        focus = abs((target - evaluated.matrix_world.translation).dot(backwards))
    if not dof.use_dof or focus <= 0:
        return None
    radii = radius * np.array([1 / dof.aperture_ratio, 1.0])
    return Lens(radii, focus, dof.aperture_blades, dof.aperture_rotation)


def shutter_of(scene: bpy.types.Scene) -> tuple[float, float] | None:
    """Times at which the shutter opens and closes, in frames from the rendered one, or None without motion blur."""
    render = scene.render
    if not render.use_motion_blur:
        return None
    opening = {"START": 0.0, "CENTER": -0.5, "END": -1.0}[render.motion_blur_position]
    return opening * render.motion_blur_shutter, (opening + 1) * render.motion_blur_shutter


def through_lens(view: ViewCamera, lens: Lens, point: np.ndarray) -> ViewCamera:
    """View through a point of the aperture; the plane in focus does not move in the image.

    Args:
        view: View through the middle of the lens.
        lens: The lens.
        point: Point of the unit disk, x to the right, y up. [2]
    """
    if lens.blades >= 3:  # scale the disk to the polygon
        wedge = 2 * math.pi / lens.blades
        angle = math.atan2(point[1], point[0]) % wedge - wedge / 2
        point = point * math.cos(wedge / 2) / math.cos(angle)
        cos, sin = math.cos(lens.rotation), math.sin(lens.rotation)
        point = np.array([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]])
    right, down = lens.radii * point * (1, -1)
    offset = np.array([right, down, 0.0])
    camera = view.camera
    matrix, intrinsics = camera.T_cam_world.copy(), camera.intrinsics.copy()
    # A parallel view is approximated from far away, and the same shift of the image needs a larger offset there.
    matrix[:3, 3] -= offset * (lens.focus + view.distance) / lens.focus
    intrinsics[:2, 2] += intrinsics[:2, :2] @ offset[:2] / lens.focus
    return dataclasses.replace(view, camera=dataclasses.replace(camera, intrinsics=intrinsics, T_cam_world=matrix))
