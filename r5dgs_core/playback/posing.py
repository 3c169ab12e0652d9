"""Gaussians of a scene moved by rigid maps, one per motion group.

Notation: member i of a group lies at p + r_i at t_max, p the group's pivot; its position is R r_i + (p + d), computed
in float64 relative to an origin and rounded to float32 once, so that precision is highest near that origin.
"""

from __future__ import annotations

import numpy as np

from ..motion import quaternion_columns, rotations
from ..scene import diffuse_shading
from ..scene.row_runs import runs
from ..scene.scene import Scene


class Poser:
    """The Gaussians of a scene in any poses of its groups. Pose-independent quantities are computed once.

    Args:
        scene: The scene.
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        self._runs = runs(scene.gaussians.motion_ids)
        self._run_groups = np.array([g for _, _, g in self._runs], np.int64)
        self.pivots = np.array([group.pivot for group in scene.groups], np.float64).reshape(-1, 3)
        self._rest = diffuse_shading.rest_factors(scene)
        self._arms: np.ndarray | None = None
        self._still: tuple[np.ndarray, np.ndarray] | None = None

    def means(
        self,
        group_quats: np.ndarray,
        group_displacements: np.ndarray,
        origin: np.ndarray,
        others: np.ndarray | None = None,
        groups: np.ndarray | None = None,
    ) -> np.ndarray:
        """Centres with each group in a pose, relative to an origin.

        Args:
            group_quats: Rotation of each group about its pivot, unit wxyz. [G, 4]
            group_displacements: Displacement of each pivot, world. [G, 3]
            origin: Point of the world. [3]
            others: Centres to keep of the groups outside of ``groups``; None to compute all. [N, 3] float32
            groups: Mask of the groups to compute. [G]

        Returns:
            A new array. Gaussians of groups that did not move equal the bind state exactly if the origin is zero.
            [N, 3] float32
        """
        resting = self._resting(origin)
        result = (resting if others is None else others).copy()
        moved = (group_quats[:, 1:] != 0).any(-1) | (group_displacements != 0).any(-1)
        if moved.any() or others is not None:
            maps, arms = self.maps(group_quats, group_displacements, origin), self.arms
            for start, stop, g in self._runs_of(groups):
                if moved[g]:
                    result[start:stop] = arms[start:stop] @ maps[g]
                elif others is not None:
                    result[start:stop] = resting[start:stop]
        return result

    def maps(self, group_quats: np.ndarray, group_displacements: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Matrices that transform `arms` by right multiplication. [G, 4], [G, 3], [3] -> [G, 4, 3]"""
        maps = np.empty((len(group_quats), 4, 3))
        maps[:, :3] = np.swapaxes(rotations.quats_to_rotmats(group_quats), -1, -2)
        maps[:, 3] = self.pivots + group_displacements - origin
        return maps

    def shift(self, offsets: np.ndarray, maps: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Centres at t_max plus offsets mapped by each group's matrix, relative to an origin.

        Args:
            offsets: Offsets with a fourth column of ones. [N, 4]
            maps: Matrix of each group, for right multiplication. [G, 4, 3]
            origin: Point of the world. [3]

        Returns:
            A new array; groups with a zero matrix stay in place. [N, 3] float32
        """
        result = self._resting(origin).copy()
        for start, stop, g in self._runs:
            if maps[g].any():
                moves = offsets[start:stop] @ maps[g]
                moves += self._scene.gaussians.means[start:stop]
                moves -= origin
                result[start:stop] = moves
        return result

    def quats(
        self, group_quats: np.ndarray, others: np.ndarray | None = None, groups: np.ndarray | None = None
    ) -> np.ndarray:
        """Gaussian rotations with each group rotated; the scene's own array if none is.

        Args:
            group_quats: Rotation of each group, unit wxyz. [G, 4]
            others: Rotations to keep of the groups outside of ``groups``; None to compute all. [N, 4] float32
            groups: Mask of the groups to compute. [G]
        """
        own = self._scene.gaussians.quats
        turned = (group_quats[:, 1:] != 0).any(-1)
        if not turned.any():
            return own
        result = (own if others is None else others).copy()
        matrices = _products(group_quats)
        for start, stop, g in self._runs_of(groups):
            if turned[g]:
                np.matmul(own[start:stop], matrices[g], out=result[start:stop])
            elif others is not None:
                result[start:stop] = own[start:stop]
        return result

    def shading(
        self, group_quats: np.ndarray, others: np.ndarray | None = None, groups: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Colour factor of each Gaussian with each group rotated, or None without shading.

        Args:
            group_quats: Rotation of each group, unit wxyz. [G, 4]
            others: Factors to keep of the groups outside of ``groups``; None to compute all. [N] float32
            groups: Mask of the groups to compute. [G]
        """
        if self._scene.shading is None:
            return None
        vectors, light = self._scene.shading.vectors, self._scene.shading.light
        result = self._rest.clip(min=0) if others is None else others.copy()
        change = (rotations.rotate(rotations.conjugate(group_quats), light) - light).astype(np.float32)
        for start, stop, g in self._runs_of(groups):
            if change[g].any():
                result[start:stop] = diffuse_shading.factors(self._rest[start:stop], vectors[start:stop], change[g])
            elif others is not None:
                result[start:stop] = self._rest[start:stop].clip(min=0)
        return result

    def relight(self, factors: np.ndarray | None, rows: np.ndarray, turns: np.ndarray) -> None:
        """Write colour factors of individually rotated Gaussians.

        Args:
            factors: Output, or None without shading. [N]
            rows: Rows of the Gaussians. [R]
            turns: Their rotations since t_max, unit wxyz, by column. [4, R]
        """
        if factors is None or self._scene.shading is None:
            return
        vectors, light = self._scene.shading.vectors, self._scene.shading.light
        change = quaternion_columns.direction_changes(turns, light.astype(turns.dtype))
        factors[rows] = diffuse_shading.factors(self._rest[rows], vectors[rows], change.T)

    @property
    def arms(self) -> np.ndarray:
        """Positions relative to the pivots of their groups, with a fourth column of ones. [N, 4] float64"""
        if self._arms is None:
            self._arms = np.ones((len(self._scene.gaussians.means), 4))
            np.subtract(
                self._scene.gaussians.means, self.pivots[self._scene.gaussians.motion_ids], out=self._arms[:, :3]
            )
        return self._arms

    def _runs_of(self, groups: np.ndarray | None) -> list[tuple[int, int, int]]:
        """Return the runs of rows of the groups in a mask [G], of all groups if it is None."""
        if groups is None:
            return self._runs
        return [self._runs[k] for k in np.flatnonzero(groups[self._run_groups])]

    def _resting(self, origin: np.ndarray) -> np.ndarray:
        if not origin.any():
            return self._scene.gaussians.means
        if self._still is None or not np.array_equal(self._still[0], origin):
            self._still = origin.copy(), (self._scene.gaussians.means.astype(np.float64) - origin).astype(np.float32)
        return self._still[1]


def move_points(points: np.ndarray, linear: np.ndarray, shift: np.ndarray, result: np.ndarray) -> None:
    """Write ``linear p + shift`` for each point p to ``result``, computed in float64.

    Args:
        points: The points. [N, 3] float32
        linear: Linear part. [3, 3] float64
        shift: Translation. [3] float64
        result: Output, not ``points``. [N, 3] float32
    """
    turned = points.astype(np.float64) @ linear.T
    for axis in range(3):  # by column, because numpy is slow on rows of three
        np.add(turned[:, axis], shift[axis], out=result[:, axis], casting="same_kind")


def turn_quats(quats: np.ndarray, turn: np.ndarray, result: np.ndarray) -> None:
    """Write the products ``turn q`` to ``result``.

    Args:
        quats: Unit wxyz. [N, 4] float32
        turn: Unit wxyz. [4] float64
        result: Output, not ``quats``. [N, 4] float32
    """
    np.matmul(quats, _products(turn), out=result)


def _products(turns: np.ndarray) -> np.ndarray:
    """Matrices from q to the products ``turn q``, for right multiplication. [..., 4] -> [..., 4, 4] float32"""
    # Linear in q: row k of a matrix is the product with the k-th unit quaternion.
    return rotations.multiply(turns[..., None, :], np.eye(4)).astype(np.float32)
