"""Summary of a scene for ``r5dgs info --json``."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..scene import predictability, presence
from ..scene.scene import Scene
from . import scene_player


def info(scene: Scene) -> dict[str, Any]:
    """Return the output of `r5dgs info --json` as JSON types."""
    outlooks = predictability.outlooks(scene)
    return {
        "name": scene.name,
        "gaussians": len(scene.gaussians.means),
        "sh_degree": int(np.sqrt(scene.gaussians.sh.shape[1])) - 1,
        "objects": [
            {"id": o.id, "name": o.name, "aliases": list(o.aliases), "gaussians": o.count} | outlooks[o.id].prediction()
            for o in scene.objects
        ],
        "motion_groups": [
            {
                "id": g.id,
                "object": g.object_id,
                "role": g.role,
                "gaussians": int((scene.gaussians.motion_ids == g.id).sum()),
                "model": g.model.kind if g.follows is None else f"follows {g.follows}",
                "rigid_rms": g.rigid_rms,
                **({"absent": presence.to_json(g.absent)} if g.absent else {}),
                **({} if g.joint is None else {"parent": g.parent, "joint": g.joint.text()}),
            }
            for g in scene.groups
        ],
        "times": [float(scene.tracks.times[0]), scene.t_max],
        "horizon": predictability.horizon(scene),
        "knots": len(scene.tracks.times),
        "frames_per_unit": scene.frames_per_unit,
        "world_convention": scene.world_convention,
        **scene.units.to_json(),
        "cameras": len(scene.cameras),
        "extent": scene.extent,
        **({"origin": scene.origin.tolist()} if scene.origin.any() else {}),
        "identities": scene.gaussians.identities is not None,
        "shading": scene.shading is not None,
        "residuals": 0 if scene.residuals is None else len(scene.residuals.rows),
        "modes": list(scene_player.modes(scene)),
        "vocabulary": len(scene.vocabulary),
        "lookup": None if scene.lookup is None else f"{scene.lookup.encoder.kind} {scene.lookup.encoder.name}",
        "needs": list(scene.needs),
    }
