"""What differs between Blender versions, found by feature and not by number. Nothing else asks for a version."""

import atexit
from collections.abc import Sequence

import bpy

# In newer versions a path property has to say that it may begin with "//"; before, there is no such word.
_SAYS_RELATIVE = "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties
PATH_OPTIONS = {"PATH_SUPPORTS_BLEND_RELATIVE"} if _SAYS_RELATIVE else set()
KEYFRAME = bpy.types.Keyframe.bl_rna


def new_point_clouds(counts: Sequence[int]) -> list[bpy.types.PointCloud]:
    """Make point clouds of so many points each, at the origin; no object uses them yet.

    `PointCloud.resize` came with 5.1; before it, what geometry nodes make in a scene of their own is copied.

    Args:
        counts: Number of points of each, at least 1.

    Returns:
        The point clouds, in that order.
    """
    if hasattr(bpy.types.PointCloud, "resize"):
        clouds = [bpy.data.pointclouds.new("R5DGS points") for _ in counts]
        for cloud, count in zip(clouds, counts, strict=True):
            cloud.resize(count)
        return clouds
    scene, made = bpy.data.scenes.new("R5DGS points"), []
    try:
        sources = []
        for count in counts:
            cloud = bpy.data.pointclouds.new("R5DGS points")
            tree = bpy.data.node_groups.new("R5DGS points", "GeometryNodeTree")
            source = bpy.data.objects.new("R5DGS points", cloud)
            made += [source, cloud, tree]
            sources.append(source)
            scene.collection.objects.link(source)
            tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
            output = tree.nodes.new("NodeGroupOutput")
            points = tree.nodes.new("GeometryNodePoints")
            points.inputs["Count"].default_value = count
            tree.links.new(points.outputs[0], output.inputs[0])
            source.modifiers.new("R5DGS points", "NODES").node_group = tree
        layer = scene.view_layers[0]
        layer.update()
        return [source.evaluated_get(layer.depsgraph).data.copy() for source in sources]
    finally:
        bpy.data.batch_remove(made)
        remove_scene(scene)


def remove_scene(scene: bpy.types.Scene) -> None:
    """Remove a scene that no window shows.

    ``scenes.remove`` asks the window what it shows, and up to 4.4 crashes where there is none, as in `blender -b -a`.
    """
    bpy.data.batch_remove([scene])


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
    return channels(animation.action, slot_of(animation))


def slot_of(user: bpy.types.AnimData | bpy.types.NlaStrip):
    """The slot of its action that an object or a strip of the NLA plays; None where actions have no slots."""
    return getattr(user, "action_slot", None)


def channels(action: bpy.types.Action, slot):
    """The F-curves of an action for one of its slots; empty where it has none."""
    if "slots" not in action.bl_rna.properties:
        return action.fcurves
    for layer in action.layers if slot is not None else ():
        for strip in layer.strips:
            bag = strip.channelbag(slot)
            if bag is not None:
                return bag.fcurves
    return ()


def own_fcurves(obj: bpy.types.Object, name: str):
    """The F-curves that move an object, where new ones can be added; an action is made where it has none."""
    animation = obj.animation_data
    if animation is None or animation.action is None:
        return new_fcurves(obj, name)
    action = animation.action
    if "slots" not in action.bl_rna.properties:
        return action.fcurves
    if animation.action_slot is None:
        animation.action_slot = action.slots.new(id_type="OBJECT", name=obj.name)
    layer = action.layers[0] if action.layers else action.layers.new("Layer")
    strip = layer.strips[0] if layer.strips else layer.strips.new(type="KEYFRAME")
    return strip.channelbag(animation.action_slot, ensure=True).fcurves


def play(obj: bpy.types.Object, action: bpy.types.Action, slot) -> None:
    """Give an object an action, and in it the slot that a slot of the same action or of one it was copied from is."""
    animation = obj.animation_data_create()
    animation.action = action
    choose_slot(animation, slot)


def choose_slot(user: bpy.types.AnimData | bpy.types.NlaStrip, slot) -> None:
    """Let an object or a strip play the slot of its action that has the handle of a given one; None does nothing."""
    if slot is not None:
        user.action_slot = next(other for other in user.action.slots if other.handle == slot.handle)


def keyframe_enum(property_name: str, item: str) -> int:
    """Number of an enum item of `bpy.types.Keyframe`, for ``foreach_set``."""
    return KEYFRAME.properties[property_name].enum_items[item].value


def empty_nodes(material: bpy.types.Material) -> bpy.types.NodeTree:
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
        atexit.unregister(_forget_properties)
        atexit.register(_forget_properties)  # before the other: the last one registered is called first
        atexit.register(unregister)


def do_not_call_at_exit(unregister) -> None:
    """Undo `call_at_exit`."""
    atexit.unregister(unregister)


def _forget_properties() -> None:
    """Take the properties off our classes: the bpy module crashes where one with a callback outlives it (4.2)."""
    package = __package__.rpartition(".")[0]
    for base in (bpy.types.PropertyGroup, bpy.types.Operator, bpy.types.AddonPreferences):
        for cls in base.__subclasses__():
            if cls.__module__.startswith(package + "."):
                cls.__annotations__ = {}


# The pass of object indices has its long name from 5.0 on, when scenes lost their own node tree.
OBJECT_INDEX = "IndexOB" if "node_tree" in bpy.types.Scene.bl_rna.properties else "Object Index"


def working_space() -> str:
    """Name of the .blend's scene-linear color space; before 5.0 there is but one."""
    spaces = getattr(bpy.data, "colorspace", None)
    return spaces.working_space if spaces is not None else "Linear Rec.709"


def panels_of_all_engines() -> list[type]:
    """Blender's own panels that are for every engine. It knows them by an engine that it no longer has.

    What means nothing for Gaussians is left out: simplifying, Freestyle, Grease Pencil.
    """
    panels = [p for p in bpy.types.Panel.__subclasses__() if "BLENDER_RENDER" in getattr(p, "COMPAT_ENGINES", ())]
    words = ("simplify", "freestyle", "gpencil", "grease_pencil")
    return [panel for panel in panels if not any(word in panel.__name__.lower() for word in words)]
