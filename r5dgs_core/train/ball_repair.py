"""Repair of the rotations of balls: they are aligned by their texture once all times take part in training.

A ball shows its rotation by its texture alone, and only a part of it at a time. While times enter, its track can turn
at a wrong rate together with a texture that is learned with it. So balls are found by their outlines, and rotations at
which one texture explains all images (`ball_texture`) replace the track if they explain them clearly better than it
does. If most of them differ much, the Gaussians of the ball are placed anew, in the colours of that texture, because
those that were learned with wrong rotations are smeared. Other bodies, and balls whose tracks are right, keep their
bits.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from scipy import ndimage

from ..model.tracks import Tracks
from ..motion import rotations
from ..raster.arrays import to_host
from ..scene import cameras, sampling, spherical_harmonics
from ..shapes import directions as even_directions
from . import ball_outlines, ball_texture, train_views
from .ball_outlines import Ball
from .ball_texture import Alignment, SurfacePixels
from .representations.tracks import TracksRepresentation
from .train_views import TrainView
from .trainer import Trainer

log = logging.getLogger(__name__)

VIEWS, FEWEST = 6, 3  # most views of a knot, in short and in long captures
EVERY = 400  # number of views of all knots above which a capture is long
PIXELS = 6000  # largest number of compared pixels of a ball
MIN_PIXELS = 400  # smallest number
STEEPEST = 0.3  # smallest cosine of the angle between the surface and the ray that counts
CLEARLY = 0.93  # largest error of new rotations, relative to that of the track
TEXTURED = 0.2  # largest error of them, relative to that of shade without texture
APART = np.radians(1.0)  # smallest change of a rotation near the end of a run
FAR = np.radians(
    8.0
)  # change of a rotation that training would not undo; Gaussians are smeared if the median exceeds it
OPACITY = 0.9  # of Gaussians that are placed anew
WIDE, FLAT = 0.5, 0.2  # their standard deviations along the surface and across it, in distances of neighbours


def repair(trainer: Trainer, least: float = APART) -> int:
    """Align balls, and return the number of balls with new tracks.

    Args:
        trainer: A run with tracks.
        least: Smallest change of a rotation, rad; a ball whose track is less wrong keeps it.
    """
    tracks, residuals = _tracks(trainer), trainer.motion.residuals
    bent = set() if residuals is None else set(residuals.bodies)
    count = 0
    for body, ball, pixels in _balls(trainer, [k for k in range(1, tracks.bodies) if k not in bent]):
        found = find(trainer, tracks, body, pixels, least)
        if found is not None:
            _write(trainer, tracks, body, ball, found)
            count += 1
            log.info("object %d: rotations of a ball aligned by its texture", _object_id(trainer, body))
    return count


def rigid(trainer: Trainer, bodies: Sequence[int]) -> set[int]:
    """Return those of some bodies that are balls whose images one turning texture explains, so that none bends."""
    tracks, found = _tracks(trainer), set()
    for body, _, pixels in _balls(trainer, bodies):
        if len(pixels.knots) >= MIN_PIXELS:
            aligned = ball_texture.align(pixels, _quats(tracks, body), trainer.times)
            if aligned.error < TEXTURED * aligned.plain:
                found.add(body)
    return found


def _balls(trainer: Trainer, bodies: Sequence[int]) -> Iterator[tuple[int, Ball, SurfacePixels]]:
    """Yield those of some bodies that have the outlines of balls and are whole objects, with their pixels."""
    tracks = _tracks(trainer)
    owners = tracks.owners.tolist()
    whole = [body for body in bodies if owners.count(owners[body]) == 1]
    if not whole:
        return
    ids, groups = [_object_id(trainer, body) for body in whole], _by_knot(trainer)
    for body, object_id, outlines in zip(whole, ids, ball_outlines.gather(groups, ids), strict=True):
        ball = ball_outlines.fit(outlines, trainer.places.centers[owners[body] - 1], trainer.times)
        if ball is not None:
            ball = _completed(tracks, body, ball)
            yield body, ball, _pixels(groups, object_id, ball)


def _tracks(trainer: Trainer) -> Tracks:
    assert isinstance(trainer.motion, TracksRepresentation)
    return trainer.motion.tracks


def _object_id(trainer: Trainer, body: int) -> int:
    return int(trainer.object_ids[_tracks(trainer).owners[body]])


def _offset(tracks: Tracks, body: int, ball: Ball) -> np.ndarray:
    """Return the centre of a ball relative to that of its track, in the frame of the body. [3]"""
    moved = to_host(tracks.centers)[body] + to_host(tracks.params["translations"])[body].astype(np.float64)
    offsets = rotations.rotate(rotations.conjugate(_quats(tracks, body)), ball.centers - moved)
    return np.median(offsets[ball.measured], axis=0)


def _completed(tracks: Tracks, body: int, ball: Ball) -> Ball:
    """Return a ball with the centres of its track at knots at which the outlines do not determine them."""
    moved = to_host(tracks.centers)[body] + to_host(tracks.params["translations"])[body].astype(np.float64)
    tracked = moved + rotations.rotate(_quats(tracks, body), np.broadcast_to(_offset(tracks, body, ball), moved.shape))
    return dataclasses.replace(ball, centers=np.where(ball.measured[:, None], ball.centers, tracked))


def find(trainer: Trainer, tracks: Tracks, body: int, pixels: SurfacePixels, least: float) -> Alignment | None:
    """Return the rotations of a ball; None if its track is right, or if its texture does not show them."""
    if len(pixels.knots) < MIN_PIXELS:
        return None
    quats = _quats(tracks, body)
    found = ball_texture.align(pixels, quats, trainer.times)
    better = found.error < CLEARLY * found.before and found.error < TEXTURED * found.plain
    change = rotations.angle_between(ball_texture.in_frame_of(found.quats, quats), quats).max()
    return found if better and change > least else None


def _quats(tracks: Tracks, body: int) -> np.ndarray:
    return rotations.normalize(to_host(tracks.knot_quats())[body].astype(np.float64))


def _by_knot(trainer: Trainer) -> list[list[TrainView]]:
    groups: list[list[TrainView]] = [[] for _ in trainer.times]
    for view in trainer.views:
        if view.has_mask:
            groups[train_views.nearest_knot(trainer.times, view.t)].append(view)
    most = min(VIEWS, max(FEWEST, EVERY // len(groups)))
    return [sampling.spread(group, most) for group in groups]


def _pixels(groups: list[list[TrainView]], object_id: int, ball: Ball) -> SurfacePixels:
    """Return the pixels inside the masks of a ball, with the points of the ball that they show."""
    knots, directions, colors = [np.zeros(0, int)], [np.zeros((0, 3))], [np.zeros((0, 3))]
    most = max(PIXELS // max(sum(map(len, groups)), 1), 1)
    for s, views in enumerate(groups):
        for view in views:
            mask = view.mask
            where = None if mask is None else ball_outlines.box(mask, object_id)
            if mask is None or where is None:
                continue
            rows, columns = where
            camera = cameras.crop(
                view.camera, columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start
            )
            inside = np.flatnonzero(ndimage.binary_erosion(mask[rows, columns] == object_id))
            inside = inside[np.linspace(0, len(inside) - 1, min(len(inside), most)).astype(int)]
            rays = cameras.pixel_rays(camera).reshape(-1, 3)[inside]
            away = ball.centers[s] - camera.center
            along = rays @ away
            depth = along**2 - (away @ away - ball.radius**2)
            hit = depth > (STEEPEST * ball.radius) ** 2
            outward = ((along - np.sqrt(np.maximum(depth, 0)))[:, None] * rays - away)[hit]
            knots.append(np.full(int(hit.sum()), s))
            directions.append(outward / np.linalg.norm(outward, axis=1, keepdims=True))
            colors.append(view.image[rows, columns].reshape(-1, 3)[inside][hit] / 255)
    return SurfacePixels(np.concatenate(knots), np.concatenate(directions), np.concatenate(colors))


@torch.no_grad()
def _write(trainer: Trainer, tracks: Tracks, body: int, ball: Ball, found: Alignment) -> None:
    """Write a path and rotations into the track of a body; its frame stays nearest to the present one."""
    old = _quats(tracks, body)
    quats = ball_texture.in_frame_of(found.quats, old)
    center = to_host(tracks.centers)[body].astype(np.float64)
    own = _offset(tracks, body, ball)
    if np.median(rotations.angle_between(quats, old)) > FAR:
        own = np.zeros(3)
        _place(trainer, tracks, body, ball, found, quats)
    tracks.base_quats[body] = torch.from_numpy(quats).to(tracks.base_quats)
    tracks.params["rotvecs"][body] = 0.0
    shifts = ball.centers - center - rotations.rotate(quats, np.broadcast_to(own, ball.centers.shape))
    tracks.params["translations"][body] = torch.from_numpy(shifts).to(tracks.params["translations"])
    _forget(trainer, tracks.params["rotvecs"], torch.tensor([body]))
    _forget(trainer, tracks.params["translations"], torch.tensor([body]))


def _place(trainer: Trainer, tracks: Tracks, body: int, ball: Ball, found: Alignment, quats: np.ndarray) -> None:
    """Place the Gaussians of a ball with rotations [S, 4] evenly on its surface, in the colours of its texture."""
    params = trainer.gaussians.params
    rows = torch.nonzero(trainer.gaussians.motion_ids == body)[:, 0]
    if len(rows) == 0:
        return
    outward = even_directions.sphere(len(rows))
    gap = ball.radius * np.sqrt(4 * np.pi / len(rows))
    frame = rotations.multiply(rotations.conjugate(found.quats[0]), quats[0])  # from that of the ball to the texture's
    colors = found.colors(rotations.rotate(frame[None], outward))
    values = {
        "means": to_host(tracks.centers)[body] + (ball.radius - FLAT * gap) * outward,
        "quats": np.stack([rotations.between_vectors(np.array([0.0, 0, 1]), way) for way in outward]),
        "log_scales": np.log(np.broadcast_to([WIDE * gap, WIDE * gap, FLAT * gap], outward.shape)),
        "opacity_logits": np.full(len(rows), np.log(OPACITY / (1 - OPACITY))),
        "sh": spherical_harmonics.rgb_to_dc(colors)[:, None],
        "sh_rest": np.zeros(tuple(params["sh_rest"][rows].shape)),
        "shading": np.zeros_like(outward),
    }
    for name, value in values.items():
        params[name][rows] = torch.from_numpy(np.asarray(value, np.float32)).to(params[name])
        _forget(trainer, params[name], rows)


def _forget(trainer: Trainer, parameter: torch.Tensor, rows: torch.Tensor) -> None:
    """Set the momentum of some rows of a parameter to zero."""
    moments = trainer.optimizer.state.get(parameter, {})
    if "exp_avg" in moments:
        moments["exp_avg"][rows.to(parameter.device)] = 0.0
