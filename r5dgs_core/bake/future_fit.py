"""Fit of the motion of bodies past t_max, with one gravity for falling bodies if the up axis is known."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from ..motion import torque_free_rotation
from ..motion.history import PoseErrors
from ..motion_fit import band as bands
from ..motion_fit import model_selection, pose_weights, shared_gravity
from ..motion_fit import noise as noises
from ..scene import visibility
from ..scene.scene import MotionGroup, Scene
from ..scene.splats import to_opacities
from ..scene.world_axes import UP_AXIS


def share_gravity(
    fits: dict[int, tuple[shared_gravity.BodyTrack, model_selection.Fit]], convention: str
) -> dict[int, model_selection.Fit]:
    """Return the fits, with one common acceleration for bodies that fall alike.

    Args:
        fits: Track and fit of each moving group, by group index.
        convention: World convention of the scene; gravity is shared only if its up axis is known.
    """
    shared = [fit for _, fit in fits.values()]
    if convention in UP_AXIS and fits:
        shared, _ = shared_gravity.share_acceleration(
            [track for track, _ in fits.values()], shared, UP_AXIS[convention]
        )
    return dict(zip(fits, shared, strict=True))


def fit(
    scene: Scene,
    group: int,
    observed: np.ndarray,
    poses: np.ndarray,
    noise: tuple[float, float],
    errors: PoseErrors | None,
) -> tuple[shared_gravity.BodyTrack, model_selection.Fit]:
    """Fit a body's motion past t_max and return its track and the fit.

    ``noise`` holds lower bounds of the noise of displacements and of rotations. Errors of the poses raise them, because
    a law must not follow errors that change slowly.
    """
    members = scene.gaussians.motion_ids == group
    opacities = to_opacities(scene.gaussians.opacity_logits[members])
    body = torque_free_rotation.inertia(scene.gaussians.means[members][visibility.seen(opacities)].astype(np.float64))
    radius, turns = scene.groups[group].model.radius, bool(np.any(poses[:, 1:4] != 0))
    known = pose_weights.from_errors(errors, observed, radius, turns, scene.groups[group].rigid_rms)
    noise = max(noise[0], known.noise[0]), max(noise[1], known.noise[1])
    track = shared_gravity.BodyTrack(scene.tracks.times, poses[:, :4], poses[:, 4:], known.weights)
    found = model_selection.fit(
        track.times,
        track.quats,
        track.displacements,
        radius=radius,
        weights=track.weights,
        inertia=body,
        least_noise=noises.of_images(radius, *noise),
        drift=known.drift,
        up=UP_AXIS.get(scene.world_convention),
    )
    return track, dataclasses.replace(found, history=dataclasses.replace(found.history, errors=errors))


def with_unknown_motion(
    groups: Sequence[MotionGroup], observed: np.ndarray, times: np.ndarray, fitted: Collection[int]
) -> tuple[MotionGroup, ...]:
    """Return the groups, with the band of an unknown motion for bodies that have too few poses for a fit.

    Args:
        groups: The motion groups.
        observed: Knots at which each group was placed. [G, S] bool
        times: Times of the knots. [S]
        fitted: Indices of the groups whose motion was fitted; without a band, fewer than two poses were usable.
    """
    found, span = list(groups), float(times[-1] - times[0])
    for group in groups:
        lost = group.id in fitted and group.history.band is None
        if group.role == "body" and span > 0 and (lost or observed[group.id].sum() < 2):
            band = bands.of_unknown_motion(float(times[-1]), span, group.model.radius)
            found[group.id] = dataclasses.replace(group, history=dataclasses.replace(group.history, band=band))
    return tuple(found)


def describe(chosen: model_selection.Fit | None) -> str:
    """Description of a body's motion past t_max."""
    if chosen is None:
        return "static"
    text = f"came to rest, {chosen.chosen}" if chosen.rested else chosen.chosen
    slips = [f"its rotation slipped at t={time:.2f}" for time in chosen.slips]
    return "; ".join(part for part in (text, *slips, chosen.history.text()) if part)
