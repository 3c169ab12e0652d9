"""Motion of an anchor past t_max: learned motion stored in the .blend, and edits of its fields (`motion_fields`).

Unedited fields keep the precision of the file: a rate counts as edited if it differs from the learned one in float32.
"""

import functools
import hashlib
import json
from collections.abc import Iterable
from dataclasses import replace

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.formats import rigid_bodies
from ...r5dgs_core.motion import confidence, models, restitution, rotations, torque_free_rotation
from ...r5dgs_core.motion.history import EMPTY as NO_HISTORY
from ...r5dgs_core.motion.history import Band, History
from ...r5dgs_core.motion.models import MotionModel
from ...r5dgs_core.scene import history_json, json_row
from ...r5dgs_core.scene.scene import Scene
from ..scene import timeline
from ..ui import plural
from . import curve_place, fcurves, motion_fields

RATES = tuple(motion_fields.VECTORS)
_MIN_MOMENT = 1e-3  # minimum moment of inertia of flat or thin bodies, as a fraction of the largest
_parsed = functools.lru_cache(maxsize=1024)(json.loads)  # for panels; callers must not change the result


def remember(
    anchors: dict[tuple[int, int], bpy.types.Object],
    scene: Scene,
    times: timeline.Times,
    tolerance: float,
    reaches: np.ndarray,
) -> None:
    """Store the learned motions of a scene on its anchors, so that editing does not need the scene file.

    Args:
        anchors: Anchors by (object id, motion id): (object id, 0) for the pinned Gaussians of an object, (0, motion id)
            for any other motion group.
        scene: Source scene.
        times: Times of the scene.
        tolerance: Maximum error of the keys, as a fraction of the scene's extent.
        reaches: Reach of the motion groups, from `keyframes.reaches`. [G]
    """
    extent, materials = scene.extent, rigid_bodies.materials(scene)
    for (_, motion_id), anchor in anchors.items():
        group = scene.groups[motion_id]
        leader = anchors.get((0, group.follows)) if group.follows else None
        state = anchor.r5dgs_motion
        state.learned = json.dumps(
            {
                "model": group.own_model.to_dict(),
                "smooth": None if group.smooth is None else group.smooth.to_dict(),
                "stop_time": None if group.joint is None else group.joint.stop_time,
                "history": history_json.to_json(group.history),
                "follow_matrix": None if group.follow_matrix is None else np.asarray(group.follow_matrix).tolist(),
                "reach": float(reaches[motion_id]) if motion_id else 0.0,
                "allowed": tolerance * extent,
                "material": materials.get(group.object_id) if motion_id else None,
            }
        )
        show_material(anchor)
        state.frames_per_unit = scene.frames_per_unit
        state.leader = state.learned_leader = leader
        set_fields(state, group.own_model)
        store_digests(anchor, times)


def store_digests(anchor: bpy.types.Object, times: timeline.Times) -> None:
    """Store digests of the keys past t_max and of their motion, for `hand_edited` and `is_written`."""
    place = curve_place.find(anchor)
    anchor.r5dgs_motion.written = fcurves.digest(place, times.frame(times.t_max))
    anchor.r5dgs_motion.written_motion = _digest(anchor)


def is_written(anchor: bpy.types.Object) -> bool:
    """True if the keys past t_max match the motion in the fields."""
    return anchor.r5dgs_motion.written_motion == _digest(anchor)


def _digest(anchor: bpy.types.Object) -> str:
    state = anchor.r5dgs_motion
    fields = [list(getattr(state, f"stored_{name}")) for name in models.RATES]
    leader = state.leader.name if follow_matrix(state) is not None else ""
    others = {name: value for name, value in stored(state).items() if name not in models.RATES and np.any(value)}
    frequency = others.pop("frequency", 0.0)
    more = [{name: np.asarray(value).tolist() for name, value in others.items()}] if others else []
    # Without `more`, this is the text of older versions.
    text = json.dumps([state.taken, state.kind, *fields, frequency, leader, *more])
    return hashlib.sha1(text.encode(), usedforsecurity=False).hexdigest()


def hand_edited(anchor: bpy.types.Object, times: timeline.Times) -> bool:
    """True if the keys past t_max differ from the last written ones.

    Raises:
        ConfigError: The curves cannot be read.
    """
    place = curve_place.find(anchor)
    return fcurves.digest(place, times.frame(times.t_max)) != anchor.r5dgs_motion.written


