"""Motions of a scene file past t_max with contacts, for Blender."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .. import errors
from ..contact import scene_bodies, scene_future
from ..contact.scene_world import Wishes
from ..protocol import fields
from ..protocol.contacts import ContactRequest
from ..scene import history_json, scene_file, world_axes
from ..scene.scene import Scene


def predict(request: dict[str, Any]) -> dict[str, Any]:
    """Answer a `ContactRequest`.

    Returns:
        ``motions``: group, ``model`` (`MotionModel.to_dict`), ``smooth``, the model without contacts, ``history`` and
        ``material``, the friction and restitution without the user's changes, of each body that gets contacts;
        ``taken``: its material in words by name; ``lines``: the reasons why others do not.

    Raises:
        ConfigError: A field is invalid, or nothing can collide with an obstacle.
        BackendError: Contacts are needed and MuJoCo is not installed.
        SceneFileError: The scene cannot be read.
    """
    asked = ContactRequest.from_json(request)
    fields.stamp_of(asked.scene)
    scene = scene_bodies.without_contacts(scene_file.read(Path(asked.scene)))
    materials = {
        group: (asked.frictions.get(group), asked.restitutions.get(group))
        for group in asked.frictions.keys() | asked.restitutions.keys()
    }
    wishes = Wishes(
        materials=materials,
        masses=asked.masses,
        gravity=None if asked.gravity is None else -asked.gravity * _up(scene),
        obstacles=asked.obstacles,
        until=max(asked.until, scene.t_max),
    )
    found = scene_future.predict(scene, wishes)
    fitted = {} if found.world is None else found.world.fitted()
    motions = [
        {
            "group": group.id,
            "model": group.model.to_dict(),
            "smooth": group.smooth.to_dict(),
            "history": history_json.to_json(group.history),
            "material": fitted.get(group.id),
        }
        for group in found.groups
        if group.smooth is not None
    ]
    return {"motions": motions, "taken": dict(found.taken), "lines": list(found.lines)}


def _up(scene: Scene) -> np.ndarray:
    up = world_axes.UP_AXIS.get(scene.world_convention)
    if up is None:
        raise errors.ConfigError(
            f"{scene.name}: its axes do not define up; clear the checkbox of Gravity in the panel Contact"
        )
    return up
