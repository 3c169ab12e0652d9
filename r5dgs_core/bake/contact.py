"""Stage of baking: motions past t_max with contacts, for bodies whose smooth motion passes through something."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from typing import Any

from ..contact import held_out, scene_future
from ..contact.scene_future import Prediction
from ..errors import BackendError, Interrupted, R5dgsError
from ..motion import restitution
from ..scene import slipped_rotations
from .draft import Context, Draft, Need

NAME = "contact"
log = logging.getLogger(__name__)


def apply(draft: Draft, context: Context) -> Draft:
    """Replace the motion of bodies that touch others past t_max, and list them in the needs table."""
    if context.wanted.contact == "off":
        return draft
    try:
        found = scene_future.predict(slipped_rotations.unknown(draft.scene, draft.slipped))
    except BackendError as error:
        log.warning("a predicted motion passes through another body or the ground; %s", error)
        return draft
    except Interrupted:
        raise
    except R5dgsError as error:
        log.warning("no contacts are predicted: %s", error)
        return draft
    for line in found.lines:
        log.warning("%s", line)
    if not found.taken:
        return draft
    scene = dataclasses.replace(draft.scene, groups=found.groups)
    return dataclasses.replace(draft, scene=scene, parts=(*draft.parts, *_rows(found)))


def needs(rows: Sequence[dict[str, Any]], found: Prediction) -> tuple[dict[str, Any], ...]:
    """Return the rows of a needs table with those of a new prediction."""
    return (*(row for row in rows if row.get("name") != NAME), *_rows(found))


def _rows(found: Prediction) -> list[dict[str, Any]]:
    rows, bodies = [], () if found.world is None else found.world.bodies
    simulated = {body.name: (body, material) for body, material in zip(bodies, found.materials, strict=True)}
    for name, material in found.taken.items():
        value, threshold = found.penetrations.get(name, 0.0), scene_future.PENETRATION
        reason = "without contacts, it passes into others, in sizes" if value else "is pushed or hit by another body"
        if name == found.leaving:
            reason = "moves off the edge of its support"
        if (compared := found.compared.get(name)) is not None and compared.better:
            value, threshold = compared.smooth - compared.contact, held_out.BETTER
            reason = f"no smooth law explains its last motion; {compared.text()}"
        row = {"object": name, **Need(NAME, value, threshold, True, f"{reason}; {material}").row()}
        if name in simulated:
            body, own = simulated[name]  # the id, as users change names
            row |= {"object_id": body.group.object_id}
            row |= {"friction": own.friction, "restitution": restitution.limited(own.restitution)}
            row |= {"simulation": numbers} if (numbers := _simulation(found, name)) else {}
        rows.append(row)
    return rows


def _simulation(found: Prediction, name: str) -> dict[str, Any]:
    """Ground of a body and MuJoCo's numbers of its contacts, scene units; empty if its support has an edge."""
    assert found.world is not None and found.recording is not None
    made, number = found.world.world, [body.name for body in found.world.bodies].index(name)
    if made.plane is None or made.edge is not None or len(found.recording.times) < 2:
        return {}
    floor = made.bodies[number].floor
    normal = restitution.reference(found.materials[number].restitution, found.recording.frequency)
    return {
        "normal": made.plane.normal.tolist(),
        "height": made.plane.height if floor is None else floor,
        "solref": list(normal),
        "solreffriction": list(restitution.grip(normal)),
        "flat_foot": not found.world.bodies[number].moves,
        "timestep": float(found.recording.times[1] - found.recording.times[0]),
    }
