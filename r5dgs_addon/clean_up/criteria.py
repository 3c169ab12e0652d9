"""Selection of floaters and crop box: criteria with live preview, stored with the scene."""

from collections.abc import Iterator

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty
from mathutils import Vector

from ...r5dgs_core import errors
from ..scene import point_clouds, selection
from . import floaters, selected_points

BOX = "R5DGS Crop Box"
SCOPES = (
    ("ALL", "All Objects", "Gaussians of all objects"),
    ("SELECTED", "Selected Objects", "Gaussians of the selected objects"),
)
SIDES = (
    ("OUTSIDE", "Outside", "Gaussians whose center is outside the box"),
    ("INSIDE", "Inside", "Gaussians whose center is inside the box"),
)


def _follow(state, context) -> None:
    """Update the selection if it is live."""
    if not state.live:
        return
    try:
        state.problem = ""
        select(context, state.id_data, "SET")
    except errors.R5dgsError as error:
        state.problem = str(error)


def _share(name: str, default: float, description: str):
    return FloatProperty(
        name=name,
        description=f"{description}, in percent of the object's radius (90% of its Gaussians lie within it)",
        default=default,
        min=0.0,
        soft_max=10 * default,
        precision=1,
        subtype="PERCENTAGE",
        update=_follow,
    )


def _switch(name: str, description: str, default: bool = True):
    return BoolProperty(name=name, description=description, default=default, update=_follow)


class R5DGS_PG_clean_up(bpy.types.PropertyGroup):
    """Criteria of *Clean Up* for a loaded scene; a Gaussian that meets one of them is selected."""

    live: BoolProperty(
        name="Live", description="Select again at each change of a criterion", options=set(), update=_follow
    )
    problem: StringProperty(name="Problem", description="Error of the live selection", options={"HIDDEN"})
    scope: EnumProperty(name="Objects", description="Objects to examine", items=SCOPES, update=_follow)
    by_opacity: _switch("Faint", "Select Gaussians with a low opacity")
    opacity: FloatProperty(
        name="Opacity Below",
        description="Gaussians with a lower opacity are selected (0 to 1)",
        default=0.02,
        min=0.0,
        max=1.0,
        precision=3,
        subtype="FACTOR",
        update=_follow,
    )
    by_size: _switch("Large", "Select Gaussians that are large for their object")
    size: _share("Size Above", 100.0, "A Gaussian is selected if its largest standard deviation exceeds this")
    by_isolation: _switch("Isolated", "Select Gaussians with few neighbors of the same object")
    isolation: _share(
        "Within Distance", 10.0, "Size of grid cells; the neighbors of a Gaussian are in its cell and the 26 around it"
    )
    neighbors: IntProperty(
        name="Neighbors Below",
        description="Gaussians with fewer neighbors are selected",
        default=3,
        min=1,
        soft_max=50,
        update=_follow,
    )
    by_distance: _switch("Distant", "Select Gaussians far from the center of their object")
    distance: _share("Distance Above", 300.0, "Gaussians at a larger distance are selected")
    by_box: _switch("Crop Box", "Select Gaussians on one side of the crop box", False)
    box: PointerProperty(
        name="Box",
        description="Empty whose cube is the crop box; move, turn and scale it",
        type=bpy.types.Object,
        poll=lambda self, obj: obj.type == "EMPTY",
        update=_follow,
    )
    side: EnumProperty(name="Side", description="Side of the box to select", items=SIDES, update=_follow)


def of(collection: bpy.types.Collection) -> R5DGS_PG_clean_up:
    """Criteria of a loaded scene."""
    return collection.r5dgs_clean_up


def select(context: bpy.types.Context, collection: bpy.types.Collection, mode: str) -> int:
    """Select the Gaussians that meet a criterion of a loaded scene.

    Args:
        context: Context whose frame and selected objects count.
        collection: Loaded scene.
        mode: Key of `selected_points.MODES`.

    Returns:
        Number of selected Gaussians afterwards.

    Raises:
        ConfigError: A cloud cannot be edited, or the crop box is missing or flat.
    """
    state = of(collection)
    inverse = _box_inverse(context, state) if state.by_box else None
    chosen = {object_id for scene, object_id in selection.selected(context) if scene == collection}

    def masks(members: list[bpy.types.Object]) -> Iterator[np.ndarray]:
        found = _object_masks(state, members)
        for cloud, marked in zip(members, found, strict=True):
            if state.scope == "SELECTED" and cloud.r5dgs.object_id not in chosen:
                yield np.zeros(len(marked), bool)
                continue
            if inverse is not None:
                inside = _in_box(context, cloud, inverse)
                marked = marked | (inside if state.side == "INSIDE" else ~inside)
            yield marked

    return selected_points.select(collection, mode, masks)


