"""Rigid bodies among the points of several times.

Points that are matched between two times and do not stay in place move. The largest set of moving points with one rigid
motion is the start of a body. The body grows: other times are registered to its points, and points that move with it
join it. Its points are then removed, and the search continues with the others.

Notation: P points, C matches, H hypotheses. A pose [3, 4] maps points of the body's first time to another time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..motion import rigid_path
from ..scene import cameras
from .feature_points import Points, matches

FITS = 3.0  # maximum distance from its pixels of a point that moves with a body, pixels
MIN_MOTION = 6.0  # minimum distance from its pixels of a point that moves, if it stayed in place, pixels
HYPOTHESES = 400  # of three matches
REFITS = 5
MIN_START = 12  # moving points of the start of a body
MIN_REGISTERED = 8  # points that register a time
AGREED = 0.4  # share of the matched points that must agree on the pose of a time
GAPS = (1, 2, 4, 8)  # between the two times of the start
NEAREST = 6  # registered times to which another one is matched
MIN_SHARE = 0.25  # share of the times that must be registered
MAX_BODIES = 8
TRIALS = 32  # starts of bodies, most of which may be too short


@dataclass
class Body:
    """A rigid body.

    Attributes:
        poses: Pose at each registered time, by its index. [3, 4] each
        rows: Its points at each registered time.
    """

    poses: dict[int, np.ndarray]
    rows: dict[int, set[int]] = field(default_factory=dict)

    def places(self, times: Sequence[Points]) -> np.ndarray:
        """Return the positions of its points of all times, at its first time. [P, 3]"""
        return np.concatenate([undone(self.poses[k], times[k].places[sorted(rows)]) for k, rows in self.rows.items()])


def find(
    times: Sequence[Points], rng: np.random.Generator, report: Callable[[float], None] = lambda share: None
) -> list[Body]:
    """Find the rigid bodies that move among the points of several times, the largest first.

    Args:
        times: The points of each time.
        rng: Source of the hypotheses.
        report: Called with the share of the search that is done: of the pairs of times that may be matched, which take
            most of its time.
    """
    search = _Search(times, rng, report)
    found: list[Body] = []
    for _ in range(TRIALS):
        body = search.start() if len(found) < MAX_BODIES else None
        if body is None:
            break
        search.grow(body)
        if len(body.poses) >= MIN_SHARE * len(times) and search.moves(body):
            found.append(body)
    return found


def applied(poses: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Apply poses to points. [..., 3, 4], [P, 3] -> [..., P, 3]"""
    return places @ np.swapaxes(poses[..., :3], -1, -2) + poses[..., None, :, 3]


