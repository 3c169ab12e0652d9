"""Differences between Blender versions, found by feature detection. No other module checks the version."""

import atexit
from collections.abc import Sequence

import bpy

# Recent versions require path properties to declare support for the "//" prefix; older ones lack the option.
_SAYS_RELATIVE = "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties
PATH_OPTIONS = {"PATH_SUPPORTS_BLEND_RELATIVE"} if _SAYS_RELATIVE else set()
KEYFRAME = bpy.types.Keyframe.bl_rna


def new_point_clouds(counts: Sequence[int]) -> list[bpy.types.PointCloud]:
    """Create point clouds with the given numbers of points at the origin, not yet used by any object.

    `PointCloud.resize` is available from 5.1. Older versions copy the result of geometry nodes in a temporary scene.

    Args:
        counts: Number of points of each point cloud, at least 1.

    Returns:
        The point clouds, in the order of ``counts``.
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
    """Remove a scene that is not shown in any window.

    Up to 4.4, ``scenes.remove`` crashes if there is no window, as in `blender -b -a`.
    """
    bpy.data.batch_remove([scene])


def make_gaussian_splat(cloud: bpy.types.PointCloud) -> bool:
    """Set a point cloud to be drawn as Gaussian splats (Blender 5.3+). Returns False if unsupported."""
    kind = cloud.bl_rna.properties.get("type")
    if kind is None or "GAUSSIAN_SPLAT" not in kind.enum_items:
        return False
    cloud.type = "GAUSSIAN_SPLAT"
    return True


def is_gaussian_splat(cloud: bpy.types.PointCloud) -> bool:
    """Return True if Blender itself draws a point cloud as Gaussian splats."""
    return getattr(cloud, "type", "") == "GAUSSIAN_SPLAT"


def new_fcurves(obj: bpy.types.Object, name: str):
    """Assign a new, empty action to an object and return its F-curve collection.

    4.2 and 4.3 store F-curves on the action; from 4.4 on, they are stored in a channel bag of a slot.
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
    """Return the F-curves that animate an object, or an empty tuple."""
    animation = obj.animation_data
    if animation is None or animation.action is None:
        return ()
    return channels(animation.action, slot_of(animation))


def slot_of(user: bpy.types.AnimData | bpy.types.NlaStrip):
    """Action slot used by an object or NLA strip, or None if actions have no slots."""
    return getattr(user, "action_slot", None)


def channels(action: bpy.types.Action, slot):
    """Return the F-curves of an action for one of its slots, or an empty tuple."""
    if "slots" not in action.bl_rna.properties:
        return action.fcurves
    for layer in action.layers if slot is not None else ():
        for strip in layer.strips:
            bag = strip.channelbag(slot)
            if bag is not None:
                return bag.fcurves
    return ()


def own_fcurves(obj: bpy.types.Object, name: str):
    """Return the editable F-curve collection of an object, creating an action if it has none."""
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
    """Assign an action to an object, and the slot with the same handle as ``slot``."""
    animation = obj.animation_data_create()
    animation.action = action
    choose_slot(animation, slot)


def choose_slot(user: bpy.types.AnimData | bpy.types.NlaStrip, slot) -> None:
    """Set the action slot of an object or NLA strip to the one with the handle of ``slot``. Does nothing if None."""
    if slot is not None:
        user.action_slot = next(other for other in user.action.slots if other.handle == slot.handle)


def keyframe_enum(property_name: str, item: str) -> int:
    """Numeric value of an enum item of `bpy.types.Keyframe`, for ``foreach_set``."""
    return KEYFRAME.properties[property_name].enum_items[item].value


def empty_nodes(material: bpy.types.Material) -> bpy.types.NodeTree:
    """Clear a material's node tree and return it. From 5.0 on, ``use_nodes`` is deprecated and always true."""
    if material.node_tree is None:
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return material.node_tree


def call_at_exit(unregister) -> None:
    """Call ``unregister`` before Python exits in the bpy module, which crashes if panels or menus stay registered.

    Blender itself disables its extensions before exit.
    """
    if not bpy.app.binary_path:  # true only for the bpy module
        atexit.unregister(_forget_properties)
        atexit.register(_forget_properties)  # registered before the other, because atexit calls the last one first
        atexit.register(unregister)


def do_not_call_at_exit(unregister) -> None:
    """Undo `call_at_exit`."""
    atexit.unregister(unregister)


