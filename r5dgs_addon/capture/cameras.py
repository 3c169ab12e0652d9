"""Cameras of a capture: selection of the scene's cameras, generated rigs, and pose and intrinsics of each view."""

from __future__ import annotations

import fnmatch
import math
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...r5dgs_core import errors
from .overrides import Overrides
from .settings import CaptureSettings

RIGS = ("AUTO", "NONE", "ARC", "RING", "HEMISPHERE")
MIN_OWN_CAMERAS = 3  # fewer observed cameras do not constrain depth, so AUTO adds a rig


@dataclass(frozen=True)
class NamedCamera:
    """Camera with its name in the data set."""

    name: str
    camera: bpy.types.Object


@dataclass(frozen=True)
class Views:
    """Observed and novel cameras of a capture; disjoint."""

    observed: tuple[NamedCamera, ...]
    novel: tuple[NamedCamera, ...]


def choose(context: bpy.types.Context, settings: CaptureSettings, box: np.ndarray, overrides: Overrides) -> Views:
    """Select the scene's cameras and build the rig if needed.

    Args:
        context: Context whose scene holds the cameras.
        settings: Camera names and rig.
        box: Lowest and highest corner of the region that the rig should see. [2, 3]
        overrides: Records changes to cameras and removes the rig at the end.

    Returns:
        Views, at least one of them observed.

    Raises:
        ConfigError: No camera matches, a camera is not perspective, or the rig is invalid.
    """
    scene = context.scene
    cameras = sorted((ob for ob in scene.objects if ob.type == "CAMERA"), key=lambda ob: ob.name)
    novel = [ob for ob in cameras if _matches(ob, settings.novel)]
    rest = [ob for ob in cameras if ob not in novel]
    own_wanted = settings.observed != "" or settings.rig in ("AUTO", "NONE")
    observed = [ob for ob in rest if _matches(ob, settings.observed or "*")] if own_wanted else []
    rig = settings.rig
    if rig == "AUTO":
        rig = "ARC" if len(observed) < MIN_OWN_CAMERAS else "NONE"
        if rig == "ARC" and settings.observed == "":
            observed, novel = [], []
    if rig == "NONE" and not observed:
        wanted = f"named {settings.observed!r}" if settings.observed else "that is not novel"
        raise errors.ConfigError(
            f"capture.observed: expected at least one camera {wanted}, found none among {len(cameras)} cameras of the "
            "scene; add cameras or choose a rig"
        )
    views = Views(tuple(NamedCamera(ob.name, ob) for ob in observed), tuple(NamedCamera(ob.name, ob) for ob in novel))
    if rig != "NONE":
        built = _build_rig(context, settings, rig, box, overrides)
        views = Views(views.observed + built.observed, views.novel + built.novel)
    for view in (*views.observed, *views.novel):
        if view.camera.data.type != "PERSP":
            raise errors.ConfigError(
                f"camera {view.name!r}: expected a perspective camera, got {view.camera.data.type}; change its type or "
                "leave it out by name"
            )
        overrides.set(view.camera.data.dof, "use_dof", False)
    return views


def describe(context: bpy.types.Context, camera: bpy.types.Object, width: int, height: int) -> dict[str, Any]:
    """Pose and intrinsics of a camera at the scene's current frame.

    Args:
        context: Context with the evaluated scene.
        camera: Perspective camera.
        width: Image width in pixels.
        height: Image height in pixels.

    Returns:
        ``transform_matrix`` (camera to world, OpenGL axes, no scale), ``camera_angle_x`` in radians, and ``intrinsics``
        with ``fl_x fl_y cx cy`` in pixels from the upper left corner.
    """
    depsgraph = context.evaluated_depsgraph_get()
    evaluated = camera.evaluated_get(depsgraph)
    location, rotation, _ = evaluated.matrix_world.decompose()
    pose = Matrix.LocRotScale(location, rotation, None)
    projection = evaluated.calc_matrix_camera(depsgraph, x=width, y=height)
    focal = 0.5 * width * projection[0][0]
    intrinsics = {
        "fl_x": focal,
        "fl_y": 0.5 * height * projection[1][1],
        "cx": 0.5 * width * (1.0 - projection[0][2]),
        "cy": 0.5 * height * (1.0 + projection[1][2]),
    }
    angle = 2.0 * math.atan(0.5 * width / focal)
    return {"camera_angle_x": angle, "transform_matrix": [list(row) for row in pose], "intrinsics": intrinsics}


