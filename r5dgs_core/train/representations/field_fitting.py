"""Fits of the deformation field and the TRD to motion alone, without images.

They are fast and determine motion that images leave open. Images only show a Gaussian's velocity v + w x p at its own
position: its spin w is free, and a field represents rotation by velocities that depend on position. The cross-Gaussian
twist loss removes this ambiguity: the twist of one Gaussian must also move another Gaussian of the same group.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from ...model.tracks import Tracks
from ...model.trd import MotionState
from ...motion import rotations
from .field_motion import FieldMotion
from .rigidity import QUAT_WEIGHT

ROWS = 512  # Gaussians per step of a fit
RATE = 2e-3
ALONE = -1  # group of Gaussians that each move on their own, without partners


def _optimise(parameters: Iterator[Tensor], steps: int, loss: Callable[[], Tensor]) -> None:
    """Minimise with Adam and a rate that decays to a twentieth; gradients are cleared at the end."""
    named = [p for p in parameters if p.requires_grad]
    optimizer = torch.optim.Adam(named, lr=RATE, fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.05 ** (1 / max(steps, 1)))
    for _ in range(steps):
        optimizer.zero_grad(set_to_none=True)
        loss().backward()
        optimizer.step()
        schedule.step()
    optimizer.zero_grad(set_to_none=True)


def _sample(count: int, generator: torch.Generator, device: torch.device) -> Tensor:
    """Draw the rows of a step. [<= ROWS] int64"""
    return torch.randint(0, count, (min(ROWS, count),), generator=generator).to(device, non_blocking=True)


def fit_field(
    motion: FieldMotion,
    means: Tensor,
    groups: Tensor,
    tracks: Tracks,
    first: int,
    steps: int,
    generator: torch.Generator,
) -> None:
    """Fit the field to the motion of the tracks, relative to the knot at which the Gaussians are canonical.

    Args:
        motion: Changed in place.
        means: Canonical centres of the movers. [R, 3]
        groups: Their motion groups. [R]
        tracks: Tracks; all knots up to the horizon are fitted.
        first: Knot at which the Gaussians are canonical.
        steps: Number of steps; each evaluates the field at four random knots.
        generator: Random generator.
    """
    if len(means) == 0 or steps == 0:
        return
    with torch.no_grad():
        home = tracks.poses(float(tracks.times[first]))
        centers = tracks.group_centers()
        here = centers[groups] + home.displacements[groups]
        arm = means - here
    times = [float(t) for t in tracks.times if t <= motion.horizon + 1e-9]

    def loss() -> Tensor:
        total = means.new_zeros(())
        for k in torch.randint(0, len(times), (4,), generator=generator).tolist():
            rows = _sample(len(means), generator, means.device)
            with torch.no_grad():
                poses = tracks.poses(times[k])
                turn = rotations.multiply(poses.quats, rotations.conjugate(home.quats))[groups[rows]]
                goal = centers[groups[rows]] + poses.displacements[groups[rows]] + rotations.rotate(turn, arm[rows])
                goal = goal - means[rows]
            deltas = motion.deltas(means[rows], times[k])
            sign = torch.where((deltas.quats * turn).sum(-1, keepdim=True) < 0, -1.0, 1.0)
            off = (deltas.offsets - goal).square().sum(-1).mean()
            total = total + off + QUAT_WEIGHT * (deltas.quats - sign * turn).square().sum(-1).mean()
            total = total + deltas.log_scales.square().mean()
        return total

    _optimise(motion.field.parameters(), steps, loss)


def fit_trd(
    motion: FieldMotion, means: Tensor, groups: Tensor, steps: int, twist: float, generator: torch.Generator
) -> None:
    """Fit the TRD to the motion of the field over intervals of about one step, forwards and backwards.

    Args:
        motion: Its TRD is changed in place.
        means: Canonical centres of the movers. [R, 3]
        groups: Their motion groups, for the twist loss; `ALONE` for no group. [R]
        steps: Steps of the fit.
        twist: Weight of the cross-Gaussian twist loss.
        generator: Random generator.
    """
    first = motion.start
    if len(means) == 0 or steps == 0 or motion.horizon <= first:  # a single time has no motion
        return

    def loss() -> Tensor:
        rows = _sample(len(means), generator, means.device)
        at, sign, reach = torch.rand(3, generator=generator).tolist()
        start = first + at * (motion.horizon - first)
        span = (0.5 + reach) * motion.step * (1 if sign < 0.5 else -1)
        end = min(max(start + span, first), motion.horizon)
        with torch.no_grad():
            before, after = motion.deltas(means[rows], start), motion.deltas(means[rows], end)
            begin, goal = means[rows] + before.offsets, means[rows] + after.offsets
            turn = rotations.multiply(after.quats, rotations.conjugate(before.quats))
        state = motion.state(begin, start)
        there, turned = motion.carry(begin, state, end - start, motion.step)
        sign_q = torch.where((turned * turn).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        total = (there - goal).square().sum(-1).mean()
        total = total + QUAT_WEIGHT * (turned - sign_q * turn).square().sum(-1).mean()
        if twist > 0:
            total = total + twist * cross_twist(motion, begin, goal, state, end - start, groups[rows], generator)
        return total

    _optimise(motion.trd.parameters(), steps, loss)


def cross_twist(
    motion: FieldMotion,
    begin: Tensor,
    goal: Tensor,
    state: MotionState,
    span: float,
    groups: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Return the mean squared error of moving a Gaussian by the twist of another Gaussian of its group.

    Args:
        motion: Integrates the twists.
        begin: Start positions. [R, 3]
        goal: End positions. [R, 3]
        state: Twists of the Gaussians.
        span: Scene time between start and end.
        groups: Their motion groups. [R]
        generator: Random generator for the partners.
    """
    partner = _partners(groups, generator)
    crossed, _ = motion.carry(begin[partner], state, span, motion.step)
    return (crossed - goal[partner]).square().sum(-1).mean()


def _partners(groups: Tensor, generator: torch.Generator) -> Tensor:
    """Return a row of the same group for each row, by a random cyclic shift; itself if `ALONE`. [R] int64"""
    order = torch.argsort(groups, stable=True)
    partner = torch.arange(len(groups), device=groups.device)
    start = int((groups == ALONE).sum())
    counts = torch.bincount(groups[groups != ALONE])
    for count in counts[counts > 0].tolist():
        rows = order[start : start + count]
        shift = int(torch.randint(0, count, (1,), generator=generator))
        partner[rows] = rows.roll(shift)
        start += count
    return partner
