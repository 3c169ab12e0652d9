"""Which Gaussians a field moves: those on objects, all of them, or those that are found to move.

A Gaussian that is found to rest is folded into its mean state over the observed times and joins group 0, which the
networks never see again: applied to what they were not trained on, networks move it. Its group travels with a Gaussian
through splitting and checkpoints, so no other state is needed. One that belongs to no body and may move all the same
carries the id after the last group, `free_id`.

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
from .field_motion import Motion

TURN = 0.1  # of a difference of quaternions or log scales beside a distance in normalised units
SMOOTH = 1e-3  # distance below which the distance from rest is smoothed
SAMPLES = 9  # times at which displacements are looked at


def free_id(tracks: Tracks) -> int:
    """Motion id of Gaussians that may move and belong to no body: the one after the bodies and their shadows."""
    return tracks.groups


def kind(bodies: int, config: Config) -> str:
    """Which Gaussians move: ``field.movers``, or ``measured`` where it is ``labelled`` and no mask labels anything."""
    return "measured" if config.field.movers == "labelled" and bodies < 2 else config.field.movers


def movers(motion_ids: Tensor, bodies: int, times: np.ndarray, config: Config) -> Tensor:
    """Rows that the networks move; none at a single time, and where the user says that nothing does. [R] int64

    Args:
        motion_ids: Group of each Gaussian. [N]
        bodies: Bodies, the background included.
        times: The observed times. [S]
        config: The run's configuration.
    """
    if config.needs.tracks == "off" or len(times) < 2:
        return torch.zeros(0, dtype=torch.int64)
    if kind(bodies, config) == "all":
        return torch.arange(len(motion_ids))
    return (motion_ids > 0).nonzero()[:, 0]


def release(gaussians: Gaussians, tracks: Tracks, config: Config) -> None:
    """Let the networks move what is on no object too, in place, where movers are measured."""
    if kind(tracks.bodies, config) == "measured":
        gaussians.motion_ids[gaussians.motion_ids == 0] = free_id(tracks)


def bodies_of(motion_ids: Tensor, tracks: Tracks, outside: int) -> Tensor:
    """Motion groups, with ``outside`` for Gaussians that are in none that moves as one. [N]"""
    one = (motion_ids < free_id(tracks)) & ((motion_ids > 0) | (tracks.bodies > 1))
    return torch.where(one, motion_ids, outside)


def gate_step(config: Config) -> int:
    """Step after which resting Gaussians are set still: a share of the field's run, once all times take part."""
    steps, section = config.train.iterations, config.field
    begun = max(section.tracks_share * steps, section.warm_up)
    return max(round(begun + section.gate * (steps - begun)), config.curriculum.steps(steps)[1])


def restlessness(offsets: Tensor, quats: Tensor, log_scales: Tensor) -> Tensor:
    """Mean distance of Gaussians from their canonical state, by the distance itself: what no image moves comes to rest.

    Args:
        offsets: From the canonical centres. [R, 3]
        quats: After the canonical rotations, unit wxyz. [R, 4]
        log_scales: Added to the canonical ones. [R, 3]
    """
    rest = torch.tensor([1.0, 0.0, 0.0, 0.0])
    change = torch.cat([offsets, TURN * (quats - rest), TURN * log_scales], dim=-1)
    return (change.square().sum(-1) + SMOOTH**2).sqrt().mean()


@dataclass(frozen=True)
class Rest:
    """Gaussians about their mean state over some times.

    Attributes:
        offsets: From the canonical centre to the mean one. [R, 3]
        quats: From the canonical rotation to the mean one, unit wxyz. [R, 4]
        log_scales: From the canonical log scales to the mean ones. [R, 3]
        unrest: Largest distance by which any point of the one-sigma ellipsoid may leave its place in that state. [R]
    """

    offsets: Tensor
    quats: Tensor
    log_scales: Tensor
    unrest: Tensor


@torch.no_grad()
def rest(motion: Motion, means: Tensor, log_scales: Tensor, times: np.ndarray) -> Rest:
    """Mean state of Gaussians over some times, and how far they leave it.

    Args:
        motion: Moves them.
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
    unrest = (offsets - offset).norm(dim=-1) + largest * (angles + growth)
    return Rest(offset, turn, size, unrest.max(0).values)


@torch.no_grad()
def settle(gaussians: Gaussians, rows: Tensor, motion: Motion, times: np.ndarray, limit: float) -> Tensor:
    """Set Gaussians that rest still, in their mean state, in place.

    Args:
        gaussians: Changed in place.
        rows: Those that the networks move. [R]
        motion: Moves them.
        times: The observed times.
        limit: What leaves its place by less rests; normalised units.

    Returns:
        Rows that were set still. [<= R] int64
    """
    sampled = times[np.unique(np.linspace(0, len(times) - 1, SAMPLES).round().astype(int))]
    found = rest(motion, gaussians.means[rows], gaussians.log_scales[rows], sampled)
    still = found.unrest < limit
    chosen = rows[still]
    gaussians.means[chosen] += found.offsets[still]
    gaussians.quats[chosen] = rotations.multiply(found.quats[still], gaussians.quats[chosen])
    gaussians.log_scales[chosen] += found.log_scales[still]
    gaussians.motion_ids[chosen] = 0
    return chosen
