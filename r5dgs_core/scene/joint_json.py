"""JSON form of the joint of a motion group."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import errors
from ..motion.joint import Joint
from ..motion.models import MotionModel
from .json_row import Row


def to_json(joint: Joint) -> dict[str, Any]:
    """JSON form of a joint."""
    return {
        "kind": joint.kind,
        "axis": None if joint.axis is None else np.asarray(joint.axis, np.float64).tolist(),
        "point": np.asarray(joint.point, np.float64).tolist(),
        "limits": None if joint.limits is None else [float(x) for x in joint.limits],
        "model": joint.model.to_dict(),
        "stop_time": None if joint.stop_time is None else float(joint.stop_time),
    }


def read(row: Row) -> Joint:
    """Inverse of `tree`. Raises `SceneFileError` naming place and key."""
    try:
        model = MotionModel.from_dict(row.get("model", dict))
    except ValueError as error:
        raise errors.SceneFileError(f"{row.place}: model: {error}") from error
    return Joint(
        row.get("kind", str),
        row.numbers("point", (3,)),
        None if row.lacks("axis") else row.numbers("axis", (3,)),
        None if row.lacks("limits") else row.floats("limits", 2),
        model,
        row.optional("stop_time", float),
    )
