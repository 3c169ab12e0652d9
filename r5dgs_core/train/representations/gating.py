"""Selection of the Gaussians that a field moves: those on objects, all of them, or those that are found to move.

A Gaussian at rest is set to its mean state over the observed times and joins group 0, which the networks never process
again, as they would move Gaussians that they were not trained on. Its group is kept through splitting and in
checkpoints, so no other state is necessary. Gaussians that belong to no body but may move have the id after the last
group, `free_id`.

Notation: N Gaussians, R of them moved by the networks, S sampled times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...model.gaussians import Gaussians
from ...model.tracks import Tracks
from ...motion import rotations
from ...scene.sampling import spread
from .field_motion import FieldMotion

TURN = 0.1  # weight of differences of quaternions and log scales relative to distances in normalised units
SMOOTH = 1e-3  # smoothing of the distance from rest near 0, normalised units
SAMPLES = 9  # sampled times


def free_id(tracks: Tracks) -> int:
    """Return the motion id of Gaussians that may move but belong to no body: the one after bodies and shadows."""
    return tracks.groups


def mover_rule(bodies: int, config: Config) -> str:
    """Return ``field.movers``, with ``measured`` in place of ``labelled`` if there are no masks."""
    return "measured" if config.field.movers == "labelled" and bodies < 2 else config.field.movers


def movers(motion_ids: Tensor, bodies: int, times: np.ndarray, config: Config) -> Tensor:
    """Return the rows that the networks move; none at a single time or if ``needs.tracks`` is "off". [R] int64

    Args:
        motion_ids: Group of each Gaussian. [N]
        bodies: Number of bodies, including the background.
        times: The observed times. [S]
        config: The run's configuration.
    """
    if config.needs.tracks == "off" or len(times) < 2:
        return motion_ids.new_zeros(0, dtype=torch.int64)
    if mover_rule(bodies, config) == "all":
        return torch.arange(len(motion_ids), device=motion_ids.device)
    return (motion_ids > 0).nonzero()[:, 0]


def release_background(gaussians: Gaussians, tracks: Tracks, config: Config) -> None:
    """Let the networks also move Gaussians of the background, in place, if movers are measured."""
    if mover_rule(tracks.bodies, config) == "measured":
        gaussians.motion_ids[gaussians.motion_ids == 0] = free_id(tracks)


def rigid_groups(motion_ids: Tensor, tracks: Tracks, outside: int) -> Tensor:
    """Return motion groups, with ``outside`` for Gaussians that belong to no rigid group. [N]"""
    one = (motion_ids < free_id(tracks)) & ((motion_ids > 0) | (tracks.bodies > 1))
    return torch.where(one, motion_ids, outside)


def gate_step(config: Config) -> int:
    """Return the step after which Gaussians at rest are frozen, by ``field.gate`` but not before all times entered."""
    steps, section = config.train.iterations, config.field
    begun = max(section.tracks_share * steps, section.warm_up)
    return max(round(begun + section.gate * (steps - begun)), config.curriculum.steps(steps)[1])


def distance_from_rest(offsets: Tensor, quats: Tensor, log_scales: Tensor) -> Tensor:
    """Return the mean distance of Gaussians from their canonical state.

    The distance is not squared, so that Gaussians that no image moves come to rest exactly.

    Args:
        offsets: Offsets from the canonical centres. [R, 3]
        quats: Rotations applied after the canonical ones, unit wxyz. [R, 4]
        log_scales: Changes of the log scales. [R, 3]
    """
    rest = torch.zeros_like(quats)
    rest[:, 0] = 1.0
    change = torch.cat([offsets, TURN * (quats - rest), TURN * log_scales], dim=-1)
    return (change.square().sum(-1) + SMOOTH**2).sqrt().mean()


@dataclass(frozen=True)
class MeanState:
    """Mean state of Gaussians over some times.

    Attributes:
        offsets: Offset of the mean centre from the canonical one. [R, 3]
        quats: Rotation from the canonical to the mean orientation, unit wxyz. [R, 4]
        log_scales: Change from the canonical to the mean log scales. [R, 3]
        deviation: Upper bound of the displacement of any point of the one-sigma ellipsoid from the mean state. [R]
    """

    offsets: Tensor
    quats: Tensor
    log_scales: Tensor
    deviation: Tensor


@torch.no_grad()
def mean_state(motion: FieldMotion, means: Tensor, log_scales: Tensor, times: np.ndarray) -> MeanState:
    """Return the mean state of Gaussians over some times, and their deviation from it.

    Args:
        motion: Motion of the Gaussians.
        means: Canonical centres. [R, 3]
        log_scales: Canonical log scales. [R, 3]
        times: Scene times. [S]
    """
    states = [motion.at(means, float(t)) for t in times]
    offsets = torch.stack([s.offsets for s in states])
    sizes = torch.stack([s.log_scales for s in states])
    turns = torch.stack([s.quats for s in states])
    turns = torch.where((turns * turns[:1]).sum(-1, keepdim=True) < 0, -turns, turns)
    offset, size, turn = offsets.mean(0), sizes.mean(0), rotations.normalize(turns.mean(0))
    largest = (log_scales + size).max(-1).values.exp()
    angles = 2 * torch.acos((turns * turn).sum(-1).abs().clamp(max=1))
    growth = torch.expm1((sizes - size).abs().max(-1).values)
    deviations = (offsets - offset).norm(dim=-1) + largest * (angles + growth)
    return MeanState(offset, turn, size, deviations.max(0).values)


@torch.no_grad()
def freeze_resting(gaussians: Gaussians, rows: Tensor, motion: FieldMotion, times: np.ndarray, limit: float) -> Tensor:
    """Freeze Gaussians at rest in their mean state, in place.

    Args:
        gaussians: Changed in place.
        rows: Rows that the networks move. [R]
        motion: Motion of the Gaussians.
        times: The observed times.
        limit: Displacement below which a Gaussian is at rest, normalised units.

    Returns:
        Rows that were frozen. [<= R] int64
    """
    sampled = np.array(spread(times.tolist(), SAMPLES))
    found = mean_state(motion, gaussians.means[rows], gaussians.log_scales[rows], sampled)
    resting = found.deviation < limit
    chosen = rows[resting]
    gaussians.means[chosen] += found.offsets[resting]
    gaussians.quats[chosen] = rotations.multiply(found.quats[resting], gaussians.quats[chosen])
    gaussians.log_scales[chosen] += found.log_scales[resting]
    gaussians.motion_ids[chosen] = 0
    return chosen
