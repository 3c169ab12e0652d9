"""Gaussians as attributes of a point cloud, under the names that Blender 5.3 draws as splats, and their material."""

import bpy
import numpy as np

from ..r5dgs_core.scene.scene import Scene
from . import compat

# A colour attribute named exactly `color` renders black in Cycles, hence this name.
DISPLAY_COLOR = "display_color"
# Spheres stand for Gaussians in viewports without splats; large or faint ones would hide what lies behind them.
DISPLAY_SIGMAS = 1.2
LARGEST_DISPLAY_RADIUS = 0.012  # of the scene's size
C0 = 0.28209479177387814  # spherical harmonic of degree 0


def srgb_to_linear(srgb: np.ndarray) -> np.ndarray:
    """Display-referred sRGB in [0, 1] to linear light, as Blender's colours are. Any shape."""
    srgb = np.clip(srgb, 0.0, 1.0)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def fill(cloud: bpy.types.PointCloud, scene: Scene, rows: slice, extent: float, view_dependence: bool) -> None:
    """Write Gaussians to a point cloud of as many points.

    Attributes: `position`; `scale` (standard deviations) and `rotation` (wxyz); `radiance:base` (degree-0 coefficients
    and opacity) and `radiance:sh_<k>` (the others), as trained: display-referred; `object_id`; and for display `radius`
    and `display_color` (linear).

    Args:
        cloud: The point cloud.
        scene: The scene.
        rows: Its rows to write.
        extent: The scene's size.
        view_dependence: Whether to write the coefficients above degree 0.
    """
    sh = scene.sh[rows]
    log_scales = scene.log_scales[rows]
    opacities = 1.0 / (1.0 + np.exp(-scene.opacity_logits[rows].astype(np.float64)))
    base = np.concatenate([sh[:, 0], opacities[:, None]], axis=-1)
    shown = srgb_to_linear(0.5 + C0 * sh[:, 0].astype(np.float64))
    radii = DISPLAY_SIGMAS * np.sqrt(opacities) * np.exp(log_scales.mean(-1))
    radii = np.minimum(radii, LARGEST_DISPLAY_RADIUS * extent)
    _write(cloud, "position", "FLOAT_VECTOR", "vector", scene.means[rows])
    _write(cloud, "radius", "FLOAT", "value", radii)
    _write(cloud, "scale", "FLOAT_VECTOR", "vector", np.exp(log_scales))
    _write(cloud, "rotation", "QUATERNION", "value", scene.quats[rows])
    _write(cloud, "radiance:base", "FLOAT_COLOR", "color", base)
    if view_dependence:
        for k in range(1, sh.shape[1]):
            _write(cloud, f"radiance:sh_{k - 1}", "FLOAT_VECTOR", "vector", sh[:, k])
    _write(cloud, "object_id", "INT", "value", scene.object_ids[rows], np.int32)
    _write(cloud, DISPLAY_COLOR, "FLOAT_COLOR", "color", np.concatenate([shown, opacities[:, None]], axis=-1))
    compat.make_gaussian_splat(cloud)
    cloud.update_tag()  # without it 4.2 keeps a stale evaluated copy


def show_tint(cloud: bpy.types.PointCloud, tint: np.ndarray) -> None:
    """Write `display_color` of a filled point cloud anew: its own colours times a tint.

    Args:
        cloud: The point cloud; one without `radiance:base` is left as it is.
        tint: Factors on display-referred sRGB. [3]
    """
    stored = cloud.attributes.get("radiance:base")
    if stored is None:
        return
    base = np.empty(4 * len(cloud.points), np.float32)
    stored.data.foreach_get("color", base)
    colors = base.reshape(-1, 4).astype(np.float64)
    colors[:, :3] = srgb_to_linear(tint * (0.5 + C0 * colors[:, :3]))
    _write(cloud, DISPLAY_COLOR, "FLOAT_COLOR", "color", colors)
    cloud.update_tag()


def material(name: str) -> bpy.types.Material:
    """A material that shows `display_color` as it is, without light."""
    result = bpy.data.materials.new(name)
    tree = compat.emission_nodes(result)
    attribute = tree.nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = DISPLAY_COLOR
    emission = tree.nodes.new("ShaderNodeEmission")
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    attribute.location, emission.location, output.location = (-400, 0), (-150, 0), (50, 0)
    tree.links.new(attribute.outputs["Color"], emission.inputs["Color"])
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    return result


def _write(cloud, name: str, kind: str, field: str, values: np.ndarray, dtype: type = np.float32) -> None:
    attribute = cloud.attributes.get(name) or cloud.attributes.new(name, kind, "POINT")
    attribute.data.foreach_set(field, np.ascontiguousarray(values, dtype).ravel())