def _forget_properties() -> None:
    """Remove the property annotations of our classes: the bpy module (4.2) crashes at exit if one has a callback."""
    package = __package__.rpartition(".")[0]
    for base in (bpy.types.PropertyGroup, bpy.types.Operator, bpy.types.AddonPreferences):
        for cls in base.__subclasses__():
            if cls.__module__.startswith(package + "."):
                cls.__annotations__ = {}


# From 5.0 on (scenes without their own node tree), the object index pass has its long name.
OBJECT_INDEX = "IndexOB" if "node_tree" in bpy.types.Scene.bl_rna.properties else "Object Index"


def working_space() -> str:
    """Name of the .blend file's scene-linear color space; fixed before 5.0."""
    spaces = getattr(bpy.data, "colorspace", None)
    return spaces.working_space if spaces is not None else "Linear Rec.709"


def panels_of_all_engines() -> list[type]:
    """Blender's built-in panels that apply to every render engine, identified by the removed BLENDER_RENDER engine.

    Panels without meaning for Gaussians are excluded: Simplify, Freestyle and Grease Pencil.
    """
    panels = [p for p in bpy.types.Panel.__subclasses__() if "BLENDER_RENDER" in getattr(p, "COMPAT_ENGINES", ())]
    words = ("simplify", "freestyle", "gpencil", "grease_pencil")
    return [panel for panel in panels if not any(word in panel.__name__.lower() for word in words)]


# Blender 4.2 to 4.5 call the new EEVEE differently.
EEVEE = "BLENDER_EEVEE_NEXT" if bpy.app.version < (5, 0) else "BLENDER_EEVEE"


def compositor(scene: bpy.types.Scene) -> bpy.types.NodeTree | None:
    """Compositor of a scene, or None. From 5.0 on, it is a node group."""
    if "compositing_node_group" in scene.bl_rna.properties:
        return scene.compositing_node_group
    return scene.node_tree if scene.use_nodes else None


def make_compositor(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """Compositor of a scene, created if there is none."""
    found = compositor(scene)
    if found is not None:
        return found
    if "compositing_node_group" not in scene.bl_rna.properties:
        scene.use_nodes = True
        return scene.node_tree
    tree = scene.compositing_node_group = bpy.data.node_groups.new(f"{scene.name} Compositor", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    return tree


def compositor_output(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """Socket of the picture that a compositor writes; its node is created if there is none."""
    kind = "NodeGroupOutput" if "node_tree" not in bpy.types.Scene.bl_rna.properties else "CompositorNodeComposite"
    node = next((node for node in tree.nodes if node.bl_idname == kind), None) or tree.nodes.new(kind)
    return node.inputs[0]


def set_alpha(tree: bpy.types.NodeTree, mode: str, image, alpha) -> bpy.types.NodeSocket:
    """Add a *Set Alpha* node and return its output. ``mode``: APPLY or REPLACE_ALPHA; ``alpha``: None for 0."""
    node = tree.nodes.new("CompositorNodeSetAlpha")
    if hasattr(node, "mode"):
        node.mode = mode
    else:  # from 5.0 on
        node.inputs["Type"].default_value = {"APPLY": "Apply Mask", "REPLACE_ALPHA": "Replace Alpha"}[mode]
    tree.links.new(image, node.inputs["Image"])
    if alpha is None:
        node.inputs["Alpha"].default_value = 0.0
    else:
        tree.links.new(alpha, node.inputs["Alpha"])
    return node.outputs[0]


def alpha_over(tree: bpy.types.NodeTree, background, foreground) -> bpy.types.NodeSocket:
    """Add an *Alpha Over* node for premultiplied colours; returns its output."""
    node = tree.nodes.new("CompositorNodeAlphaOver")
    pictures = [socket for socket in node.inputs if socket.type == "RGBA"]  # background first, under changing names
    tree.links.new(background, pictures[0])
    tree.links.new(foreground, pictures[1])
    return node.outputs[0]


def multiply(tree: bpy.types.NodeTree, image, factor) -> bpy.types.NodeSocket:
    """Add a node that multiplies the colours of an image and keeps its alpha; returns its output."""
    if hasattr(bpy.types, "CompositorNodeMixRGB"):
        node = tree.nodes.new("CompositorNodeMixRGB")
    else:  # from 5.0 on
        node = tree.nodes.new("ShaderNodeMix")
        node.data_type = "RGBA"
    node.blend_type = "MULTIPLY"
    colors = [socket for socket in node.inputs if socket.type == "RGBA"]
    next(socket for socket in node.inputs if socket.type == "VALUE" and socket.enabled).default_value = 1.0
    tree.links.new(image, colors[0])
    tree.links.new(factor, colors[1])
    return next(socket for socket in node.outputs if socket.type == "RGBA")
