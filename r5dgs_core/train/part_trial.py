"""Trial of parts: a body that gains from residuals may be several rigid bodies, for example the links of an arm.

The paths of the Gaussians in the trial of residuals propose the parts (`part_clusters`). The parts are then trained
from the first time outwards, as at the start of a run: a knot that enters gets poses that its neighbours predict, which
are registered to the images. Members join the part with whose motion they stay inside the masks and keep their colours.
The body is divided if its parts explain held-out views clearly better than residuals after as many steps. A smaller
difference is enough if joints connect the parts, because parts of a body that bends have no joints.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor

from ..model import track_state
from ..model.residual_field import ResidualField
from ..motion import rotations
from ..motion.se3 import Pose
from ..motion_fit import joints, noise
from ..raster.arrays import to_host
from ..scene import cameras, spherical_harmonics
from . import observed_motion, part_clusters, registration, train_views
from .checkpoint import Checkpoint
from .registration import BodyRegistration
from .representations import residual
from .representations.tracks import TracksRepresentation
from .trainer import Trainer

log = logging.getLogger(__name__)

RING_SHARE = 0.1  # steps for a pair of knots that enter, as a share of those of the trial of residuals
NEWEST = 0.5  # share of these steps that draw a view of the knots that entered last
SETTLED = 4  # rounds of training at all knots, each with half of the steps of the trial
VIEWS, REFINEMENTS, PASSES = 3, 3, 2  # registration of knots that enter
WIDE = 3  # number of knots in training from which members may join another part
OUTSIDE = 0.25  # cost of a member outside the masks of its object, squared colour
JOINS = 0.97  # maximum cost in another part, relative to that in the own part
NEIGHBOURS = 8  # members over which costs are averaged
BETTER = 0.7  # maximum error of the parts, relative to that of residuals
JOINED = 0.9  # the same of parts that joints connect


def divide(
    trainer: Trainer,
    state: Checkpoint,
    body: int,
    field: ResidualField,
    limit: float,
    held: Sequence[int],
    used: Sequence[int],
    steps: int,
) -> Checkpoint | None:
    """Return a state in which a body is divided into parts; None if parts do not explain its images.

    Args:
        trainer: A run; its state is not restored.
        state: The state to start from, without residuals of the body.
        body: The body.
        field: Residuals of the body, from their trial.
        limit: Summed squared error of the body on the held-out views with residuals.
        held: Views for the comparison.
        used: Views for training.
        steps: Steps of the trial of residuals.
    """
    rng = np.random.default_rng(trainer.config.train.seed + body)
    found, _ = residual.point_motion(field, track_state.tracks_of(state.tensors), state.tensors)
    weights = torch.sigmoid(state.tensors["gaussians.opacity_logits"]).numpy()[found.rows].astype(np.float64)
    canonical = state.tensors["gaussians.means"].numpy()[found.rows].astype(np.float64)
    paths = np.concatenate([canonical[:, None], found.means], axis=1)
    labels = part_clusters.find(paths, weights, rng)
    if labels is None:
        return None
    bodies = len(state.tensors["tracks.centers"])
    parts = [body, *range(bodies, bodies + int(labels.max()))]
    tensors = part_clusters.split(state.tensors, body, found.rows, labels, paths, weights)
    object_id = int(trainer.object_ids[body])
    trainer.restore(dataclasses.replace(state, tensors=state.tensors | residual.tensors_of(field)))
    _Growth(trainer, [body], used, rng).settle(steps)
    limit = min(limit, error_of(trainer, object_id, held))
    trainer.restore(dataclasses.replace(state, tensors=tensors))
    _Growth(trainer, parts, used, rng).run(steps)
    error = error_of(trainer, object_id, held)
    log.info(
        "object %d: %d parts, error %.4g on held-out views, %.4g with residuals", object_id, len(parts), error, limit
    )
    if error > JOINED * limit or (error > BETTER * limit and not are_joined(trainer, parts)):
        return None
    return dataclasses.replace(state, tensors=trainer.state().tensors)


def are_joined(trainer: Trainer, parts: Sequence[int]) -> bool:
    """Return True if joints connect all parts of a body, according to their tracks."""
    if not all((trainer.gaussians.motion_ids == part).any() for part in parts):
        return False
    links = [_link(trainer, part) for part in parts]
    costs = np.full((len(parts), len(parts)), np.inf)
    for a, b in np.ndindex(costs.shape):
        if a != b:
            place, turn = np.hypot(noise.of_images(links[a].radius), noise.of_images(links[b].radius)).tolist()
            found = joints.find(trainer.times, links[a], links[b], least_noise=(place, turn))
            costs[a, b] = np.inf if found is None else found.cost
    return joints.parents(costs, 0).count(None) == 1


@torch.no_grad()
def _link(trainer: Trainer, part: int) -> joints.Link:
    """Poses of a part relative to those at the last knot."""
    assert isinstance(trainer.motion, TracksRepresentation)
    tracks = trainer.motion.tracks
    quats = rotations.normalize(to_host(tracks.knot_quats())[part].astype(np.float64))
    moves = to_host(tracks.params["translations"])[part].astype(np.float64)
    center = to_host(tracks.centers)[part].astype(np.float64)
    points = to_host(trainer.gaussians.params["means"][trainer.gaussians.motion_ids == part]).astype(np.float64)
    turns = rotations.multiply(quats, rotations.conjugate(quats[-1]))
    return joints.Link(turns, moves - moves[-1], center + moves[-1], observed_motion.radius(points, center))


@torch.no_grad()
def error_of(trainer: Trainer, object_id: int, views: Sequence[int]) -> float:
    """Return the summed squared error of an object's pixels in some views."""
    total = 0.0
    for index in views:
        view = trainer.views[index]
        mask = view.mask
        if mask is None or not (mask == object_id).any():
            continue
        region = np.asarray(ndimage.binary_dilation(mask == object_id, iterations=registration.MARGIN), bool)
        truth = torch.from_numpy(view.image).float() / 255
        squares = ((trainer.render(view.camera, view.t).cpu() - truth) ** 2).sum(-1).numpy().astype(np.float64)
        total += float(squares[region].sum())
    return total