def rig_poses(
    kind: str,
    observed: int,
    novel: int,
    *,
    target: np.ndarray,
    radius: float,
    elevation_deg: float,
    elevation_spread_deg: float = 0.0,
    azimuth_deg: float = -90.0,
    arc_deg: float = 120.0,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Poses of a generated rig; novel views lie between observed ones.

    Args:
        kind: "ARC" (open, centred at the azimuth), "RING" (closed) or "HEMISPHERE" (spiral from the elevation upwards).
        observed: Number of observed views.
        novel: Number of novel views.
        target: Look-at point of all cameras. [3]
        radius: Distance of the cameras from the target.
        elevation_deg: Elevation above the target.
        elevation_spread_deg: Difference in elevation between observed neighbours on an arc or ring.
        azimuth_deg: Direction of the middle of an arc, or of a ring's first view, counter-clockwise from +X.
        arc_deg: Length of an arc.

    Returns:
        Camera-to-world matrices with OpenGL axes, observed and novel. [4, 4] each
    """
    angles: list[list[tuple[float, float]]] = [[], []]
    if kind == "HEMISPHERE":
        total = observed + novel
        novel_rows = {int((j + 0.5) * total / novel) for j in range(novel)}
        low = math.sin(math.radians(elevation_deg))
        for i in range(total):
            elevation = math.degrees(math.asin(low + (0.98 - low) * (i + 0.5) / total)) if low < 0.98 else elevation_deg
            angles[i in novel_rows].append((azimuth_deg + i * 137.50776, elevation))
    else:
        gaps = observed if kind == "RING" else max(observed - 1, 1)
        step = (360.0 if kind == "RING" else arc_deg) / gaps
        start = azimuth_deg if kind == "RING" or observed < 2 else azimuth_deg - 0.5 * arc_deg
        for i in range(observed):
            angles[0].append((start + i * step, elevation_deg + (i % 2 - 0.5) * elevation_spread_deg))
        for j in range(novel):
            gap = int((j + 0.5) * gaps / novel)
            share = 0.5 if novel <= gaps else ((j + 0.5) * gaps / novel) % 1.0
            angles[1].append((start + (gap + share) * step, elevation_deg))
    poses = [[_look_from(target, radius, azimuth, elevation) for azimuth, elevation in group] for group in angles]
    return poses[0], poses[1]


def _look_from(target: np.ndarray, radius: float, azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Camera-to-world matrix (OpenGL axes) of an upright camera that looks at the target. [4, 4]"""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(min(max(elevation_deg, -89.9), 89.9))
    back = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = np.asarray(target, np.float64) + radius * back
    return pose


def _matches(camera: bpy.types.Object, wanted: str) -> bool:
    """True if the camera's name, or a collection of it, matches a comma-separated list of patterns."""
    names = [camera.name, *(collection.name for collection in camera.users_collection)]
    patterns = [pattern.strip() for pattern in wanted.split(",") if pattern.strip()]
    return any(fnmatch.fnmatchcase(name.casefold(), pattern.casefold()) for name in names for pattern in patterns)


def _build_rig(
    context: bpy.types.Context, settings: CaptureSettings, kind: str, box: np.ndarray, overrides: Overrides
) -> Views:
    scene = context.scene
    if settings.rig_observed < 1:
        raise errors.ConfigError("capture.rig_observed: expected at least 1 camera for a rig, got 0")
    target = _target(settings.rig_target, box)
    fov = math.radians(settings.rig_fov_deg)
    aspect = settings.resolution_y / settings.resolution_x
    narrow = min(fov, 2.0 * math.atan(aspect * math.tan(0.5 * fov)))
    reach = max(0.5 * float(np.linalg.norm(box[1] - box[0])), 1e-3)
    radius = settings.rig_radius or 1.1 * reach / math.sin(0.5 * narrow)
    azimuth_deg, elevation_deg = settings.rig_azimuth_deg, settings.rig_elevation_deg
    if settings.rig == "AUTO" and scene.camera is not None:
        away = np.array(scene.camera.matrix_world.translation) - target
        if np.linalg.norm(away) > 1e-6:
            azimuth_deg = math.degrees(math.atan2(away[1], away[0]))
            elevation_deg = math.degrees(math.asin(away[2] / np.linalg.norm(away)))
    groups = rig_poses(
        kind,
        settings.rig_observed,
        settings.rig_novel,
        target=target,
        radius=radius,
        elevation_deg=elevation_deg,
        elevation_spread_deg=settings.rig_elevation_spread_deg,
        azimuth_deg=azimuth_deg,
        arc_deg=settings.rig_arc_deg,
    )
    views = []
    for prefix, poses in zip(("obs", "novel"), groups, strict=True):
        for index, pose in enumerate(poses):
            data = bpy.data.cameras.new(f"{prefix}{index}")
            overrides.callback(bpy.data.cameras.remove, data)  # removes the camera object, too
            data.sensor_fit = "HORIZONTAL"
            data.angle_x = fov
            data.clip_start, data.clip_end = radius * 1e-3, radius * 1e3
            camera = bpy.data.objects.new(f"{prefix}{index}", data)
            scene.collection.objects.link(camera)
            camera.matrix_world = Matrix(pose.tolist())
            views.append(NamedCamera(f"{prefix}{index}", camera))
    context.view_layer.update()
    return Views(tuple(views[: len(groups[0])]), tuple(views[len(groups[0]) :]))


def _target(wanted: str | tuple[float, float, float], box: np.ndarray) -> np.ndarray:
    if not isinstance(wanted, str):
        return np.array(wanted, np.float64)
    if wanted == "":
        return box.mean(axis=0)
    ob = bpy.data.objects.get(wanted)
    if ob is None:
        raise errors.ConfigError(f"capture.rig_target: there is no object {wanted!r} in this file")
    return np.array(ob.matrix_world.translation)