def undone(pose: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Apply the inverse of a pose [3, 4] to points [P, 3]."""
    return (places - pose[:, 3]) @ pose[:, :3]


class _Search:
    """Points of all times, their matches, and the points that belong to a body already."""

    def __init__(self, times: Sequence[Points], rng: np.random.Generator, report: Callable[[float], None]):
        self._times, self._rng, self._report = times, rng, report
        self._pairs = sum(max(len(times) - gap, 0) for gap in range(1, max(GAPS) + 1))
        self._matches: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        self._taken = [np.zeros(len(points.places), bool) for points in times]

    def start(self) -> Body | None:
        """Return the largest set of points with one motion between two times, or None if it is too small."""
        best, most = None, MIN_START - 1
        for gap in GAPS:
            for i in range(len(self._times) - gap):
                a, b = self._moving(i, i + gap)
                if len(a) <= most:
                    continue
                pose, fits = self._registered(self._times[i].places[a], i + gap, b)
                if fits.sum() > most:
                    best, most = (i, i + gap, a[fits], b[fits], pose), int(fits.sum())
        if best is None:
            return None
        i, j, a, b, pose = best
        body = Body({i: np.eye(3, 4), j: pose})
        self._add(body, i, a)
        self._add(body, j, b)
        return body

    def grow(self, body: Body) -> None:
        """Register the other times to a body, each after its neighbours, and add the points that move with it.

        A time that cannot be registered is tried again once two more times are.
        """
        next_try = dict.fromkeys(range(len(self._times)), 0)
        while True:
            left = [k for k in next_try if k not in body.poses and next_try[k] <= len(body.poses)]
            if not left:
                return
            k = min(left, key=lambda k: min(abs(k - known) for known in body.poses))
            next_try[k] = len(body.poses) + 2
            self._extend(body, k)

    def moves(self, body: Body) -> bool:
        """True if each pose differs from two others; wrong matches in a static pattern move at one time only."""
        places = body.places(self._times)
        center, reach = places.mean(0), np.linalg.norm(places - places.mean(0), axis=1).mean()
        corners = center + reach * np.concatenate([np.eye(3), -np.eye(3)])
        moved = {k: applied(pose, corners) for k, pose in body.poses.items()}
        others = []
        for one in moved.values():
            off = [np.median(_distances(self._times[k], one, other)) for k, other in moved.items()]
            others.append(np.sum(np.array(off) > MIN_MOTION))
        return min(others) >= 2

    def _extend(self, body: Body, k: int) -> None:
        """Register a time to a body, if enough of its points agree."""
        known = sorted(body.poses, key=lambda r: abs(r - k))[:NEAREST]
        places, rows = [], []
        for r in known:
            a, b = self._matched(r, k)
            mine = np.isin(a, sorted(body.rows[r]))
            places.append(undone(body.poses[r], self._times[r].places[a[mine]]))
            rows.append(b[mine])
        place, row = np.concatenate(places), np.concatenate(rows)
        if len(row) < MIN_REGISTERED:
            return
        pose, fits = self._registered(place, k, row)
        if len(np.unique(row[fits])) < MIN_REGISTERED or fits.mean() < AGREED:
            return
        body.poses[k] = pose
        self._add(body, k, row[fits])
        for r in known:
            a, b = self._moving(r, k)
            moved = applied(pose, undone(body.poses[r], self._times[r].places[a]))
            joins = self._times[k].reprojection_errors(moved, b) < FITS
            self._add(body, r, a[joins])
            self._add(body, k, b[joins])

    def _add(self, body: Body, k: int, rows: np.ndarray) -> None:
        free = rows[~self._taken[k][rows]]
        body.rows.setdefault(k, set()).update(free.tolist())
        self._taken[k][free] = True

    def _moving(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the matched points of two times that move and belong to no body yet. [C], [C]"""
        a, b = self._matched(i, j)
        free = ~self._taken[i][a] & ~self._taken[j][b]
        a, b = a[free], b[free]
        moved = self._times[j].reprojection_errors(self._times[i].places[a], b) > MIN_MOTION
        return a[moved], b[moved]

    def _matched(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the matched points of two times. [C], [C]"""
        if i > j:
            a, b = self._matched(j, i)
            return b, a
        if (i, j) not in self._matches:
            self._matches[i, j] = matches(self._times[i], self._times[j])
            self._report(min(1.0, len(self._matches) / self._pairs))
        return self._matches[i, j]

    def _registered(self, places: np.ndarray, k: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the rigid motion that most points follow to their matches at a time (RANSAC).

        Args:
            places: Positions before the motion, at least three. [C, 3]
            k: The time.
            rows: Their matches there. [C]

        Returns:
            Motion [3, 4], and the points that follow it [C] bool.
        """
        points = self._times[k]
        targets = points.places[rows]
        drawn = np.argsort(self._rng.random((HYPOTHESES, len(rows))), 1)[:, :3]
        fits = points.reprojection_errors(applied(_fitted(places[drawn], targets[drawn]), places), rows) < FITS
        follows, pose = fits[int(fits.sum(1).argmax())], np.eye(3, 4)
        for _ in range(REFITS):
            if follows.sum() < 3:
                break
            pose = _fitted(places[follows], targets[follows])
            follows = points.reprojection_errors(applied(pose, places), rows) < FITS
        return pose, follows


def _fitted(places: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the poses that move points to others best (least squares). [..., C, 3] each -> [..., 3, 4]"""
    found = rigid_path.fit(np.stack([places, targets], -2), np.ones(places.shape[:-1]), 0)
    return np.concatenate([found.rotmats[..., 1, :, :], found.shifts[..., 1, :, None]], -1)


def _distances(points: Points, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distances between points [P, 3] in the images of a time, the largest over its cameras, pixels. [P]"""
    off = [np.linalg.norm(cameras.project(c, one)[0] - cameras.project(c, other)[0], axis=1) for c in points.cameras]
    return np.nan_to_num(np.array(off)).max(0)
