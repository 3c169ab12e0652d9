"""The `Scene` dataclass, content of a `.r5dgs` file: Gaussians at t_max, objects, motion groups and their tracks.

Notation: N Gaussians, M objects, G motion groups, S knots, K SH bases, R Gaussians with residuals. A motion group g
moves its members rigidly, x(t) = p_g + R_g(t) (x(t_max) - p_g) + d_g(t), with pivot p_g, R_g(t_max) = I and
d_g(t_max) = 0. A residual changes a Gaussian in the bind state before its group moves it, and is zero at t_max.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..motion import history
from ..motion.joint import Joint
from ..motion.models import MotionModel
from . import presence
from .array_types import DTYPES
from .cameras import Camera
from .hull import Hull
from .lookup_table import LookupTable
from .units import Units

ROLES = ("pinned", "body", "shadow")
IDENTITY_DIM = 16  # size of an identity encoding (Gaussian Grouping)
NEAR_PLANE = 0.01  # default, world units


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
        rigid_max: Largest of these distances, world units.
        seen: First and last time at which masks localised the object; before them, the track is extrapolated or holds
            its first pose. None if never observed.
        history: Events in the observed time, and the confidence band of the motion past t_max.
        parent: Group of another part of the same object that carries this one past t_max and in Blender, or None.
        joint: Joint with the parent; None without a parent.
        smooth: Motion past t_max without contacts, if ``model`` is a trajectory that has them; else None.
        absent: Times at which the group is not in the scene (`presence`), in order.
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
    history: history.History = history.EMPTY
    parent: int | None = None
    joint: Joint | None = None
    smooth: MotionModel | None = None
    absent: tuple[presence.Interval, ...] = ()

    @property
    def home(self) -> np.ndarray:
        """Position of the group's anchor in Blender at t_max: the point of its joint, or its pivot. [3]"""
        return np.asarray(self.pivot if self.joint is None else self.joint.point, np.float64)

    @property
    def own_model(self) -> MotionModel:
        """Motion past t_max of that anchor, in the frame of its parent if it has one."""
        return self.model if self.joint is None else self.joint.model


