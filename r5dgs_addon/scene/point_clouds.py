"""Storage of Gaussians as point cloud attributes, named as Blender 5.3 expects for splats, and their materials."""

import ctypes
import hashlib

import bpy
import numpy as np

from ...r5dgs_core.color import srgb
from ...r5dgs_core.scene import diffuse_shading, spherical_harmonics
from ...r5dgs_core.scene.scene import Scene
from ...r5dgs_core.scene.splats import to_opacities
from .. import compat

# Not `color`: a colour attribute of exactly that name renders black in Cycles.
DISPLAY_COLOR = "display_color"
ROW = "gaussian"
HARMONICS = "radiance:sh_"
SHADING, SHADING_REST = "shading", "shading_rest"
BIND = "bind_state:"  # prefix of attributes that keep the values overwritten by Exact Mode
FINGERPRINTS = "r5dgs_fingerprints"  # custom property of point clouds
WRITTEN = "r5dgs_exact_written"  # custom property of point clouds: fingerprints and time of what Exact Mode wrote
_BLOCK = 2048
# Display radius of Gaussians in viewports without splats, limited so that large or faint ones hide little.
DISPLAY_SIGMAS = 1.2
LARGEST_DISPLAY_RADIUS = 0.012  # as a fraction of the scene's extent


def fill(cloud: bpy.types.PointCloud, scene: Scene, rows: slice, extent: float, sh_degree: int) -> None:
    """Write Gaussians to a point cloud with the same number of points.

    Attributes: `position`; `scale` (standard deviations) and `rotation` (wxyz); `radiance:base` (degree-0 coefficients
    and opacity) and `radiance:sh_<k>` (the others), display-referred as trained; `object_id`; `gaussian`, the row in
    the scene file, kept when other points are deleted; and for display, `radius` and `display_color` (linear).

    Args:
        scene: Source scene.
        rows: Rows of the scene to write.
        extent: Extent of the scene.
        sh_degree: Highest degree of the coefficients to write, at most 3.
    """
    sh = scene.gaussians.sh[rows]
    log_scales = scene.gaussians.log_scales[rows]
    opacities = to_opacities(scene.gaussians.opacity_logits[rows])
    base = np.concatenate([sh[:, 0], opacities[:, None]], axis=-1)
    shown = srgb.to_linear(np.minimum(0.5 + spherical_harmonics.C0 * sh[:, 0].astype(np.float64), 1))
    radii = DISPLAY_SIGMAS * np.sqrt(opacities) * np.exp(log_scales.mean(-1))
    radii = np.minimum(radii, LARGEST_DISPLAY_RADIUS * extent)
    written = {
        "position": _write(cloud, "position", "FLOAT_VECTOR", "vector", scene.gaussians.means[rows]),
        "radius": _write(cloud, "radius", "FLOAT", "value", radii),
        "scale": _write(cloud, "scale", "FLOAT_VECTOR", "vector", np.exp(log_scales)),
        "rotation": _write(cloud, "rotation", "QUATERNION", "value", scene.gaussians.quats[rows]),
        "radiance:base": _write(cloud, "radiance:base", "FLOAT_COLOR", "color", base),
        ROW: _write(cloud, ROW, "INT", "value", np.arange(rows.start, rows.stop), np.int32),
    }
    for k, plane in enumerate(_planes(sh[:, 1 : (sh_degree + 1) ** 2])):
        written[f"{HARMONICS}{k}"] = _write(cloud, f"{HARMONICS}{k}", "FLOAT_VECTOR", "vector", plane)
    if scene.shading is not None:
        _write(cloud, SHADING, "FLOAT_VECTOR", "vector", scene.shading.vectors[rows])
        _write(cloud, SHADING_REST, "FLOAT", "value", diffuse_shading.rest_factors(scene)[rows])
    cloud[FINGERPRINTS] = {name: fingerprint(values) for name, values in written.items()}
    _write(cloud, "object_id", "INT", "value", scene.gaussians.object_ids[rows], np.int32)
    _write(cloud, DISPLAY_COLOR, "FLOAT_COLOR", "color", np.concatenate([shown, opacities[:, None]], axis=-1))
    compat.make_gaussian_splat(cloud)
    cloud.update_tag()  # otherwise 4.2 keeps a stale evaluated copy


def fingerprint(values: np.ndarray) -> str:
    """Return a digest that changes with any edit of an array; much faster than a cryptographic hash of all bytes."""
    data = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
    cut = len(data) // (8 * _BLOCK) * 8 * _BLOCK
    blocks = data[:cut].view(np.uint64).reshape(-1, _BLOCK)
    digest = hashlib.blake2b(str(len(data)).encode(), digest_size=16)
    for part in (blocks.sum(0, dtype=np.uint64), blocks.sum(1, dtype=np.uint64), data[cut:]):
        digest.update(part)
    return digest.hexdigest()


