"""Bundle adjustment of fixed cameras, lenses and the poses of a board, by least squares."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, sparse

from ...motion import rotations
from ..calibration.lens import Lens
from .sightings import Sighting

_EVALUATIONS = 60
_LENS_SCALE = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3])  # of focal length, principal point (px), k1, k2
# Expected changes of a lens: shares of the focal length for the first three. They only matter for parameters that the
# board does not determine, for example if it is far from a camera in all frames.
_LENS_SPREAD = np.array([0.05, 0.04, 0.04, 0.1, 0.2])


@dataclass(frozen=True, eq=False)
class Solution:
    """Cameras and poses of a board.

    Attributes:
        lenses: Lens of each camera.
        cameras: World to camera of each camera. [C, 4, 4]
        boards: Pose of the board by time, board to world. [4, 4] each
        error: Median distance between corners and their projection, pixels; 0 before the adjustment.
    """

    lenses: tuple[Lens, ...]
    cameras: np.ndarray
    boards: dict[int, np.ndarray]
    error: float = 0.0


def adjust(start: Solution, sightings: Sequence[Sighting], points: np.ndarray, *, refine: bool) -> Solution:
    """Minimise the distances between corners and their projections; the first camera is fixed.

    Args:
        start: Initial solution, with a pose of the board at each time of the sightings.
        sightings: Sightings of the board.
        points: Corners of the board, in its frame. [K, 3]
        refine: Refine focal length, principal point, k1 and k2 of each lens too.
    """
    times = sorted(start.boards)
    problem = _Problem(start, sightings, points, times, refine)
    result = optimize.least_squares(
        problem.residuals,
        np.zeros(problem.size),
        jac_sparsity=problem.sparsity(),
        loss="soft_l1",
        x_scale=problem.scale,
        max_nfev=_EVALUATIONS,
    )
    solution = problem.solution(result.x)
    corners = problem.residuals(result.x)[: 2 * sum(len(view.rows) for view in sightings)]
    misses = np.linalg.norm(corners.reshape(-1, 2), axis=1)
    return dataclasses.replace(solution, error=float(np.median(misses)))


class _Problem:
    """Parameters: 6 of each camera but the first, 6 of each board, and 5 of each lens if lenses are refined.

    Poses change by a rotation vector, applied on the left, and a shift.
    """

    def __init__(
        self, start: Solution, sightings: Sequence[Sighting], points: np.ndarray, times: list[int], refine: bool
    ) -> None:
        self.start, self.points, self.times, self.refine = start, points, times, refine
        self.by_camera = [[s for s in sightings if s.camera == c] for c in range(len(start.cameras))]
        self.boards = np.stack([start.boards[time] for time in times])
        self.first_board = 6 * (len(start.cameras) - 1)
        self.first_lens = self.first_board + 6 * len(times)
        self.size = self.first_lens + (5 * len(start.cameras) if refine else 0)
        distance = float(np.median(np.linalg.norm(self.boards[:, :3, 3], axis=1)))
        pose = np.repeat([1e-3, 1e-3 * distance], 3)
        poses = np.tile(pose, len(start.cameras) - 1 + len(times))
        self.scale = np.concatenate([poses, np.tile(_LENS_SCALE, len(start.cameras) if refine else 0)])

    def solution(self, x: np.ndarray) -> Solution:
        """Return the solution of parameters."""
        free = x[: self.first_board].reshape(-1, 6)
        cameras = _moved(self.start.cameras, np.concatenate([np.zeros((1, 6)), free]))
        boards = _moved(self.boards, x[self.first_board : self.first_lens].reshape(-1, 6))
        lenses = self.start.lenses
        if self.refine:
            changes = x[self.first_lens :].reshape(-1, 5)
            lenses = tuple(_changed(lens, change) for lens, change in zip(lenses, changes, strict=True))
        return Solution(lenses, cameras, dict(zip(self.times, boards, strict=True)))

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Return differences of pixels by camera, and the changes of the lenses, scaled. [2 n + 5 C]"""
        solution = self.solution(x)
        parts = []
        for camera, lens, views in zip(solution.cameras, solution.lenses, self.by_camera, strict=True):
            if not views:
                continue
            poses = camera @ np.stack([solution.boards[view.time] for view in views])
            index = np.repeat(np.arange(len(views)), [len(view.rows) for view in views])
            rows = np.concatenate([view.rows for view in views])
            moved = np.einsum("nij,nj->ni", poses[index, :3, :3], self.points[rows]) + poses[index, :3, 3]
            miss = lens.project(moved) - np.concatenate([view.pixels for view in views])
            parts.append(np.nan_to_num(miss, nan=100.0).ravel())
        if self.refine:
            focal = np.array([[lens.fx] * 3 + [1.0] * 2 for lens in self.start.lenses])
            parts.append((x[self.first_lens :].reshape(-1, 5) / (focal * _LENS_SPREAD)).ravel())
        return np.concatenate(parts)

    def sparsity(self) -> sparse.lil_matrix:
        """Return the sparsity pattern of the Jacobian of `residuals`."""
        count = sum(2 * len(view.rows) for views in self.by_camera for view in views)
        extra = self.size - self.first_lens
        pattern = sparse.lil_matrix((count + extra, self.size), dtype=np.int8)
        column = {time: self.first_board + 6 * k for k, time in enumerate(self.times)}
        row = 0
        for camera, views in enumerate(self.by_camera):
            for view in views:
                rows = slice(row, row + 2 * len(view.rows))
                pattern[rows, column[view.time] : column[view.time] + 6] = 1
                if camera:
                    pattern[rows, 6 * camera - 6 : 6 * camera] = 1
                if self.refine:
                    first = self.first_lens + 5 * camera
                    pattern[rows, first : first + 5] = 1
                row = rows.stop
        pattern[range(count, count + extra), range(self.first_lens, self.size)] = 1
        return pattern


def _moved(poses: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Turn poses by rotation vectors and shift them. [n, 4, 4], [n, 6] -> [n, 4, 4]"""
    result = poses.copy()
    turn = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(steps[:, :3]))
    result[:, :3, :3] = turn @ poses[:, :3, :3]
    result[:, :3, 3] = poses[:, :3, 3] + steps[:, 3:]
    return result


def _changed(lens: Lens, change: np.ndarray) -> Lens:
    k = np.zeros(max(4, len(lens.coefficients)))
    k[: len(lens.coefficients)] = lens.coefficients
    k[:2] += change[3:]
    model = "brown" if lens.model == "pinhole" else lens.model
    f, x, y = change[:3].tolist()
    factor = 1 + f / lens.fx
    return dataclasses.replace(
        lens,
        model=model,
        fx=lens.fx * factor,
        fy=lens.fy * factor,
        cx=lens.cx + x,
        cy=lens.cy + y,
        coefficients=tuple(k.tolist()),
    )
