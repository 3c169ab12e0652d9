"""What a `.r5dgs` file holds: Gaussians in their bind state at t_max, objects, motion groups and their tracks.

Notation: N Gaussians, M objects, G motion groups, S knots, K SH bases, R Gaussians with residuals. A motion group g
moves its members rigidly, x(t) = p_g + R_g(t) (x(t_max) - p_g) + d_g(t), with pivot p_g, R_g(t_max) = I and
d_g(t_max) = 0. A residual changes a Gaussian in the bind state before its group moves it, and is zero at t_max.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..motion.models import MotionModel
from .cameras import Camera
from .lookup_table import Table

ROLES = ("pinned", "body", "shadow")
IDENTITY_DIM = 16  # numbers of an identity encoding (Gaussian Grouping)
NEAR_PLANE = 0.01  # of a scene that does not say
EMBEDDINGS = ("embeddings", "vocabulary_embeddings", "canonical_embeddings", "view_embeddings")
# Dtypes in memory of the arrays that are members of a scene file, in the order of the file.
DTYPES: dict[str, type] = {
    "means": np.float32,
    "quats": np.float32,
    "log_scales": np.float32,
    "opacity_logits": np.float32,
    "sh": np.float32,
    "object_ids": np.int32,
    "motion_ids": np.int32,
    "track_times": np.float64,
    "track_poses": np.float64,
    "background_sh": np.float32,
    "identities": np.float16,
    "classifier_weight": np.float32,
    "classifier_bias": np.float32,
    "residual_rows": np.int32,
    "residual_offsets": np.float32,
    "residual_quats": np.float32,
    "residual_log_scales": np.float32,
    "dynamics": np.float32,
    "canonical_means": np.float32,
    "shading": np.float32,
    "shading_rest": np.float32,
    **dict.fromkeys(EMBEDDINGS, np.float32),
}


@dataclass(frozen=True)
class SceneObject:
    """One object of the table; its Gaussians are the rows ``start : start + count``.

    Attributes:
        id: Object id; 0 is the background, -1 the unassigned Gaussians.
        name: Name that the user sees, unique in the scene.
        aliases: Other words that find it.
        caption: A sentence about it, or "".
        color: Display colour, sRGB in [0, 1].
        start: First row.
        count: Number of rows.
    """

    id: int
    name: str
    aliases: tuple[str, ...]
    caption: str
    color: tuple[float, float, float]
    start: int
    count: int


@dataclass(frozen=True)
class MotionGroup:
    """One rigid motion; group 0 is pinned.

    Attributes:
        id: Motion group id, its row in ``track_poses``.
        object_id: Object that the group belongs to in meaning (the caster's, for a shadow).
        role: "pinned", "body" or "shadow".
        anchor_index: Row of the representative Gaussian, -1 without members.
        pivot: Point that ``track_poses`` turns about, at t_max, world. [3]
        model: Motion past t_max, about ``pivot``.
        follows: Group whose displacement this one takes through ``follow_matrix`` (no rotation), or None.
        follow_matrix: Linear map from that group's displacement to this one's. [3, 3]
        rigid_rms: Root mean square of the distance that members keep from this rigid motion in the observed time.
        rigid_max: The same, largest.
        seen: First and last time at which the object was placed by its masks; before it, the track goes on steadily or
            holds its first pose. None where nothing was observed.
    """

    id: int
    object_id: int
    role: str
    anchor_index: int
    pivot: np.ndarray
    model: MotionModel
    follows: int | None = None
    follow_matrix: np.ndarray | None = None
    rigid_rms: float = 0.0
    rigid_max: float = 0.0
    seen: tuple[float, float] | None = None


@dataclass(frozen=True)
class Scene:
    """A baked scene: everything that playback, Blender and export need.

    Gaussians are in their state at t_max, sorted by object id and, within an object, by motion group.

    Attributes:
        name: Name of the scene.
        means: Centres, world. [N, 3] float32
        quats: Unit wxyz. [N, 4] float32
        log_scales: Natural logarithm of the standard deviations. [N, 3] float32
        opacity_logits: Before the sigmoid. [N] float32
        sh: Spherical harmonics coefficients, 3DGS convention, display-referred sRGB. [N, K, 3] float32
        object_ids: Object of each Gaussian. [N] int32
        motion_ids: Motion group of each Gaussian. [N] int32
        track_times: Observed times, increasing, last = t_max. [S] float64
        track_poses: Rotation wxyz and displacement of the pivot relative to the bind state. [G, S, 7] float64
        objects: The table, ordered by id.
        groups: The motion groups, ordered by id.
        t_max: Last observed time.
        frames_per_unit: Blender frames per unit of scene time.
        world_convention: Key of ``cameras.WORLD_TO_BLENDER``.
        cameras: The data set's distinct cameras.
        background_sh: Spherical harmonics of the sky over the world's viewing direction, 3DGS basis. [Kb, 3]
        identities: Identity encodings. [N, 16] float16 or None
        classifier_weight: Linear classifier of identities; row k is the k-th object with id >= 0 of ``objects``.
            [M + 1, 16] float32 or None
        classifier_bias: Its bias, in the same order. [M + 1] float32 or None
        residual_rows: Gaussians whose observed motion their group does not explain, increasing. [R] int32 or None
        residual_offsets: What is added to their centres at the knots, bind frame. [R, S, 3] float32 or None
        residual_quats: Rotations applied to those of the bind state at the knots (turn q), unit wxyz. [R, S, 4] float32
            or None
        residual_log_scales: What is added to their log scales at the knots. [R, S, 3] float32 or None
        dynamics: Motion of each Gaussian on its own past t_max, for mode "standard": velocity of its centre, angular
            velocity and the rates of both, about its centre at t_max. [N, 12] float32 or None
        canonical_means: Centres in the canonical state, for mode "rigid_paper", world. [N, 3] float32 or None
        shading: How the colour changes as the group turns: factor rest + (R^T l - l) . g, not below 0. [N, 3] float32
            or None
        shading_rest: That factor in the bind state; None where it is 1 for all. A Gaussian that is unlit at t_max has
            one below 0. [N] float32 or None
        light_direction: l above, unit, world. [3]
        embeddings: One row per object of ``objects``, unit, zero for one without. [M, D] or None
        vocabulary: Words with stored embeddings.
        vocabulary_embeddings: One row per word, unit. [W, D] or None
        lookup: What made the embeddings and what they are worth; None where nobody said.
        canonical_embeddings: One row per phrase of ``lookup.canonical``, unit. [C, D] or None
        view_embeddings: Of each object, one row per view of ``lookup.views``, unit, zero past its last. [M, V, D] or
            None
        provenance: Configuration, data hash, versions.
        needs: The needs table: rows of ``name, value, threshold, decision, reason``.
        near_plane: Gaussians whose centre lies nearer than this depth are not drawn, as in training; world units.
        harmonics_turn: Whether harmonics turn with Gaussians that turn on their own, too; those of other projects stay
            in the world's frame.
        origin: Point of the data set's world from which all positions of the scene are measured: world = origin +
            position. Zero unless the world's origin lies so far away that float32 would lose detail. [3] float64
    """

    name: str
    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    object_ids: np.ndarray
    motion_ids: np.ndarray
    track_times: np.ndarray
    track_poses: np.ndarray
    objects: tuple[SceneObject, ...]
    groups: tuple[MotionGroup, ...]
    t_max: float
    frames_per_unit: float
    world_convention: str
    cameras: tuple[Camera, ...]
    background_sh: np.ndarray
    identities: np.ndarray | None = None
    classifier_weight: np.ndarray | None = None
    classifier_bias: np.ndarray | None = None
    residual_rows: np.ndarray | None = None
    residual_offsets: np.ndarray | None = None
    residual_quats: np.ndarray | None = None
    residual_log_scales: np.ndarray | None = None
    dynamics: np.ndarray | None = None
    canonical_means: np.ndarray | None = None
    shading: np.ndarray | None = None
    shading_rest: np.ndarray | None = None
    light_direction: np.ndarray | None = None
    embeddings: np.ndarray | None = None
    vocabulary: tuple[str, ...] = ()
    vocabulary_embeddings: np.ndarray | None = None
    lookup: Table | None = None
    canonical_embeddings: np.ndarray | None = None
    view_embeddings: np.ndarray | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    needs: tuple[dict[str, Any], ...] = ()
    near_plane: float = NEAR_PLANE
    harmonics_turn: bool = True
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @functools.cached_property
    def extent(self) -> float:
        """Diagonal of the box that holds the middle 98 % of the centres on each axis: the scene's size."""
        if len(self.means) == 0:
            return 1.0
        low, high = np.quantile(self.means.astype(np.float64), [0.01, 0.99], axis=0)
        return float(max(np.linalg.norm(high - low), 1e-30))

    def object(self, object_id: int) -> SceneObject:
        """The object with this id. Raises KeyError where there is none."""
        for candidate in self.objects:
            if candidate.id == object_id:
                return candidate
        raise KeyError(object_id)