def fingerprints(cloud: bpy.types.PointCloud) -> dict[str, str]:
    """Return the stored fingerprints of the loaded attributes by name; empty for files of older versions."""
    stored = cloud.get(FINGERPRINTS)
    return {} if stored is None else stored.to_dict()


def attribute(cloud: bpy.types.PointCloud, name: str, kind: str) -> bpy.types.Attribute | None:
    """Return an attribute of the points, or None if it is missing or has another type."""
    found = cloud.attributes.get(name)
    return found if found is not None and found.data_type == kind and found.domain == "POINT" else None


def read(source: bpy.types.Attribute, field: str, width: int, dtype: type = np.float32) -> np.ndarray:
    """Return the values of an attribute. [n, width]"""
    values = np.empty(len(source.data) * width, dtype)
    source.data.foreach_get(field, values)
    return values.reshape(-1, width)


def view(source: bpy.types.Attribute, field: str, width: int, dtype: type = np.float32) -> np.ndarray:
    """Return the values of an attribute without a copy if they are contiguous in memory. [n, width]

    The array is read-only and valid until Blender changes the attribute.
    """
    count, size = len(source.data), width * np.dtype(dtype).itemsize
    if count == 0:
        return np.empty((0, width), dtype)
    first = source.data[0].as_pointer()
    if source.data[count - 1].as_pointer() - first != (count - 1) * size:
        return read(source, field, width, dtype)
    buffer = (ctypes.c_char * (count * size)).from_address(first)
    return np.frombuffer(buffer, dtype).reshape(count, width)


def show_tint(cloud: bpy.types.PointCloud, tint: np.ndarray) -> None:
    """Update `display_color` of a filled point cloud to its own colours times a tint.

    Args:
        cloud: Point cloud; unchanged if it lacks `radiance:base`.
        tint: Factors of display-referred sRGB. [3]
    """
    stored = cloud.attributes.get("radiance:base")
    if stored is None:
        return
    base = np.empty(4 * len(cloud.points), np.float32)
    stored.data.foreach_get("color", base)
    colors = base.reshape(-1, 4).astype(np.float64)
    colors[:, :3] = srgb.to_linear(np.minimum(tint * (0.5 + spherical_harmonics.C0 * colors[:, :3]), 1))
    _write(cloud, DISPLAY_COLOR, "FLOAT_COLOR", "color", colors)
    cloud.update_tag()


def material(name: str) -> bpy.types.Material:
    """Return a new unlit material that shows `display_color`."""
    result = bpy.data.materials.new(name)
    nodes = compat.empty_nodes(result)
    _, emission, output = _emission(nodes, "GEOMETRY")
    nodes.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    return result


def instance_material(name: str) -> bpy.types.Material:
    """Like `material`, for instances on the points, with the opacity of the Gaussians."""
    result = bpy.data.materials.new(name)
    nodes = compat.empty_nodes(result)
    attribute, emission, output = _emission(nodes, "INSTANCER")
    clear, mix = nodes.nodes.new("ShaderNodeBsdfTransparent"), nodes.nodes.new("ShaderNodeMixShader")
    clear.location, mix.location = (-150, 150), (50, 0)
    output.location = (250, 0)
    nodes.links.new(attribute.outputs["Alpha"], mix.inputs[0])
    nodes.links.new(clear.outputs[0], mix.inputs[1])
    nodes.links.new(emission.outputs[0], mix.inputs[2])
    nodes.links.new(mix.outputs[0], output.inputs["Surface"])
    return result


def _emission(tree: bpy.types.NodeTree, source: str) -> list[bpy.types.Node]:
    """Return attribute, emission and output nodes, the first two linked."""
    kinds = ("ShaderNodeAttribute", "ShaderNodeEmission", "ShaderNodeOutputMaterial")
    attribute, emission, output = (tree.nodes.new(kind) for kind in kinds)
    attribute.attribute_type, attribute.attribute_name = source, DISPLAY_COLOR
    attribute.location, emission.location, output.location = (-400, 0), (-150, 0), (50, 0)
    tree.links.new(attribute.outputs["Color"], emission.inputs["Color"])
    return [attribute, emission, output]


def _planes(sh: np.ndarray) -> np.ndarray:
    """Transpose coefficients in blocks that fit the processor's cache. [N, K, 3] -> [K, N, 3]"""
    count, bases, _ = sh.shape
    result = np.empty((bases, count, 3), np.float32)
    for start in range(0, count, 4096):
        result[:, start : start + 4096] = sh[start : start + 4096].swapaxes(0, 1)
    return result


def _write(cloud, name: str, kind: str, field: str, values: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """Write an attribute, created if missing. Returns the values in the attribute's dtype."""
    attribute = cloud.attributes.get(name) or cloud.attributes.new(name, kind, "POINT")
    values = np.ascontiguousarray(values, dtype)
    attribute.data.foreach_set(field, values.ravel())
    return values
