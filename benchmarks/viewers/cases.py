"""Scenes that test what viewers may get wrong, made of a scene with moving objects."""

from __future__ import annotations

import dataclasses

import numpy as np

from r5dgs_core.motion.history import Event, History
from r5dgs_core.playback.group_dynamics import knot_poses
from r5dgs_core.scene.scene import Scene

COPIES = 24  # 12,276 Gaussians of the demo become 294,624
_FAINT = 0.2  # largest coefficient of added harmonics


def demo(scene: Scene) -> Scene:
    """The scene itself."""
    return scene


def harmonics(scene: Scene) -> Scene:
    """Harmonics of degree 3 on all Gaussians, so that colours change as objects turn."""
    rng, count = np.random.default_rng(0), len(scene.gaussians.means)
    sh = np.zeros((count, 16, 3), np.float32)
    sh[:, 0] = scene.gaussians.sh[:, 0]
    sh[:, 1:] = rng.uniform(-_FAINT, _FAINT, (1, 15, 3))
    return dataclasses.replace(scene.with_arrays(sh=sh), shading=None)


def interpenetrating(scene: Scene) -> Scene:
    """The second moving object has its centre in the first one at t_max."""
    first, second = _bodies(scene)[:2]
    shift = scene.groups[first].pivot - scene.groups[second].pivot
    means = scene.gaussians.means.copy()
    means[scene.gaussians.motion_ids == second] += shift.astype(np.float32)
    groups = list(scene.groups)
    groups[second] = dataclasses.replace(groups[second], pivot=groups[second].pivot + shift)
    return dataclasses.replace(scene.with_arrays(means=means), groups=tuple(groups))


def impact(scene: Scene) -> Scene:
    """The first moving object reverses its motion in the middle of the observed time, between two knots apart."""
    group = _bodies(scene)[0]
    _, moves = knot_poses(scene)
    times = scene.tracks.times
    middle = 0.5 * (times[0] + times[-1])
    poses = scene.tracks.poses.copy()
    way = moves[group, 0] - moves[group, -1]
    poses[group, :, 4:] = np.abs(times - middle)[:, None] / (times[-1] - middle) * way - way
    hit = History((Event(float(middle), "impact", 1e-3),))
    groups = [dataclasses.replace(one, history=hit) if one.id == group else one for one in scene.groups]
    return dataclasses.replace(scene.with_arrays(track_poses=poses), groups=tuple(groups))


def large(scene: Scene) -> Scene:
    """Copies of each Gaussian beside it, smaller and fainter."""
    rng, gaussians = np.random.default_rng(0), scene.gaussians
    arrays = {
        name: np.repeat(values, COPIES, axis=0)
        for name, values in scene.arrays().items()
        if len(values) == len(gaussians.means) and name not in ("track_times",)
    }
    spread = np.exp(arrays["log_scales"]) * rng.normal(scale=0.7, size=arrays["means"].shape)
    arrays["means"] = (arrays["means"] + spread).astype(np.float32)
    arrays["log_scales"] = arrays["log_scales"] - np.float32(0.7)
    arrays["opacity_logits"] = arrays["opacity_logits"] - np.float32(1.5)
    objects = tuple(
        dataclasses.replace(item, start=item.start * COPIES, count=item.count * COPIES) for item in scene.objects
    )
    return dataclasses.replace(scene.with_arrays(**arrays), objects=objects)


def _bodies(scene: Scene) -> list[int]:
    """Groups of objects that move, those with the longest way first."""
    ways = np.linalg.norm(np.diff(scene.tracks.poses[..., 4:], axis=1), axis=-1).sum(1)
    return sorted((group.id for group in scene.groups if group.role == "body"), key=lambda g: -ways[g])


CASES = {"demo": demo, "harmonics": harmonics, "interpenetrating": interpenetrating, "impact": impact, "large": large}
