"""What differs between Blender versions, found by feature and not by number. Nothing else asks for a version."""

import atexit

import bpy

# In newer versions a path property has to say that it may begin with "//"; before, there is no such word.
_SAYS_RELATIVE = "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties
PATH_OPTIONS = {"PATH_SUPPORTS_BLEND_RELATIVE"} if _SAYS_RELATIVE else set()
KEYFRAME = bpy.types.Keyframe.bl_rna


def new_point_cloud(name: str, count: int, collection: bpy.types.Collection) -> bpy.types.Object:
    """Make a point cloud object of ``count`` points at the origin, linked to a collection of the active view layer.

    `PointCloud.resize` came with 5.1; before it, a geometry-nodes Points node is applied.

    Args:
        name: Name of the object and its data.
        count: Number of points, at least 1.
        collection: Where to link it. It has to be in the active view layer and not excluded there.

    Returns:
        The object.
    """
    cloud = bpy.data.pointclouds.new(name)
    obj = bpy.data.objects.new(name, cloud)
    collection.objects.link(obj)
    if hasattr(cloud, "resize"):
        cloud.resize(count)
        return obj
    tree = bpy.data.node_groups.new("R5DGS points", "GeometryNodeTree")
    try:
        tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
        output = tree.nodes.new("NodeGroupOutput")
        points = tree.nodes.new("GeometryNodePoints")
        points.inputs["Count"].default_value = count
        tree.links.new(points.outputs[0], output.inputs[0])
        modifier = obj.modifiers.new("R5DGS points", "NODES")
        modifier.node_group = tree
        with bpy.context.temp_override(object=obj, active_object=obj):
            bpy.ops.object.modifier_apply(modifier=modifier.name)
    finally:
        bpy.data.node_groups.remove(tree)
    return obj


def make_gaussian_splat(cloud: bpy.types.PointCloud) -> bool:
    """Have the host draw a point cloud as Gaussian splats, where it can (5.3 on). Returns whether it can."""
    kind = cloud.bl_rna.properties.get("type")
    if kind is None or "GAUSSIAN_SPLAT" not in kind.enum_items:
        return False
    cloud.type = "GAUSSIAN_SPLAT"
    return True


def new_fcurves(obj: bpy.types.Object, name: str):
    """Give an object an empty action of its own and return that action's collection of F-curves.

    4.2 and 4.3 keep F-curves on the action; from 4.4 on they lie in a channel bag of a slot.
    """
    animation = obj.animation_data_create()
    action = bpy.data.actions.new(name)
    if "slots" not in action.bl_rna.properties:
        animation.action = action
        return action.fcurves
    slot = action.slots.new(id_type="OBJECT", name=obj.name)
    strip = action.layers.new("Layer").strips.new(type="KEYFRAME")
    bag = strip.channelbag(slot, ensure=True)
    animation.action = action
    animation.action_slot = slot
    return bag.fcurves


def fcurves(obj: bpy.types.Object):
    """The F-curves that move an object; empty where it has none."""
    animation = obj.animation_data
    if animation is None or animation.action is None:
        return ()
    action = animation.action
    if "slots" not in action.bl_rna.properties:
        return action.fcurves
    for layer in action.layers:
        for strip in layer.strips:
            bag = strip.channelbag(animation.action_slot) if animation.action_slot else None
            if bag is not None:
                return bag.fcurves
    return ()


def keyframe_enum(property_name: str, item: str) -> int:
    """Number of an enum item of `bpy.types.Keyframe`, for ``foreach_set``."""
    return KEYFRAME.properties[property_name].enum_items[item].value


def emission_nodes(material: bpy.types.Material) -> bpy.types.NodeTree:
    """The empty node tree of a material; ``use_nodes`` is deprecated, and always true, from 5.0 on."""
    if material.node_tree is None:
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return material.node_tree


def call_at_exit(unregister) -> None:
    """Unregister before Python ends in the bpy module, which crashes there while panels or menus are registered.

    Blender itself disables its extensions in time.
    """
    if not bpy.app.binary_path:  # true of the module only
        atexit.register(unregister)


def do_not_call_at_exit(unregister) -> None:
    """Undo `call_at_exit`."""
    atexit.unregister(unregister)
