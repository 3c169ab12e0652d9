"""Matte procedural materials; textures are fixed to their object, so that they move with it."""

from __future__ import annotations

from collections.abc import Sequence

import bpy

Color = Sequence[float]
"""Linear red, green and blue."""


def plain(name: str, color: Color) -> bpy.types.Material:
    """A matte material of one linear colour, which solid viewports show, too."""
    material = _new_material(name, color)
    _shader(material).inputs["Color"].default_value = (*color, 1.0)
    return material


def speckled(
    name: str, low: Color, high: Color, scale: float, *, sharp: float = 0.0, middle: float = 0.5
) -> bpy.types.Material:
    """A matte material of noise between two linear colours, fixed to its object.

    Args:
        name: Name of the material.
        low: Colour where the noise is low.
        high: Colour where it is high.
        scale: Noise cells per unit.
        sharp: 0 for a smooth mixture, towards 1 for patches with edges.
        middle: Noise value between the two colours.
    """
    material = _new_material(name, low)
    tree = material.node_tree
    place = tree.nodes.new("ShaderNodeTexCoord")
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = scale
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    half = 0.5 * (1.0 - sharp) * 0.5
    for element, position, color in zip(
        ramp.color_ramp.elements, (middle - half, middle + half), (low, high), strict=True
    ):
        element.position, element.color = position, (*color, 1.0)
    tree.links.new(place.outputs["Object"], noise.inputs["Vector"])
    tree.links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], _shader(material).inputs["Color"])
    return material


def planks(name: str, colors: Sequence[Color], size: float) -> bpy.types.Material:
    """A matte floor of planks of two linear colours with a joint of a third; planks are four times as long as wide."""
    material = _new_material(name, colors[0])
    tree = material.node_tree
    place = tree.nodes.new("ShaderNodeTexCoord")
    brick = tree.nodes.new("ShaderNodeTexBrick")
    for socket, color in zip(("Color1", "Color2", "Mortar"), colors, strict=True):
        brick.inputs[socket].default_value = (*color, 1.0)
    values = {
        "Scale": 1.0,
        "Mortar Size": 0.035 * size,
        "Mortar Smooth": 0.6,
        "Brick Width": 4 * size,
        "Row Height": size,
    }
    for socket, value in values.items():
        brick.inputs[socket].default_value = value
    tree.links.new(place.outputs["Object"], brick.inputs["Vector"])
    tree.links.new(brick.outputs["Color"], _shader(material).inputs["Color"])
    return material


def _new_material(name: str, color: Color) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    material.diffuse_color = (*color, 1.0)
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    output, shader = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeBsdfDiffuse")
    material.node_tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    return material


def _shader(material: bpy.types.Material) -> bpy.types.Node:
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_DIFFUSE")


def checks(name: str, colors: Sequence[Color], size: float) -> bpy.types.Material:
    """A matte material of cubes of two linear colours that alternate along all axes of its object."""
    material = _new_material(name, colors[0])
    tree = material.node_tree
    place = tree.nodes.new("ShaderNodeTexCoord")
    checker = tree.nodes.new("ShaderNodeTexChecker")
    checker.inputs["Scale"].default_value = 1.0 / size
    for socket, color in zip(("Color1", "Color2"), colors, strict=True):
        checker.inputs[socket].default_value = (*color, 1.0)
    tree.links.new(place.outputs["Object"], checker.inputs["Vector"])
    tree.links.new(checker.outputs["Color"], _shader(material).inputs["Color"])
    return material
