"""Poses of fixed cameras from a board that they see at common times: relative poses, chain, bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ... import errors
from ...motion import rotations
from ..calibration.lens import Lens
from . import board_adjustment
from .board_adjustment import Solution
from .sightings import Sighting, board_poses

FEWEST_COMMON = 3  # times at which two cameras must agree about their relative pose
_ANGLE, _DISTANCE = 0.1, 0.1  # agreement of two relative poses: rad, and share of the distance to the board
_Candidates = dict[tuple[int, int], list[np.ndarray]]  # poses of the board by camera and time


def solve(
    names: Sequence[str], lenses: Sequence[Lens], sightings: Sequence[Sighting], points: np.ndarray, *, refine: bool
) -> Solution:
    """Find the poses of cameras. The world is the frame of the first camera.

    Args:
        names: Names of the cameras, for errors.
        lenses: Their lenses.
        sightings: Sightings of the board.
        points: Corners of the board, in its frame. [K, 3]
        refine: Refine the lenses too.

    Raises:
        DatasetError: Cameras do not see the board together often enough; the error names them.
    """
    candidates = {(s.camera, s.time): board_poses(s, points, lenses[s.camera]) for s in sightings}
    cameras = _chain(names, candidates)
    by_time: dict[int, list[Sighting]] = {}
    for sighting in sightings:
        by_time.setdefault(sighting.time, []).append(sighting)
    boards = {}
    for time, views in by_time.items():
        worlds = [np.linalg.inv(cameras[s.camera]) @ pose for s in views for pose in candidates[s.camera, time]]
        if worlds:
            boards[time] = min(worlds, key=lambda world: _error(world, views, cameras, lenses, points))
    used = [sighting for sighting in sightings if sighting.time in boards]
    return board_adjustment.adjust(Solution(tuple(lenses), cameras, boards), used, points, refine=refine)


def _error(
    world: np.ndarray, views: Sequence[Sighting], cameras: np.ndarray, lenses: Sequence[Lens], points: np.ndarray
) -> float:
    """Return the median error of a board's pose in all views of one time, pixels."""
    misses = []
    for view in views:
        pose = cameras[view.camera] @ world
        moved = points[view.rows] @ pose[:3, :3].T + pose[:3, 3]
        misses.append(np.linalg.norm(lenses[view.camera].project(moved) - view.pixels, axis=1))
    return float(np.median(np.nan_to_num(np.concatenate(misses), nan=1e4)))


def _chain(names: Sequence[str], candidates: _Candidates) -> np.ndarray:
    """Return world to camera of each camera, by relative poses, the most reliable first. [C, 4, 4]"""
    count = len(names)
    pairs = {(i, j): _relative(i, j, candidates) for i in range(count) for j in range(count) if i != j}
    found = {0: np.eye(4)}
    while len(found) < count:
        known, new = max(
            ((i, j) for i, j in pairs if i in found and j not in found), key=lambda pair: (pairs[pair][0], pair)
        )
        votes, relative = pairs[known, new]
        if votes < FEWEST_COMMON:
            lost = [k for k in range(count) if k not in found]
            raise _unconnected(names, lost, pairs)
        found[new] = relative @ found[known]
    return np.stack([found[k] for k in range(count)])


def _unconnected(
    names: Sequence[str], lost: Sequence[int], pairs: dict[tuple[int, int], tuple[int, np.ndarray]]
) -> errors.DatasetError:
    described = []
    for new in lost:
        votes, known = max((pairs[i, new][0], i) for i in range(len(names)) if i != new and i not in lost)
        described.append(f"{names[new]} (together with {names[known]} at {votes} times, expected {FEWEST_COMMON})")
    return errors.DatasetError(
        f"cameras {', '.join(described)}: do not see the board together with the other cameras. Remedy: film again, "
        "and carry the board slowly through the space that these cameras share with another one, facing both"
    )


def _relative(i: int, j: int, candidates: _Candidates) -> tuple[int, np.ndarray]:
    """Return the pose of camera j relative to camera i on which most times agree, and the number of these times."""
    options: list[tuple[int, np.ndarray]] = []
    for (camera, time), poses in candidates.items():
        if camera == i:
            others = candidates.get((j, time), [])
            options += [(time, theirs @ np.linalg.inv(own)) for own in poses for theirs in others]
    if not options:
        return 0, np.eye(4)
    matrices = np.stack([matrix for _, matrix in options])
    times = np.array([time for time, _ in options])
    depths = [pose[2, 3] for (camera, _), poses in candidates.items() if camera in (i, j) for pose in poses]
    reach = _DISTANCE * float(np.median(depths))
    best: tuple[int, np.ndarray] = (0, np.zeros(len(options), bool))
    for matrix in matrices:
        turn = np.einsum("nij,kj->nik", matrices[:, :3, :3], matrix[:3, :3])
        cosine = np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)
        near = np.linalg.norm(matrices[:, :3, 3] - matrix[:3, 3], axis=1) < reach
        agree = (np.arccos(cosine) < _ANGLE) & near
        votes = len(np.unique(times[agree]))
        if votes > best[0]:
            best = votes, agree
    agreed = matrices[best[1]]
    mean = np.eye(4)
    quats = rotations.rotmats_to_quats(agreed[:, :3, :3])
    quats = quats * np.sign(np.einsum("nk,k->n", quats, quats[0]))[:, None]
    mean[:3, :3] = rotations.quats_to_rotmats(rotations.normalize(quats.mean(0)))
    mean[:3, 3] = np.median(agreed[:, :3, 3], axis=0)
    return best[0], mean
