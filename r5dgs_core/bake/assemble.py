"""The draft of a scene from Gaussians in the bind state: rows sorted by object and group, objects, sky and cameras."""

from __future__ import annotations

import colorsys
import dataclasses

import numpy as np

from ..data.dataset import Dataset
from ..motion import rotations
from ..scene import spherical_harmonics
from ..scene.scene import NEAR_PLANE, Gaussians, Scene, SceneObject, Shading, Tracks
from . import bind_state, needs
from .draft import Cloud, Context, Draft, Need, ObservedScene


def draft(observed: ObservedScene, context: Context) -> Draft:
    """Return the scene with trained poses and static models, without motion of single Gaussians."""
    bound = bind_state.bind(observed, context)
    cloud, dataset, times = bound.cloud, context.dataset, observed.motion.times
    order = np.lexsort((cloud.motion_ids, cloud.object_ids))
    rank = np.argsort(order)
    groups = (
        dataclasses.replace(row, anchor_index=int(rank[row.anchor_index])) if row.anchor_index >= 0 else row
        for row in bound.groups
    )
    shaded = bool(context.config.train.shading) and context.wanted.shading != "off"
    sky = _background(context.tensors["background"].numpy(), context.wanted.sky_gradient)
    scene = Scene(
        name=dataset.name,
        gaussians=_gaussians(cloud, order),
        objects=_objects(cloud.object_ids[order], context.tensors["object_ids"].numpy(), dataset),
        groups=tuple(groups),
        tracks=Tracks(times=times.astype(np.float64), poses=bound.played),
        t_max=float(times[-1]),
        frames_per_unit=dataset.frames_per_unit,
        world_convention=dataset.world_convention,
        units=dataset.units,
        cameras=dataset.cameras,
        background_sh=sky.astype(np.float32),
        shading=_shading(cloud, order, observed.light) if shaded else None,
        near_plane=NEAR_PLANE * context.norm.scale,
        origin=dataset.origin,
    )
    return Draft(scene, observed, bound, order, Need("residuals", 0.0, 0.0, False, "nothing moves", False))


def _gaussians(cloud: Cloud, order: np.ndarray) -> Gaussians:
    return Gaussians(
        means=cloud.means[order].astype(np.float32),
        quats=rotations.normalize(cloud.quats[order]).astype(np.float32),
        log_scales=cloud.log_scales[order].astype(np.float32),
        opacity_logits=cloud.opacity_logits[order].astype(np.float32),
        sh=cloud.sh[order].astype(np.float32),
        object_ids=cloud.object_ids[order],
        motion_ids=cloud.motion_ids[order],
    )


def _shading(cloud: Cloud, order: np.ndarray, light: np.ndarray) -> Shading:
    rest = cloud.rest[order].astype(np.float32) if (cloud.rest != 1).any() else None
    return Shading(cloud.shading[order].astype(np.float32), light, rest)


def _background(coefficients: np.ndarray, wanted: str) -> np.ndarray:
    """Return the sky's coefficients without the highest degrees that an 8-bit image does not show (below half a level).

    Args:
        coefficients: Trained coefficients. [Kb, 3]
        wanted: User's override for the gradient: "on" keeps all degrees, "off" only the constant, "auto" measures.
    """
    if wanted != "auto":
        return coefficients if wanted == "on" else coefficients[:1]
    degree = spherical_harmonics.degree_of(len(coefficients))
    while degree > 0 and np.abs(coefficients[degree**2 :]).max() < needs.SKY_BAND:
        degree -= 1
        coefficients = coefficients[: (degree + 1) ** 2]
    return coefficients


def _objects(object_ids: np.ndarray, present: np.ndarray, dataset: Dataset) -> tuple[SceneObject, ...]:
    """Return the object table, sorted by id: unassigned Gaussians (if any), background, objects."""
    table = []
    ids = [-1] * bool((object_ids == -1).any()) + sorted({0, *(int(i) for i in present)})
    taken: set[str] = set()
    for object_id in ids:
        rows = np.flatnonzero(object_ids == object_id)
        start = int(rows[0]) if len(rows) else int(np.searchsorted(object_ids, object_id))
        default = {-1: "unassigned", 0: "background"}.get(object_id, f"object {object_id}")
        name = dataset.object_names.get(object_id, default)
        if name in taken:
            name = f"{name} {object_id}"
        taken.add(name)
        hue = object_id * 0.6180339887 % 1.0
        color = (0.5, 0.5, 0.5) if object_id <= 0 else colorsys.hls_to_rgb(hue, 0.55, 0.65 if object_id % 2 else 0.9)
        aliases = tuple(dataset.object_aliases.get(object_id, ()))
        table.append(SceneObject(object_id, name, aliases, "", color, start, len(rows)))
    return tuple(table)
