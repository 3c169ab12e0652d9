"""The `Scene` dataclass, content of a `.r5dgs` file: Gaussians at t_max, objects, motion groups and their tracks.

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
IDENTITY_DIM = 16  # size of an identity encoding (Gaussian Grouping)
NEAR_PLANE = 0.01  # default, world units
EMBEDDINGS = ("embeddings", "vocabulary_embeddings", "canonical_embeddings", "view_embeddings")
# In-memory dtypes of the arrays of a scene file, in file order.
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
    """One object of a scene; its Gaussians are the rows ``start : start + count``.

    Attributes:
        id: Object id; 0 is the background, -1 the unassigned Gaussians.
        name: Display name, unique in the scene.
        aliases: Other names, for search.
        caption: Description, or "".
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
        object_id: Object that the group belongs to; for a shadow, the object that casts it.
        role: "pinned", "body" or "shadow".
        anchor_index: Row of the representative Gaussian, -1 without members.
        pivot: Centre of rotation of ``track_poses``, at t_max, world. [3]
        model: Motion past t_max, about ``pivot``.
        follows: Group whose displacement, mapped by ``follow_matrix``, moves this one without rotation, or None.
        follow_matrix: Linear map from that group's displacement to this one's. [3, 3]
        rigid_rms: Root mean square distance of members from this rigid motion in the observed time, world units.
        rigid_max: The same as a maximum.
        seen: First and last time at which masks localised the object; before them, the track is extrapolated or holds
            its first pose. None if never observed.
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
    """A baked scene, with all data for playback, Blender and export.

    Gaussians are in their state at t_max, sorted by object id and, within an object, by motion group.

    Attributes:
        name: Name of the scene.
        means: Centres, world. [N, 3] float32
        quats: Unit wxyz. [N, 4] float32
        log_scales: Natural logarithm of the standard deviations. [N, 3] float32
        opacity_logits: Opacities before the sigmoid. [N] float32
        sh: Spherical harmonics coefficients, 3DGS convention, display-referred sRGB. [N, K, 3] float32
        object_ids: Object of each Gaussian. [N] int32
        motion_ids: Motion group of each Gaussian. [N] int32
        track_times: Observed times, increasing, last = t_max. [S] float64
        track_poses: Rotation wxyz and displacement of the pivot relative to the bind state. [G, S, 7] float64
        objects: The objects, ordered by id.
        groups: The motion groups, ordered by id.
        t_max: Last observed time.
        frames_per_unit: Blender frames per unit of scene time.
        world_convention: Key of ``cameras.WORLD_TO_BLENDER``.
        cameras: The data set's distinct cameras.
        background_sh: Spherical harmonics of the sky by world viewing direction, 3DGS basis. [Kb, 3]
        identities: Identity encodings. [N, 16] float16 or None
        classifier_weight: Linear classifier of identities; row k is the k-th object with id >= 0 of ``objects``.
            [M + 1, 16] float32 or None
        classifier_bias: Its bias, in the same order. [M + 1] float32 or None
        residual_rows: Gaussians whose observed motion their group does not explain, increasing. [R] int32 or None
        residual_offsets: Offsets added to their centres at the knots, bind frame. [R, S, 3] float32 or None
        residual_quats: Rotations applied to those of the bind state at the knots (turn q), unit wxyz. [R, S, 4] float32
            or None
        residual_log_scales: Offsets added to their log scales at the knots. [R, S, 3] float32 or None
        dynamics: Own motion of each Gaussian past t_max, for mode "standard": velocity of its centre, angular velocity
            and the rates of both, about its centre at t_max. [N, 12] float32 or None
        canonical_means: Centres in the canonical state, for mode "rigid_paper", world. [N, 3] float32 or None
        shading: Gradient g of the colour factor max(rest + (R^T l - l) . g, 0) as the group rotates by R. [N, 3]
            float32 or None
        shading_rest: The factor in the bind state, below 0 for a Gaussian unlit at t_max; None if it is 1 for all. [N]
            float32 or None
        light_direction: l above, unit, world. [3]
        embeddings: One unit row per object of ``objects``, zero if it has none. [M, D] or None
        vocabulary: Words with stored embeddings.
        vocabulary_embeddings: One unit row per word. [W, D] or None
        lookup: Encoder and match thresholds of the embeddings; None if unknown.
        canonical_embeddings: One unit row per phrase of ``lookup.canonical``. [C, D] or None
        view_embeddings: For each object, one unit row per view of ``lookup.views``, zero-padded. [M, V, D] or None
        provenance: Configuration, data hash, versions.
        needs: The needs table: rows of ``name, value, threshold, decision, reason``.
        near_plane: Near clipping depth of Gaussian centres, as in training; world units.
        harmonics_turn: True if harmonics also follow the rotations of individual Gaussians; imported scenes of other
            projects keep them in the world frame.
        origin: Point of the data set's world from which all positions of the scene are measured:
            world = origin + position. Zero unless the world's origin is so far away that float32 would lose detail. [3]
            float64
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
        """Size of the scene: diagonal of the box of the middle 98 % of the centres on each axis, world units."""
        if len(self.means) == 0:
            return 1.0
        low, high = np.quantile(self.means.astype(np.float64), [0.01, 0.99], axis=0)
        return float(max(np.linalg.norm(high - low), 1e-30))

    def object(self, object_id: int) -> SceneObject:
        """Return the object with this id. Raises KeyError if there is none."""
        for candidate in self.objects:
            if candidate.id == object_id:
                return candidate
        raise KeyError(object_id)
