"""Confidence tubes around extrapolated paths: 95 % bands.

The radius is the half width of the stored band. If there is no band, or the motion was edited, it is two standard
deviations of the position, computed from the covariance of the rates, in which edited rates count as exact. The tube is
a mesh with the anchor's parent. It is not rendered and not selectable. Its colour shows the uncertainty relative to the
object's size.
"""

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.motion import confidence, models
from .. import compat
from ..scene import timeline
from . import curve_place, fcurves, physics

_MAX_STEPS = 1 << 16  # maximum integration steps of a path, because its uncertainty takes hundreds of integrations
STEPS = 32  # number of rings past t_max
SIDES = 12
THINNEST = 0.004  # minimum radius as a fraction of the object's reach, so that certain paths stay visible
COLOR = "confidence"
SURE, UNSURE = (0.05, 0.6, 0.3), (0.9, 0.15, 0.05)  # linear RGB
LOST = 1.0  # half width at which the colour is `UNSURE`, as a fraction of the object's reach
SIGMAS = 2.0  # half width of a 95 % band in standard deviations


def helper_of(anchor: bpy.types.Object) -> bpy.types.Object | None:
    """Tube of an anchor, or None."""
    return anchor.r5dgs_motion.tube


def moves(anchor: bpy.types.Object, times: timeline.Times) -> bool:
    """True if an anchor moves past t_max."""
    return times.t_end > times.t_max and not physics.model(physics.mover(anchor)).is_static


def show(anchor: bpy.types.Object, times: timeline.Times) -> bpy.types.Object | None:
    """Create or update the tube of an anchor, or remove it if the anchor does not move past t_max.

    Raises:
        ConfigError: The anchor's F-curves cannot be read, or the motion is too fast.
    """
    if not moves(anchor, times):
        hide(anchor)
        return None
    centers, widths = path(anchor, times)
    _, reach = physics.key_error(anchor)
    reach = max(reach, 1e-9)
    tube = helper_of(anchor)
    if tube is None:
        name = f"{anchor.name.removesuffix(' anchor')} confidence"
        mesh = bpy.data.meshes.new(name)
        tube = bpy.data.objects.new(name, mesh)
        mesh.materials.append(_material())
        for collection in anchor.users_collection:
            collection.objects.link(tube)
        tube.hide_render = tube.hide_select = True
        tube.show_in_front = True  # it begins inside the object
        anchor.r5dgs_motion.tube = tube
    tube.parent = anchor.parent
    tube.matrix_parent_inverse = anchor.matrix_parent_inverse
    doubts = np.clip(widths / (LOST * reach), 0.0, 1.0)
    _fill(tube.data, centers, np.maximum(widths, THINNEST * reach), doubts)
    tube.color = (*_color(doubts[-1:])[0], 1.0)  # for viewports with object colours
    return tube


def refresh(anchor: bpy.types.Object, times: timeline.Times) -> None:
    """Update the tube of an anchor if it has one."""
    if helper_of(anchor) is not None:
        show(anchor, times)


def hide(anchor: bpy.types.Object) -> bool:
    """Remove the tube of an anchor. Returns True if it had one."""
    tube = helper_of(anchor)
    if tube is None:
        return False
    anchor.r5dgs_motion.tube = None
    mesh, material = tube.data, tube.data.materials[0] if tube.data.materials else None
    bpy.data.objects.remove(tube)
    bpy.data.meshes.remove(mesh)
    if material is not None and material.users == 0:
        bpy.data.materials.remove(material)
    return True


def path(anchor: bpy.types.Object, times: timeline.Times) -> tuple[np.ndarray, np.ndarray]:
    """Positions of an anchor past t_max in its parent's axes, and half widths of their 95 % band.

    Returns:
        Positions [H, 3] and half widths [H], at even times from t_max to the end and at impacts.

    Raises:
        ConfigError: The motion is too fast to integrate, or the F-curves cannot be read.
    """
    start, _ = fcurves.pose_at(anchor, curve_place.find(anchor), times.frame(times.t_max))
    follow = physics.follow_matrix(anchor.r5dgs_motion)
    model = physics.model(physics.mover(anchor))
    end = times.t_end - times.t_max
    tau = np.union1d(np.linspace(0.0, end, STEPS + 1), models.kinks(model, end))
    if models.steps_needed(model, tau[-1:])[0] > _MAX_STEPS:
        raise errors.ConfigError(f"{anchor.name}: moves too fast for a path; lower the rates under Motion")
    _, displacements = models.evaluate(model, tau)
    band = physics.band(physics.mover(anchor))
    widths = SIGMAS * confidence.position_sigma(model, tau) if band is None else band.widths(times.t_max + tau)
    if follow is not None:
        displacements = displacements @ follow.T
        widths = widths * float(np.linalg.norm(follow, 2))
    return start + displacements, widths


def _fill(mesh: bpy.types.Mesh, centers: np.ndarray, radii: np.ndarray, doubts: np.ndarray) -> None:
    """Write a tube to a mesh: centres [H, 3], radii [H], uncertainty from 0 to 1 [H]."""
    count = len(centers)
    rings = _rings(centers)
    points = centers[:, None] + radii[:, None, None] * rings
    a = (np.arange(count - 1)[:, None] * SIDES + np.arange(SIDES)).ravel()
    b = (np.arange(count - 1)[:, None] * SIDES + (np.arange(SIDES) + 1) % SIDES).ravel()
    faces = np.stack([a, b, b + SIDES, a + SIDES], axis=-1)
    mesh.clear_geometry()
    mesh.from_pydata(points.reshape(-1, 3).tolist(), [], faces.tolist())
    colors = np.repeat(np.concatenate([_color(doubts), np.ones((count, 1))], axis=-1), SIDES, axis=0)
    attribute = mesh.attributes.get(COLOR) or mesh.attributes.new(COLOR, "FLOAT_COLOR", "POINT")
    attribute.data.foreach_set("color", colors.astype(np.float32).ravel())
    mesh.attributes.active_color_name = COLOR
    mesh.update()


def _color(doubts: np.ndarray) -> np.ndarray:
    """Colour of an uncertainty in [0, 1]. [H] -> [H, 3] linear"""
    return (1 - doubts[:, None]) * np.array(SURE) + doubts[:, None] * np.array(UNSURE)


def _rings(centers: np.ndarray) -> np.ndarray:
    """Unit circles perpendicular to a path, transported along it without twist. [H, 3] -> [H, SIDES, 3]"""
    along = np.gradient(centers, axis=0)
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    along = np.where(length > 1e-12, along / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    side = np.eye(3)[int(np.argmin(np.abs(along[0])))]
    angles = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    rings = np.empty((len(centers), SIDES, 3))
    for k, axis in enumerate(along):
        across = side - (side @ axis) * axis
        if np.linalg.norm(across) < 1e-6:  # the path turned parallel to the last side vector
            across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        side = across / np.linalg.norm(across)
        rings[k] = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(axis, side)
    return rings


def _material() -> bpy.types.Material:
    """Unlit material shared by all tubes, created if missing."""
    name = "R5DGS confidence"
    found = bpy.data.materials.get(name)
    if found is not None:
        return found
    result = bpy.data.materials.new(name)
    result.diffuse_color = (*(0.5 * (np.array(SURE) + np.array(UNSURE))), 1.0)
    tree = compat.empty_nodes(result)
    attribute = tree.nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = COLOR
    emission = tree.nodes.new("ShaderNodeEmission")
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    attribute.location, emission.location, output.location = (-400, 0), (-150, 0), (50, 0)
    tree.links.new(attribute.outputs["Color"], emission.inputs["Color"])
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    return result