@dataclass(frozen=True)
class Gaussians:
    """The Gaussians in their state at t_max, sorted by object id and, within an object, by motion group.

    Attributes:
        means: Centres, world. [N, 3] float32
        quats: Unit wxyz. [N, 4] float32
        log_scales: Natural logarithm of the standard deviations. [N, 3] float32
        opacity_logits: Opacities before the sigmoid. [N] float32
        sh: Spherical harmonics coefficients, 3DGS convention, display-referred sRGB. [N, K, 3] float32
        object_ids: Object of each Gaussian. [N] int32
        motion_ids: Motion group of each Gaussian. [N] int32
        identities: Identity encodings. [N, 16] float16 or None
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    object_ids: np.ndarray
    motion_ids: np.ndarray
    identities: np.ndarray | None = None


@dataclass(frozen=True)
class Tracks:
    """Observed motion of the groups.

    Attributes:
        times: Observed times, increasing, last = t_max. [S] float64
        poses: Rotation wxyz and displacement of each group's pivot relative to the bind state. [G, S, 7] float64
    """

    times: np.ndarray
    poses: np.ndarray


@dataclass(frozen=True)
class Classifier:
    """Linear classifier of identity encodings; row k is the k-th object with id >= 0 of `Scene.objects`.

    Attributes:
        weight: [M + 1, 16] float32
        bias: [M + 1] float32
    """

    weight: np.ndarray
    bias: np.ndarray


@dataclass(frozen=True)
class Residuals:
    """Observed motion of Gaussians that their group does not explain.

    Attributes:
        rows: The Gaussians, increasing. [R] int32
        offsets: Offsets added to their centres at the knots, bind frame. [R, S, 3] float32
        quats: Rotations applied to those of the bind state at the knots (turn q), unit wxyz. [R, S, 4] float32
        log_scales: Offsets added to their log scales at the knots. [R, S, 3] float32
    """

    rows: np.ndarray
    offsets: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray


@dataclass(frozen=True)
class Dynamics:
    """Own motion of each Gaussian past t_max.

    Attributes:
        rates: Velocity of the centre, angular velocity and the rates of both, about the centre at t_max, for mode
            "standard". [N, 12] float32
        canonical_means: Centres in the canonical state, for mode "rigid_paper", world. [N, 3] float32 or None
    """

    rates: np.ndarray
    canonical_means: np.ndarray | None = None


@dataclass(frozen=True)
class Shading:
    """Change of colours as groups rotate in fixed light, by a factor max(rest + (R^T light - light) . vector, 0).

    Attributes:
        vectors: Gradient of the factor as the group rotates by R. [N, 3] float32
        light: Light direction, unit, world. [3] float64
        rest: The factor in the bind state, below 0 for a Gaussian unlit at t_max; None if it is 1 for all. [N] float32
    """

    vectors: np.ndarray
    light: np.ndarray
    rest: np.ndarray | None = None


# Groups of arrays in `Scene`: class, and the names of its arrays in a file by attribute.
GROUPS: dict[str, tuple[type, dict[str, str]]] = {
    "gaussians": (Gaussians, {field.name: field.name for field in dataclasses.fields(Gaussians)}),
    "tracks": (Tracks, {"times": "track_times", "poses": "track_poses"}),
    "classifier": (Classifier, {"weight": "classifier_weight", "bias": "classifier_bias"}),
    "residuals": (
        Residuals,
        {
            "rows": "residual_rows",
            "offsets": "residual_offsets",
            "quats": "residual_quats",
            "log_scales": "residual_log_scales",
        },
    ),
    "dynamics": (Dynamics, {"rates": "dynamics", "canonical_means": "canonical_means"}),
    "shading": (Shading, {"vectors": "shading", "light": "light_direction", "rest": "shading_rest"}),
}
_GROUP_OF = {name: group for group, (_, names) in GROUPS.items() for name in names.values()}


@dataclass(frozen=True)
class Scene:
    """A baked scene, with all data for playback, Blender and export.

    Attributes:
        name: Name of the scene.
        gaussians: The Gaussians.
        objects: The objects, ordered by id.
        groups: The motion groups, ordered by id.
        tracks: Their observed motion.
        t_max: Last observed time.
        frames_per_unit: Blender frames per unit of scene time.
        world_convention: Key of ``cameras.WORLD_TO_BLENDER``.
        cameras: The data set's distinct cameras.
        background_sh: Spherical harmonics of the sky by world viewing direction, 3DGS basis. [Kb, 3]
        classifier: Classifier of the identities, or None.
        residuals: Motion of single Gaussians in the observed time, or None.
        dynamics: Motion of single Gaussians past t_max, or None.
        shading: Change of colours with rotation, or None.
        embeddings: One unit row per object of ``objects``, zero if it has none. [M, D] or None
        vocabulary: Words with stored embeddings.
        vocabulary_embeddings: One unit row per word. [W, D] or None
        lookup: Encoder and match thresholds of the embeddings; None if unknown.
        canonical_embeddings: One unit row per phrase of ``lookup.canonical``. [C, D] or None
        view_embeddings: For each object, one unit row per view of ``lookup.views``, zero-padded. [M, V, D] or None
        provenance: Configuration, data hash, versions.
        needs: The needs table: rows of ``name, value, threshold, decision, reason``.
        near_plane: Near clipping depth of Gaussian centres, as in training; world units.
        harmonics_turn: True if harmonics follow the rotations of Gaussians; those of imported scenes do not.
        origin: Point of the data set's world from which all positions of the scene are measured. Zero unless the
            world's origin is so far away that float32 would lose detail. [3] float64
        hulls: Convex hulls of objects, at most one for each object and motion group.
        units: Units of time and length, if known.
    """

    name: str
    gaussians: Gaussians
    objects: tuple[SceneObject, ...]
    groups: tuple[MotionGroup, ...]
    tracks: Tracks
    t_max: float
    frames_per_unit: float
    world_convention: str
    cameras: tuple[Camera, ...]
    background_sh: np.ndarray
    classifier: Classifier | None = None
    residuals: Residuals | None = None
    dynamics: Dynamics | None = None
    shading: Shading | None = None
    embeddings: np.ndarray | None = None
    vocabulary: tuple[str, ...] = ()
    vocabulary_embeddings: np.ndarray | None = None
    lookup: LookupTable | None = None
    canonical_embeddings: np.ndarray | None = None
    view_embeddings: np.ndarray | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    needs: tuple[dict[str, Any], ...] = ()
    near_plane: float = NEAR_PLANE
    harmonics_turn: bool = True
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    hulls: tuple[Hull, ...] = ()
    units: Units = Units()

    @functools.cached_property
    def extent(self) -> float:
        """Size of the scene: diagonal of the box of the middle 98 % of the centres on each axis, world units."""
        if len(self.gaussians.means) == 0:
            return 1.0
        low, high = np.quantile(self.gaussians.means.astype(np.float64), [0.01, 0.99], axis=0)
        return float(max(np.linalg.norm(high - low), 1e-30))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays by their names in a file, with ``light_direction`` and ``origin``, without missing ones."""
        found = {name: getattr(self, name) for name in (*DTYPES, "origin") if name not in _GROUP_OF}
        for group, (_, names) in GROUPS.items():
            part = getattr(self, group)
            found |= {name: getattr(part, attribute, None) for attribute, name in names.items()}
        return {name: array for name, array in found.items() if array is not None}

    def with_arrays(self, **changes: np.ndarray | None) -> Scene:
        """Return the scene with other arrays, by their names in a file; None removes an optional array."""
        unknown = changes.keys() - {*DTYPES, "light_direction", "origin"}
        if unknown:
            raise TypeError(f"expected names of arrays, got {', '.join(sorted(unknown))}")
        touched = {_GROUP_OF.get(name, name) for name in changes}
        fields = grouped(self.arrays() | changes)
        return dataclasses.replace(self, **{name: fields[name] for name in touched})

    def object(self, object_id: int) -> SceneObject:
        """Return the object with this id. Raises KeyError if there is none."""
        for candidate in self.objects:
            if candidate.id == object_id:
                return candidate
        raise KeyError(object_id)

    def bodies(self, object_id: int) -> list[MotionGroup]:
        """Return the motion groups of an object's own bodies: one, several for an object with parts, or none."""
        return [group for group in self.groups if group.role == "body" and group.object_id == object_id]


def grouped(arrays: Mapping[str, np.ndarray | None]) -> dict[str, Any]:
    """Return fields of `Scene` from arrays by their names in a file.

    A group is None if it has no array. `validation.check` reports an array without the others of its group.
    """
    fields: dict[str, Any] = {name: array for name, array in arrays.items() if name not in _GROUP_OF}
    for group, (kind, names) in GROUPS.items():
        members = {attribute: arrays.get(name) for attribute, name in names.items()}
        fields[group] = None if all(member is None for member in members.values()) else kind(**members)
    return fields
