"""Display of Gaussians in viewports: splats, points, or one ellipsoid each by geometry nodes.

Splats are drawn by the extension. Points are fast for any number of Gaussians. Ellipsoids show size, orientation and
opacity, but are slower. They are instances created by a modifier. Splats and ellipsoids have a modifier that passes the
points on with radius 0, so that Blender does not draw them and the evaluated point cloud keeps them. Point clouds that
Blender itself draws as Gaussian splats are left to it. Under splats, the objects of a scene are drawn in front, which
keeps their lines out of the depth buffer: splats cover them, whether meshes are visible or not.
"""

import bpy

from .. import compat
from . import point_clouds

SPLATS, POINTS, ELLIPSOIDS = "SPLATS", "POINTS", "ELLIPSOIDS"
ITEMS = (  # the numbers are stored in .blend files
    (SPLATS, "Splats", "The trained picture", 2),
    (POINTS, "Points", "A sphere for each Gaussian, with a radius of at most 1.2 % of the scene's extent; fast", 0),
    (ELLIPSOIDS, "Ellipsoids", "Each Gaussian with its size, orientation and opacity; slow above 100,000", 1),
)
MODIFIER = "R5DGS Ellipsoids"
SPLATS_MODIFIER = "R5DGS Splats"
MODIFIERS = (MODIFIER, SPLATS_MODIFIER)
SIGMAS = 1.5  # half axes of an ellipsoid, in standard deviations
JOIN = "GeometryNodeJoinGeometry"
SUBDIVISIONS = 2  # icosphere subdivisions: 80 faces


def show(collection: bpy.types.Collection, display: str) -> None:
    """Set the display of all point clouds of a loaded scene.

    Args:
        collection: Loaded scene of this .blend file.
        display: Key of `ITEMS`.
    """
    clouds = [obj for obj in collection.all_objects if obj.r5dgs.role == "CLOUD" and obj.library is None]
    drawn_here = [cloud for cloud in clouds if not compat.is_gaussian_splat(cloud.data)]
    for name, wanted, make, users in (
        (MODIFIER, ELLIPSOIDS, _ellipsoids, clouds),
        (SPLATS_MODIFIER, SPLATS, _hidden_points, drawn_here),
    ):
        present = [(cloud, cloud.modifiers.get(name)) for cloud in users]
        used = {found.node_group for _, found in present if found is not None and found.node_group is not None}
        tree = None
        if display == wanted and users:
            current = [found.node_group for cloud, found in present if found is not None and not hides_points(cloud)]
            tree = next(filter(None, current), None) or make()
            for cloud, found in present:
                (found or _new_modifier(cloud, name)).node_group = tree
        else:
            for cloud, found in present:
                if found is not None:
                    cloud.modifiers.remove(found)
        for old in used - {tree}:
            _forget(old)
    for obj in collection.all_objects:
        if obj.r5dgs.role in ("ROOT", "ANCHOR", "CLOUD") and obj.library is None:
            obj.show_in_front = display == SPLATS
    collection.r5dgs.display = display


def draws_splats(cloud: bpy.types.Object) -> bool:
    """Return True if a point cloud object is displayed as splats."""
    return cloud.modifiers.get(SPLATS_MODIFIER) is not None


def _new_modifier(cloud: bpy.types.Object, name: str) -> bpy.types.Modifier:
    modifier = cloud.modifiers.new(name, "NODES")
    if name == SPLATS_MODIFIER:  # other engines still render points
        modifier.show_render = modifier.show_expanded = False
    return modifier


def hides_points(cloud: bpy.types.Object) -> bool:
    """Return True if ellipsoids made by an older version hide the points."""
    found = cloud.modifiers.get(MODIFIER)
    tree = None if found is None else found.node_group
    return tree is not None and not any(node.bl_idname == JOIN for node in tree.nodes)


def _forget(tree: bpy.types.NodeTree) -> None:
    """Remove a node tree and its materials if unused."""
    if tree.users or tree.library is not None:
        return
    made = [node.inputs["Material"].default_value for node in tree.nodes if node.bl_idname == "GeometryNodeSetMaterial"]
    bpy.data.node_groups.remove(tree)
    for material in made:
        if material is not None and not material.users:
            bpy.data.materials.remove(material)


def _new_tree(name: str) -> bpy.types.NodeTree:
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    for in_out in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=in_out, socket_type="NodeSocketGeometry")
    return tree


def _hidden_points() -> bpy.types.NodeTree:
    """Geometry node tree that sets the radius of every point to 0."""
    tree = _new_tree(SPLATS_MODIFIER)
    entry, hidden, leave = (
        tree.nodes.new(kind) for kind in ("NodeGroupInput", "GeometryNodeSetPointRadius", "NodeGroupOutput")
    )
    for column, node in enumerate((entry, hidden, leave)):
        node.location = (220 * column, 0)
    hidden.inputs["Radius"].default_value = 0.0
    tree.links.new(entry.outputs[0], hidden.inputs[0])
    tree.links.new(hidden.outputs[0], leave.inputs[0])
    return tree


def _ellipsoids() -> bpy.types.NodeTree:
    """Geometry node tree that places an ellipsoid on every point by its attributes `scale` and `rotation`."""
    material = point_clouds.instance_material(MODIFIER)
    tree = _new_tree(MODIFIER)
    entry, sphere, painted, scale, rotation, instances, hidden, join, leave = (
        tree.nodes.new(kind)
        for kind in (
            "NodeGroupInput",
            "GeometryNodeMeshIcoSphere",
            "GeometryNodeSetMaterial",
            "GeometryNodeInputNamedAttribute",
            "GeometryNodeInputNamedAttribute",
            "GeometryNodeInstanceOnPoints",
            "GeometryNodeSetPointRadius",
            JOIN,
            "NodeGroupOutput",
        )
    )
    for column, nodes in enumerate(
        ((entry, sphere, scale, rotation), (painted,), (instances, hidden), (join,), (leave,))
    ):
        for row, node in enumerate(nodes):
            node.location = (220 * column, -180 * row)
    sphere.inputs["Radius"].default_value = SIGMAS
    sphere.inputs["Subdivisions"].default_value = SUBDIVISIONS
    painted.inputs["Material"].default_value = material
    for node, attribute, kind in ((scale, "scale", "FLOAT_VECTOR"), (rotation, "rotation", "QUATERNION")):
        node.data_type = kind
        node.inputs["Name"].default_value = attribute
    tree.links.new(entry.outputs[0], instances.inputs["Points"])
    tree.links.new(sphere.outputs["Mesh"], painted.inputs["Geometry"])
    tree.links.new(painted.outputs["Geometry"], instances.inputs["Instance"])
    for node, socket in ((scale, "Scale"), (rotation, "Rotation")):
        output = next(out for out in node.outputs if out.enabled and out.name == "Attribute")
        tree.links.new(output, instances.inputs[socket])
    hidden.inputs["Radius"].default_value = 0.0
    tree.links.new(entry.outputs[0], hidden.inputs[0])
    for made in (instances, hidden):
        tree.links.new(made.outputs[0], join.inputs[0])
    tree.links.new(join.outputs[0], leave.inputs[0])
    return tree