def too_fast(anchors: Iterable[bpy.types.Object]) -> str:
    """Warning that names the anchors whose motion is too fast for keys, or ""."""
    names = [anchor.name for anchor in anchors if anchor.r5dgs_motion.too_fast]
    if not names:
        return ""
    return (
        f"Keys are exact only at frames, because the motion is too fast: {plural.names(names)}; lower the rates under "
        "Motion, or train with more frames per unit of time"
    )


def has_motion(anchor: bpy.types.Object) -> bool:
    """True if an anchor has a learned motion."""
    return bool(anchor.r5dgs_motion.learned)


def material(anchor: bpy.types.Object) -> tuple[float, float] | None:
    """Return the fitted friction and bounciness of a body; None if no contacts were fitted."""
    found = _parsed(anchor.r5dgs_motion.learned or "{}").get("material")
    return None if found is None else (found[0], restitution.ASSUMED if found[1] is None else found[1])


def show_material(anchor: bpy.types.Object) -> None:
    """Set the fields of the panel *Contact* that the user has not ticked to the fitted material, if there is one."""
    fitted, own = material(anchor), anchor.r5dgs_contact
    if fitted is not None and not own.use_friction:
        own.friction = fitted[0]
    if fitted is not None and not own.use_bounciness:
        own.bounciness = fitted[1]


def has_contact(anchor: bpy.types.Object) -> bool:
    """True if the learned motion of an anchor has contacts, even if they are switched off."""
    return has_motion(anchor) and _parsed(anchor.r5dgs_motion.learned).get("smooth") is not None


def set_fields(state: bpy.types.PropertyGroup, model: MotionModel) -> None:
    """Set the fields of an anchor to a motion."""
    state.kind = model.kind
    for name in models.FIELDS:
        setattr(state, f"stored_{name}", getattr(model, name))
    state.stored_pivot = (0.0, 0.0, 0.0)


def copy_motion(source: bpy.types.Object, target: bpy.types.Object, turn: np.ndarray) -> None:
    """Copy the motion of an anchor without a leader to another anchor, which keeps its learned motion stored.

    Args:
        source: Anchor with the motion.
        target: Anchor that receives it.
        turn: Rotation of the target relative to the source, in the frame of the source, unit wxyz. [4]
    """
    giver, taker = source.r5dgs_motion, target.r5dgs_motion
    base = basis(giver)
    if base.inertia is not None:  # inertia of the source in the world, in the target's frame
        back = rotations.quats_to_rotmats(rotations.conjugate(turn))
        base = replace(base, inertia=back @ base.inertia @ back.T)
    taker.taken = json.dumps(base.to_dict())
    taker.kind, taker.leader = giver.kind, None
    for name in (*models.FIELDS, "pivot"):
        setattr(taker, f"stored_{name}", getattr(giver, f"stored_{name}"))


def reset(anchor: bpy.types.Object) -> None:
    """Reset the fields of an anchor to the learned motion."""
    state = anchor.r5dgs_motion
    state.taken = ""
    set_fields(state, basis(state))
    state.leader = state.learned_leader


def basis(state: bpy.types.PropertyGroup) -> MotionModel:
    """Motion before edits of the fields: from the scene file, or taken from another object."""
    if state.taken:
        return MotionModel.from_dict(_parsed(state.taken))
    return MotionModel.from_dict(_parsed(state.learned)["model"]) if state.learned else models.STATIC


def stop_time(anchor: bpy.types.Object) -> float | None:
    """Time past t_max at which an anchor reaches a limit of its joint, or None; unknown once the motion is edited."""
    state = anchor.r5dgs_motion
    return None if state.taken or not state.learned or edited(state) else _parsed(state.learned).get("stop_time")


def history(anchor: bpy.types.Object) -> History:
    """Observed events of an anchor and the band of its learned motion; empty for files of older versions."""
    return _history(anchor.r5dgs_motion.learned)


@functools.lru_cache(maxsize=1024)
def _history(learned: str) -> History:
    stored = _parsed(learned).get("history", {}) if learned else {}
    try:
        return history_json.read(json_row.Row(stored, "history"))
    except errors.R5dgsError:  # written by a newer version
        return NO_HISTORY


def band(anchor: bpy.types.Object) -> Band | None:
    """Confidence band of an anchor's motion, or None if it is unknown or the motion was edited."""
    state = anchor.r5dgs_motion
    return None if state.taken or edited(state) else history(anchor).band


def stored(state: bpy.types.PropertyGroup) -> dict[str, np.ndarray | float]:
    """Rates of the fields by name, as in `MotionModel`."""
    vectors = {name: np.array(getattr(state, f"stored_{name}"), np.float64) for name in RATES}
    return {**vectors, **{name: getattr(state, f"stored_{name}") for name in models.SCALARS}}