def _object_masks(state: R5DGS_PG_clean_up, members: list[bpy.types.Object]) -> list[np.ndarray]:
    """Masks of the points that meet a criterion of their object, in the bind state. [n] each"""
    parts: dict[int, list[int]] = {}
    for number, cloud in enumerate(members):
        parts.setdefault(cloud.r5dgs.object_id, []).append(number)
    result = [np.zeros(len(cloud.data.points), bool) for cloud in members]
    for numbers in parts.values():
        means, scales, opacities = (
            np.concatenate(columns) for columns in zip(*(_values(members[k].data) for k in numbers), strict=True)
        )
        marked = np.zeros(len(means), bool)
        if state.by_opacity:
            marked |= opacities < state.opacity
        if state.by_size:
            marked |= floaters.is_large(means, scales, state.size / 100)
        if state.by_isolation:
            marked |= floaters.is_isolated(means, state.isolation / 100, state.neighbors)
        if state.by_distance:
            marked |= floaters.is_distant(means, state.distance / 100)
        ends = np.cumsum([len(result[k]) for k in numbers])
        for k, part in zip(numbers, np.split(marked, ends[:-1]), strict=True):
            result[k] = part
    return result


def _values(cloud: bpy.types.PointCloud) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres and sizes in the bind state, and opacities. [n, 3], [n, 3], [n]

    Raises:
        ConfigError: An attribute is missing.
    """
    found = []
    for name, kind, field, width in (
        ("position", "FLOAT_VECTOR", "vector", 3),
        ("scale", "FLOAT_VECTOR", "vector", 3),
        ("radiance:base", "FLOAT_COLOR", "color", 4),
    ):
        values = point_clouds.attribute(cloud, point_clouds.BIND + name, kind)
        values = values or point_clouds.attribute(cloud, name, kind)
        if values is None:
            raise errors.ConfigError(f"{cloud.name}: expected the attribute '{name}', found none; load the scene again")
        found.append(point_clouds.read(values, field, width))
    return found[0], found[1], found[2][:, 3]


def _in_box(context: bpy.types.Context, cloud: bpy.types.Object, inverse: np.ndarray) -> np.ndarray:
    """Mask of the points of a cloud inside the crop box at the current frame. [n]"""
    position = point_clouds.attribute(cloud.data, "position", "FLOAT_VECTOR")
    matrix = inverse @ np.array(cloud.evaluated_get(context.evaluated_depsgraph_get()).matrix_world, np.float64)
    places = point_clouds.read(position, "vector", 3) @ matrix[:3, :3].T + matrix[:3, 3]
    return (np.abs(places) <= 1).all(1)


def _box_inverse(context: bpy.types.Context, state: R5DGS_PG_clean_up) -> np.ndarray:
    """Map from Blender's world to the crop box, whose half axes are 1. [4, 4]"""
    box = state.box
    if box is None:
        raise errors.ConfigError("clean up: expected a crop box, found none; press Add Crop Box, or choose an empty")
    matrix = np.array(box.evaluated_get(context.evaluated_depsgraph_get()).matrix_world, np.float64)
    matrix[:3, :3] *= box.empty_display_size
    if abs(np.linalg.det(matrix)) < 1e-30:
        raise errors.ConfigError(f"{box.name}: expected a box with volume, found a scale of 0; enlarge it")
    return np.linalg.inv(matrix)


def add_box(context: bpy.types.Context, collection: bpy.types.Collection) -> bpy.types.Object:
    """Add a crop box around the named objects of a loaded scene, make it active, and use it."""
    box = bpy.data.objects.new(BOX, None)
    box.empty_display_type, box.empty_display_size = "CUBE", 1.0
    context.collection.objects.link(box)
    members = selected_points.clouds(collection)
    named = [cloud for cloud in members if cloud.r5dgs.object_id > 0] or members
    corners = [cloud.matrix_world @ Vector(corner) for cloud in named for corner in cloud.bound_box]
    ends = np.array([*corners] or [(-1, -1, -1), (1, 1, 1)], np.float64)
    box.location = (ends.min(0) + ends.max(0)) / 2
    box.scale = np.maximum(np.ptp(ends, axis=0) / 2, 1e-3)
    for other in context.selected_objects:
        other.select_set(False)
    box.select_set(True)
    context.view_layer.objects.active = box
    context.view_layer.update()
    state = of(collection)
    state.box, state.by_box = box, True
    return box


def register():
    """Register the criteria on collections."""
    bpy.utils.register_class(R5DGS_PG_clean_up)
    bpy.types.Collection.r5dgs_clean_up = PointerProperty(type=R5DGS_PG_clean_up)


def unregister():
    """Undo `register`."""
    del bpy.types.Collection.r5dgs_clean_up
    bpy.utils.unregister_class(R5DGS_PG_clean_up)