class _Growth:
    """Training of parts from the first time outwards.

    Args:
        trainer: A run whose tracks have the parts.
        parts: Their bodies.
        used: Views for training.
        rng: Random generator.
    """

    def __init__(self, trainer: Trainer, parts: Sequence[int], used: Sequence[int], rng: np.random.Generator):
        assert isinstance(trainer.motion, TracksRepresentation)
        self._trainer, self._motion, self._parts = trainer, trainer.motion, list(parts)
        self._used, self._rng, self._start = np.array(used), rng, trainer.iteration
        self._knots = np.array([train_views.nearest_knot(trainer.times, v.t) for v in trainer.views])
        self._object_id = int(trainer.object_ids[int(trainer.motion.tracks.owners[parts[0]])])

    def run(self, steps: int) -> None:
        """Train; ``steps`` are those of the trial of residuals."""
        ring, last = max(1, int(RING_SHARE * steps)), len(self._trainer.times) - 1
        first = final = self._trainer.first_time
        self._train(ring, first, final, [first])
        while first > 0 or final < last:
            new = [s for s in (first - 1, final + 1) if 0 <= s <= last]
            for s in new:
                self._enter(s, first, final)
            first, final = min(first, *new), max(final, *new)
            self._train(ring, first, final, new)
            if final - first >= WIDE:
                self._join(first, final)
        for _ in range(SETTLED):
            self._train(max(1, steps // 2), 0, last, [])
            self._join(0, last)

    def settle(self, steps: int) -> None:
        """Train at all knots for as many steps as `run`, without moving members."""
        last, first = len(self._trainer.times) - 1, self._trainer.first_time
        rings = 1 + max(first, last - first)
        self._train(rings * max(1, int(RING_SHARE * steps)) + SETTLED * max(1, steps // 2), 0, last, [])

    def _train(self, steps: int, first: int, final: int, newest: Sequence[int]) -> None:
        """Train with views of the knots ``first`` to ``final``, with more of the newest ones."""
        knots = self._knots[self._used]
        pool, new = self._used[(knots >= first) & (knots <= final)], self._used[np.isin(knots, newest)]
        if len(pool) == 0:
            return
        count = steps * self._trainer.config.train.batch
        chosen = [new if len(new) and self._rng.random() < NEWEST else pool for _ in range(count)]
        self._trainer.curriculum.queue = [int(self._rng.choice(views)) for views in chosen]
        for _ in range(steps):
            self._trainer.step()
        self._trainer.iteration = self._start  # learning rates stay those of the start

    def _enter(self, knot: int, first: int, final: int) -> None:
        """Give all parts the poses that their neighbours predict at a knot, and register them to the images."""
        for part in self._parts:
            pose = self._predicted(part, knot, first, final)
            if pose is not None:
                BodyRegistration(self._trainer, self._motion, part, knot, VIEWS).write_pose(pose)
        for part in PASSES * self._parts:
            look = BodyRegistration(self._trainer, self._motion, part, knot, VIEWS)
            if len(look) > 1:
                look.write_pose(look.refined(look.pose, REFINEMENTS)[0])

    def _predicted(self, part: int, knot: int, first: int, final: int) -> Pose | None:
        """Pose at constant velocity from the two nearest knots in training; None if there is only one."""
        side = 1 if knot > final else -1
        near, next_near = knot - side, knot - 2 * side
        if not first <= next_near <= final:
            return None
        self._motion.tracks.rebase()
        tracks = self._motion.tracks
        times, quats = self._trainer.times, to_host(tracks.base_quats[part]).astype(np.float64)
        moves = to_host(tracks.params["translations"][part]).astype(np.float64)
        share = (times[knot] - times[near]) / (times[near] - times[next_near])
        turn = rotations.quats_to_rotvecs(rotations.multiply(quats[near], rotations.conjugate(quats[next_near])))
        quat = rotations.multiply(rotations.rotvecs_to_quats(share * turn), quats[near])
        return rotations.normalize(quat), moves[near] + share * (moves[near] - moves[next_near])

    def _join(self, first: int, final: int) -> None:
        """Move members to the part in which they and their neighbours cost least at the knots in training."""
        gaussians = self._trainer.gaussians
        groups = to_host(gaussians.motion_ids)
        rows = np.flatnonzero(np.isin(groups, self._parts))
        points = to_host(gaussians.params["means"])[rows].astype(np.float64)
        weights = to_host(torch.sigmoid(gaussians.params["opacity_logits"].detach()))[rows]
        near = np.asarray(KDTree(points).query(points, k=min(NEIGHBOURS, len(points)))[1])
        share = weights[near] / weights[near].sum(1, keepdims=True)
        costs = np.einsum("rk,rkp->rp", share, self._costs(rows, points, first, final)[near])
        own = np.searchsorted(self._parts, groups[rows])
        best = costs.argmin(1)
        every = np.arange(len(rows))
        joins = costs[every, best] < JOINS * costs[every, own]
        ids = np.array(self._parts)[np.where(joins, best, own)]
        device = gaussians.motion_ids.device
        gaussians.motion_ids[torch.from_numpy(rows).to(device)] = torch.from_numpy(ids).to(gaussians.motion_ids)

    def _costs(self, rows: np.ndarray, points: np.ndarray, first: int, final: int) -> np.ndarray:
        """Mean cost of members with the motion of each part: misses of the masks, or differences of colours. [R, P]"""
        tracks, found = self._motion.tracks, np.zeros((len(rows), len(self._parts)))
        quats = rotations.normalize(to_host(tracks.knot_quats()).astype(np.float64))
        moves, centers = to_host(tracks.params["translations"]), to_host(tracks.centers)
        colors = self._colors(rows)
        for index in self._used:
            view, s = self._trainer.views[index], self._knots[index]
            if not first <= s <= final or (mask := view.mask) is None:
                continue
            image = view.image
            for k, part in enumerate(self._parts):
                moved = centers[part] + rotations.rotate(quats[part, s][None], points - centers[part]) + moves[part, s]
                pixels, depth = cameras.project(view.camera, moved)
                x, y = (
                    np.floor(np.nan_to_num(pixels))
                    .clip(0, [view.camera.width - 1, view.camera.height - 1])
                    .T.astype(int)
                )
                away = ((image[y, x] / 255.0 - colors) ** 2).sum(1)
                inside = (mask[y, x] == self._object_id) & (depth > 0)
                found[:, k] += np.where(inside, np.minimum(away, OUTSIDE), OUTSIDE)
        return found

    def _colors(self, rows: np.ndarray) -> np.ndarray:
        """Colours of some Gaussians. [R, 3]"""
        sh: Tensor = self._trainer.gaussians.params["sh"].detach().cpu()[torch.from_numpy(rows), 0]
        return spherical_harmonics.dc_to_rgb(sh).numpy().astype(np.float64)
