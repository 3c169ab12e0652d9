"""Gaussians as vertex attributes of glTF meshes: KHR_gaussian_splatting, and our own attributes for shading.

Positions are relative to the mesh's node, and harmonics are those of the bind frame, so that both move with the node of
the group. Colours are those of t_max: `SHADING` and, if a factor at t_max is not 1, `HARMONICS` hold
the rest. Names of attributes of an application start with "_"; other programs skip them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..color import srgb, tints
from ..motion import rotations
from ..scene import diffuse_shading, spherical_harmonics
from ..scene.scene import Scene
from ..scene.splats import Splats, to_opacities
from .gltf import Arrays, Content

EXTENSION = "KHR_gaussian_splatting"
SHADING = "_R5DGS_SHADING"  # shading vector and factor at t_max
HARMONICS = "_R5DGS_SH_"  # followed by the number of the coefficient: harmonics without shading
_POINTS = 0  # mode of a primitive
_LARGEST_LOGIT = 16.0  # float32 opacities do not resolve larger ones
_SMALLEST = 1e-38  # scale, within the range of float32
_SETTINGS = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}


def harmonic_names(count: int) -> list[str]:
    """Names of the attributes of the first ``count`` harmonics."""
    pairs = [(degree, k) for degree in range(spherical_harmonics.MAX_DEGREE + 1) for k in range(2 * degree + 1)]
    return [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}" for degree, k in pairs[:count]]


def mesh(scene: Scene, rows: slice, origin: np.ndarray, factors: np.ndarray | None, arrays: Arrays, name: str) -> Any:
    """Add a mesh of Gaussians and return its JSON.

    Args:
        scene: The scene.
        rows: The Gaussians, of one motion group.
        origin: Position of the mesh's node at t_max. [3]
        factors: Factor on the colour of each Gaussian of the scene at t_max, or None. [N]
        arrays: Arrays of the file.
        name: Name of the mesh.
    """
    gaussians, sh = scene.gaussians, scene.gaussians.sh[rows]
    frozen = sh if factors is None else tints.tint_sh(sh, factors[rows, None])
    quats = rotations.normalize(gaussians.quats[rows].astype(np.float64))
    columns = {
        "POSITION": gaussians.means[rows] - origin,
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(gaussians.log_scales[rows].astype(np.float64)).clip(_SMALLEST),
        f"{EXTENSION}:OPACITY": to_opacities(gaussians.opacity_logits[rows]),
        "COLOR_0": _fallback(frozen[:, 0]),
    }
    columns |= {name: frozen[:, k] for k, name in enumerate(harmonic_names(sh.shape[1]))}
    if scene.shading is not None:
        rest, vectors = diffuse_shading.rest_factors(scene)[rows], scene.shading.vectors[rows]
        if vectors.any() or (rest != 1).any():
            columns[SHADING] = np.concatenate([vectors, rest[:, None]], axis=1)
        if (rest != 1).any():
            columns |= {f"{HARMONICS}{k}": sh[:, k] for k in range(sh.shape[1])}
    attributes = {
        name: arrays.add(values, vertices=True, bounds=name == "POSITION") for name, values in columns.items()
    }
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: _SETTINGS}}
    return {"name": name, "primitives": [primitive]}


def _fallback(dc: np.ndarray) -> np.ndarray:
    """Linear colours of points, for programs without the extension. [N, 3] -> [N, 4] uint8"""
    linear = srgb.to_linear(np.clip(spherical_harmonics.dc_to_rgb(dc.astype(np.float64)), 0, 1))
    return np.rint(255 * np.concatenate([linear, np.ones((len(linear), 1))], axis=1)).astype(np.uint8)


def read(content: Content, mesh: dict[str, Any], user: str) -> tuple[Splats, np.ndarray | None]:
    """Inverse of `mesh`: Gaussians relative to the anchor, and shading vectors with factors at t_max. [N, 4] or None

    Raises:
        SceneFileError: An attribute is missing or damaged.
    """
    primitives = mesh.get("primitives")
    primitive = primitives[0] if isinstance(primitives, list) and len(primitives) == 1 else None
    names = primitive.get("attributes") if isinstance(primitive, dict) else None
    if not isinstance(names, dict):
        raise content.error(f"{user}: expected one primitive with attributes, found {primitives!r:.60}")

    def column(name: str, width: int) -> np.ndarray:
        return content.floats(names.get(name), width, f"{user}: {name}")

    means = column("POSITION", 3)
    own = HARMONICS + "0" in names
    count = sum(name.startswith(HARMONICS if own else f"{EXTENSION}:SH_DEGREE_") for name in names)
    if count not in (1, 4, 9, 16):
        raise content.error(f"{user}: expected 1, 4, 9 or 16 harmonics, found {count}")
    listed = [f"{HARMONICS}{k}" for k in range(count)] if own else harmonic_names(count)
    opacities = column(f"{EXTENSION}:OPACITY", 1).astype(np.float64)
    least = float(to_opacities(np.array(-_LARGEST_LOGIT)))
    opacities = opacities.clip(least, 1 - least)
    splats = {
        "quats": rotations.normalize(column(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]].astype(np.float64)),
        "log_scales": np.log(column(f"{EXTENSION}:SCALE", 3).clip(_SMALLEST)),
        "opacity_logits": np.log(opacities / (1 - opacities)),
        "sh": np.stack([column(name, 3) for name in listed], axis=1),
    }
    shading = column(SHADING, 4) if SHADING in names else None
    for name, values in (splats | ({} if shading is None else {SHADING: shading})).items():
        if len(values) != len(means):
            raise content.error(f"{user}: {name}: expected {len(means)} rows as in POSITION, found {len(values)}")
    return Splats(means=means, **{name: values.astype(np.float32) for name, values in splats.items()}), shading