def edited(state: bpy.types.PropertyGroup) -> set[str]:
    """Names of the fields that differ from the `basis`."""
    model = basis(state)
    found = {
        name for name, value in stored(state).items() if (np.float32(value) != np.float32(getattr(model, name))).any()
    }
    return found | ({"kind"} if state.kind != model.kind else set())


def model(anchor: bpy.types.Object) -> MotionModel:
    """Current motion of an anchor from its fields, relative to its pose at t_max.

    A learned motion blends from the noisy last observed pose to the path fitted to all observations. An edited motion
    starts exactly with the displayed rates. Edited rates are treated as exact; the covariance covers the others.

    Raises:
        ConfigError: A field has an invalid value.
    """
    state = anchor.r5dgs_motion
    base, changed = basis(state), edited(state)
    values = {name: value for name, value in stored(state).items() if name in changed}
    if changed:
        values.update(offset_rotvec=np.zeros(3), offset_displacement=np.zeros(3))
    if "kind" in changed:
        body = inertia(anchor) if models.KINDS[state.kind].needs_inertia else None
        values.update(kind=state.kind, inertia=body, knots=None)
    try:
        return confidence.with_exact_fields(replace(base, **values), changed)
    except ValueError as error:
        raise errors.ConfigError(f"{anchor.name}: {error}") from error


def smooth(anchor: bpy.types.Object) -> MotionModel:
    """Current motion of an anchor, without the contacts of a learned trajectory. Raises ConfigError as `model`."""
    state, current = anchor.r5dgs_motion, model(anchor)
    kept = _parsed(state.learned).get("smooth") if state.learned and not state.taken else None
    return current if current.knots is None or kept is None else MotionModel.from_dict(kept)


def inertia(anchor: bpy.types.Object) -> np.ndarray:
    """Inertia of an anchor's points about their centre in the bind state, up to a factor. [3, 3]"""
    points = _points(anchor)
    if len(points) == 0:
        return np.eye(3) / 3
    body = torque_free_rotation.inertia(points)
    return body + _MIN_MOMENT * float(np.linalg.eigvalsh(body)[-1]) * np.eye(3)


def set_allowed_error(anchor: bpy.types.Object, error: float) -> None:
    """Set the allowed error of an anchor's keys, in scene units."""
    kept = _parsed(anchor.r5dgs_motion.learned)
    anchor.r5dgs_motion.learned = json.dumps({**kept, "allowed": error})


def size(anchor: bpy.types.Object) -> float:
    """Object size of an anchor: twice the radius used to weigh its learned motion, in scene units."""
    kept = _parsed(anchor.r5dgs_motion.learned)
    return 2.0 * (kept["model"]["radius"] if kept["reach"] else key_error(anchor)[1])


def _points(anchor: bpy.types.Object) -> np.ndarray:
    """Centres of an anchor's Gaussians in the bind state. [n, 3] float64"""
    parts = [np.zeros((0, 3))]
    for cloud in anchor.children:
        if cloud.r5dgs.role == "CLOUD" and cloud.type == "POINTCLOUD":
            points = np.empty(3 * len(cloud.data.points), np.float32)
            cloud.data.attributes["position"].data.foreach_get("vector", points)
            parts.append(points.reshape(-1, 3))
    return np.concatenate(parts).astype(np.float64)


def key_error(anchor: bpy.types.Object) -> tuple[float, float]:
    """Allowed error of an anchor's keys, and largest distance of its points from it, in scene units."""
    kept = _parsed(anchor.r5dgs_motion.learned)
    return kept["allowed"], kept["reach"] or _reach(anchor)


def _reach(anchor: bpy.types.Object) -> float:
    points = _points(anchor) - np.array(anchor.r5dgs.pivot, np.float64)
    return float(np.linalg.norm(points, axis=-1).max(initial=0.0))


def follow_matrix(state: bpy.types.PropertyGroup) -> np.ndarray | None:
    """Linear map from the leader's displacement to this anchor's, or None without leader. [3, 3]"""
    if state.leader is None:
        return None
    matrix = _parsed(state.learned)["follow_matrix"]
    return np.eye(3) if matrix is None else np.array(matrix, np.float64)


def mover(anchor: bpy.types.Object) -> bpy.types.Object:
    """Anchor whose motion applies: the leader, or the anchor itself."""
    return anchor.r5dgs_motion.leader or anchor
