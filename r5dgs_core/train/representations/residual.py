"""Residual motion of non-rigid bodies: checkpoint tensors, shading and baking."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ...model.residual_field import Change, ResidualField
from ...model.tracks import Tracks
from ...motion import rotations
from .. import checkpoint_content
from ..observed_motion import PointMotion
from . import shading

PREFIX = "residual."
GAINS = checkpoint_content.RESIDUAL_GAINS


def tensors_of(field: ResidualField) -> dict[str, Tensor]:
    """Return a field as named tensors of a checkpoint."""
    named = {"nodes": field.nodes, "owners": field.owners, "values": field.values.detach()}
    return {f"{PREFIX}{name}": tensor for name, tensor in named.items()}


def residual_of(tensors: Mapping[str, Tensor]) -> ResidualField | None:
    """Return the field in a checkpoint's tensors; None if all bodies are rigid."""
    if f"{PREFIX}values" not in tensors:
        return None
    nodes, owners, values = (tensors[f"{PREFIX}{name}"].clone() for name in ("nodes", "owners", "values"))
    return ResidualField(nodes, owners, values)


def relight(
    change: Change, colors: Tensor, vectors: Tensor, light: Tensor, rotmats: Tensor, groups: Tensor
) -> tuple[Tensor, Tensor]:
    """Shade the members of non-rigid bodies by their own rotations.

    Args:
        change: The members and their rotations.
        colors: Colours of all Gaussians, before the shading. [N, 3]
        vectors: The shading vectors g. [N, 3]
        light: The vector l. [3]
        rotmats: Rotations of the motion groups. [G, 3, 3]
        groups: Group of each member. [n]

    Returns:
        Colours that include the members' shading [N, 3], and shading vectors that are zero for the members [N, 3].
    """
    seen_light = shading.seen_light(change.quats, (light @ rotmats)[groups])
    factor = shading.unclamped_factors(1, vectors[change.rows], seen_light, light)
    return shading.shade_rows(colors, change.rows, factor), vectors.index_fill(0, change.rows, 0.0)


@torch.no_grad()
def point_motion(
    field: ResidualField, tracks: Tracks, tensors: Mapping[str, Tensor]
) -> tuple[PointMotion, dict[str, np.ndarray]]:
    """Return the states of the members of non-rigid bodies at the knots, and the Gaussians that all tracks start from.

    Args:
        field: The residual field.
        tracks: Tracks of the bodies.
        tensors: Tensors of the checkpoint, with all Gaussians.

    Returns:
        States at the knots in training coordinates; and parameters by name, in which members have their shape at the
        last knot, moved back to the canonical state.
    """
    names = ("means", "quats", "log_scales", "sh", "sh_rest", "shading")
    g = {name: tensors[f"gaussians.{name}"].double() for name in names}
    ids, centers = tensors["gaussians.motion_ids"], tracks.group_centers().double()
    opacities = torch.sigmoid(tensors["gaussians.opacity_logits"])
    bind = {name: tensor.numpy().copy() for name, tensor in g.items()}
    rows = np.zeros(0, np.int64)
    states: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for s, t in enumerate(tracks.times):
        change = field.change(
            tensors["gaussians.means"], tensors["gaussians.quats"], opacities, ids, tracks.knot_weights(float(t))
        )
        rows, group = change.rows.numpy(), ids[change.rows]
        means = g["means"][change.rows] + change.offsets
        quats = rotations.multiply(change.quats.double(), rotations.normalize(g["quats"][change.rows]))
        sizes = g["log_scales"][change.rows] + change.log_scales
        if s == len(tracks.times) - 1:
            sh = np.concatenate([bind["sh"], bind["sh_rest"]], axis=1)[rows]
            since, light = change.quats.numpy().astype(np.float64), tensors["light"].numpy().astype(np.float64)
            ones = np.ones(len(rows))
            sh, vectors, lit = shading.rebind(sh, bind["shading"][rows], ones, since, light)
            bind["shading_rest"] = np.ones(len(bind["means"]))
            bind["shading_rest"][rows] = lit
            state = {"means": means.numpy(), "quats": quats.numpy(), "log_scales": sizes.numpy()}
            for name, value in (state | {"sh": sh[:, :1], "sh_rest": sh[:, 1:], "shading": vectors}).items():
                bind[name][rows] = value
        turn = tracks.knot_quats()[:, s].double()[group]
        shift = centers[group] + tracks.params["translations"][:, s].double()[group]
        moved = shift + rotations.rotate(turn, means - centers[group])
        states.append((moved.numpy(), rotations.multiply(turn, quats).numpy(), sizes.numpy()))
    means, quats, sizes = (np.stack(parts, 1) for parts in zip(*states, strict=True))
    return PointMotion(rows, means, quats, sizes), bind
