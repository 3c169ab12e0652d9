"""Build the demo scene "tabletop" in Blender, and capture it into the data set that `r5dgs demo` trains on.

Five objects on a round table, each moving by a law that can be written down: a toy car drives along an arc, a globe
spins about its tilted axis, a ball is thrown, a block slides with friction, a vase stands still. Poses are keyed at
every frame, so the scene is exact there and what happens after the last observed time follows from what was seen.

    python examples/build_tabletop.py --blend tabletop.blend --dataset DIR     with the bpy module
    blender -b --python examples/build_tabletop.py -- --blend tabletop.blend   with Blender
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import ModuleType

import bpy
from mathutils import Euler, Quaternion, Vector

FRAMES_PER_UNIT = 60
FIRST_FRAME = 1
Law = Callable[[float], tuple[Vector, Quaternion]]
"""Location and rotation of an object at a scene time."""


# Materials


def plain(name: str, color: Sequence[float]) -> bpy.types.Material:
    """A matte material of one linear colour, which is also what the solid viewport shows."""
    material = _new_material(name, color)
    _shader(material).inputs["Color"].default_value = (*color, 1.0)
    return material


def speckled(
    name: str, low: Sequence[float], high: Sequence[float], scale: float, *, sharp: float = 0.0, middle: float = 0.5
) -> bpy.types.Material:
    """A matte material of noise between two linear colours, fixed to its object.

    Args:
        name: Name of the material.
        low: Colour where the noise is low.
        high: Colour where it is high.
        scale: Noise cells per unit.
        sharp: 0 for a smooth mixture, towards 1 for patches with edges.
        middle: Value of the noise that divides the two.
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


def planks(name: str, colors: Sequence[Sequence[float]], size: float) -> bpy.types.Material:
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


def _new_material(name: str, color: Sequence[float]) -> bpy.types.Material:
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


# Shapes


def mesh_object(
    name: str,
    vertices: Iterable[Sequence[float]],
    faces: Sequence[Sequence[int]],
    materials: Sequence[bpy.types.Material],
    material_of_face: Sequence[int] | None = None,
    *,
    smooth: bool = False,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """Make an object in the scene from vertices and faces."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(vertex) for vertex in vertices], [], [tuple(face) for face in faces])
    for material in materials:
        mesh.materials.append(material)
    if material_of_face is not None:
        mesh.polygons.foreach_set("material_index", list(material_of_face))
    mesh.polygons.foreach_set("use_smooth", [smooth] * len(faces))
    mesh.update()
    ob = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(ob)
    ob.parent = parent
    return ob


def lathe(
    name: str,
    profile: Sequence[tuple[float, float]],
    materials: Sequence[bpy.types.Material],
    material_at: Callable[[int, int], int],
    *,
    segments: int = 48,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """Turn a profile about the z axis.

    Args:
        name: Name of the object.
        profile: Radius and height of each ring, from the bottom up; a radius of 0 closes an end.
        materials: Materials of the object.
        material_at: Which of them the face at a row and a segment has.
        segments: Faces around.
        parent: Parent of the object.
    """
    turns = [math.tau * k / segments for k in range(segments)]
    vertices = [(r * math.cos(a), r * math.sin(a), z) for r, z in profile for a in turns]
    faces, indices = [], []
    for row in range(len(profile) - 1):
        for k in range(segments):
            near, far = row * segments + k, row * segments + (k + 1) % segments
            faces.append((near, far, far + segments, near + segments))
            indices.append(material_at(row, k))
    return mesh_object(name, vertices, faces, materials, indices, smooth=True, parent=parent)


def ball(
    name: str,
    radius: float,
    materials: Sequence[bpy.types.Material],
    material_at: Callable[[int, int], int],
    *,
    rings: int = 24,
    segments: int = 48,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """A sphere about its origin; rows count from the south pole."""
    profile = [
        (radius * math.sin(math.pi * k / rings), -radius * math.cos(math.pi * k / rings)) for k in range(rings + 1)
    ]
    return lathe(name, profile, materials, material_at, segments=segments, parent=parent)


def box(
    name: str,
    size: Sequence[float],
    materials: Sequence[bpy.types.Material],
    *,
    center: Sequence[float] = (0, 0, 0),
    taper: float = 1.0,
    bevel: float = 0.0,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """A box with edges along the axes; with six materials each face (-x +x -y +y -z +z) has its own.

    Args:
        name: Name of the object.
        size: Edge lengths.
        materials: One material, or six.
        center: Middle of the box.
        taper: The top is this much smaller than the bottom.
        bevel: Width of rounded edges.
        parent: Parent of the object.
    """
    vertices = []
    for z in (-0.5, 0.5):
        shrink = taper if z > 0 else 1.0
        vertices += [
            (center[0] + x * shrink * size[0], center[1] + y * shrink * size[1], center[2] + z * size[2])
            for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
        ]
    faces = [(0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 3, 2, 1), (4, 5, 6, 7)]
    indices = range(6) if len(materials) == 6 else [0] * 6
    ob = mesh_object(name, vertices, faces, materials, list(indices), parent=parent)
    if bevel > 0:
        modifier = ob.modifiers.new("Bevel", "BEVEL")
        modifier.width, modifier.segments = bevel, 3
    return ob


# Motion


def animate(ob: bpy.types.Object, law: Law, frames_per_unit: int = FRAMES_PER_UNIT) -> None:
    """Key the law's pose at every frame of t in [0, 1]."""
    ob.rotation_mode = "QUATERNION"
    for step in range(frames_per_unit + 1):
        ob.location, ob.rotation_quaternion = law(step / frames_per_unit)
        ob.keyframe_insert("location", frame=FIRST_FRAME + step)
        ob.keyframe_insert("rotation_quaternion", frame=FIRST_FRAME + step)


def drive(center: Sequence[float], radius: float, start_deg: float, speed_deg: float, rate_deg: float) -> Law:
    """Along a circle, heading along it: the angle is start + speed t + rate t^2 / 2, in degrees."""

    def law(t: float) -> tuple[Vector, Quaternion]:
        angle = math.radians(start_deg + speed_deg * t + 0.5 * rate_deg * t * t)
        place = Vector(center) + radius * Vector((math.cos(angle), math.sin(angle), 0.0))
        return place, Quaternion((0, 0, 1), angle + 0.5 * math.pi)

    return law


def spin(place: Sequence[float], axis: Sequence[float], speed_deg: float, *, tilt: Quaternion | None = None) -> Law:
    """In place about a fixed axis, in degrees per unit of time, from an initial tilt."""

    def law(t: float) -> tuple[Vector, Quaternion]:
        turn = Quaternion(Vector(axis).normalized(), math.radians(speed_deg * t))
        return Vector(place), turn @ (tilt or Quaternion())

    return law


def throw(
    start: Sequence[float], velocity: Sequence[float], gravity: float, axis: Sequence[float], speed_deg: float
) -> Law:
    """Ballistic flight with constant spin."""

    def law(t: float) -> tuple[Vector, Quaternion]:
        place = Vector(start) + t * Vector(velocity) - Vector((0, 0, 0.5 * gravity * t * t))
        return place, Quaternion(Vector(axis).normalized(), math.radians(speed_deg * t))

    return law


def slide(
    start: Sequence[float], direction_deg: float, speed: float, stop: float, yaw_deg: float, yaw_speed_deg: float
) -> Law:
    """Straight with constant friction, turning, both at rest from the time ``stop`` on."""

    def law(t: float) -> tuple[Vector, Quaternion]:
        s = min(t, stop)
        share = s - 0.5 * s * s / stop
        angle = math.radians(direction_deg)
        place = Vector(start) + speed * share * Vector((math.cos(angle), math.sin(angle), 0.0))
        return place, Quaternion((0, 0, 1), math.radians(yaw_deg + yaw_speed_deg * share))

    return law


# The scene


def new_scene(sky: Sequence[float], sky_strength: float, sun: float, sun_rotation_deg: Sequence[float]) -> None:
    """Empty the file; a constant sky, a soft sun, and Cycles set for it."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = FIRST_FRAME, FIRST_FRAME + FRAMES_PER_UNIT
    scene.render.fps = 30
    scene.render.engine = "CYCLES"
    scene.cycles.max_bounces = 4
    scene.cycles.use_adaptive_sampling = False
    scene.view_settings.view_transform = "Standard"
    world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (*sky, 1.0)
    background.inputs["Strength"].default_value = sky_strength
    scene.world = world
    light = bpy.data.lights.new("Sun", "SUN")
    light.energy, light.angle, light.color = sun, math.radians(14.0), (1.0, 0.95, 0.86)
    lamp = bpy.data.objects.new("Sun", light)
    lamp.rotation_euler = Euler([math.radians(angle) for angle in sun_rotation_deg])
    scene.collection.objects.link(lamp)


def toy_car(name: str) -> bpy.types.Object:
    """A red car with cream stripes, heading +x, its wheels on z = 0. Returns the empty that carries it."""
    root = bpy.data.objects.new(name, None)
    root.empty_display_size = 0.3
    bpy.context.scene.collection.objects.link(root)
    red, cream = plain("car red", (0.62, 0.035, 0.03)), plain("car cream", (0.78, 0.70, 0.48))
    glass, tyre = plain("car glass", (0.10, 0.22, 0.34)), plain("tyre", (0.03, 0.03, 0.035))
    box(f"{name} body", (0.78, 0.40, 0.17), [red], center=(0, 0, 0.175), bevel=0.04, parent=root)
    box(f"{name} cabin", (0.40, 0.34, 0.18), [glass], center=(-0.06, 0, 0.335), taper=0.72, bevel=0.02, parent=root)
    box(f"{name} roof", (0.30, 0.26, 0.03), [red], center=(-0.06, 0, 0.43), bevel=0.012, parent=root)
    box(f"{name} stripe", (0.80, 0.11, 0.175), [cream], center=(0, 0, 0.18), bevel=0.03, parent=root)
    box(f"{name} bumper", (0.06, 0.36, 0.06), [cream], center=(0.40, 0, 0.12), bevel=0.015, parent=root)
    for x in (-0.24, 0.25):
        for y in (-0.2, 0.2):
            profile = [(0.0, -0.04), (0.055, -0.04), (0.056, -0.041), (0.105, -0.04), (0.115, 0.0)]
            profile += [(0.105, 0.04), (0.056, 0.041), (0.055, 0.04), (0.0, 0.04)]
            wheel = lathe(f"{name} wheel", profile, [tyre, cream], lambda row, k: int(row in (0, 7)), parent=root)
            wheel.location, wheel.rotation_euler = (x, y, 0.115), (0.5 * math.pi, 0, 0)
    return root


def globe(name: str, radius: float) -> bpy.types.Object:
    """A blue globe with green land and pale poles."""
    sea_and_land = speckled(
        "globe", (0.03, 0.17, 0.50), (0.20, 0.46, 0.07), 1.55 / radius * 0.4, sharp=0.93, middle=0.52
    )
    ice = plain("globe ice", (0.80, 0.84, 0.86))
    return ball(name, radius, [sea_and_land, ice], lambda row, k: int(row < 3 or row > 20))


def beach_ball(name: str, radius: float) -> bpy.types.Object:
    """A ball of six coloured sectors with white caps."""
    colors = [(0.72, 0.05, 0.04), (0.80, 0.78, 0.72), (0.04, 0.16, 0.60), (0.80, 0.52, 0.03), (0.80, 0.78, 0.72)]
    colors += [(0.06, 0.42, 0.14), (0.80, 0.78, 0.72)]
    materials = [plain(f"ball {k}", color) for k, color in enumerate(colors)]
    return ball(name, radius, materials, lambda row, k: 6 if row < 2 or row > 21 else k // 8)


def toy_block(name: str, edge: float) -> bpy.types.Object:
    """A wooden block whose faces carry squares of different colours. Returns the wood, which carries the squares."""
    wood = speckled("block wood", (0.50, 0.30, 0.13), (0.62, 0.41, 0.20), 6.0)
    ob = box(name, (edge, edge, edge), [wood], center=(0, 0, 0.5 * edge), bevel=0.03)
    colors = ((0.70, 0.06, 0.08), (0.06, 0.24, 0.62), (0.82, 0.55, 0.04), (0.10, 0.45, 0.20), (0.45, 0.10, 0.50))
    sides = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, 1))
    for number, (side, color) in enumerate(zip(sides, colors, strict=True)):
        size = [0.02 if axis else 0.62 * edge for axis in side]
        center = [0.5 * edge * axis for axis in side]
        center[2] += 0.5 * edge
        box(f"{name} face {number}", size, [plain(f"block face {number}", color)], center=center, parent=ob)
    return ob


def vase(name: str) -> bpy.types.Object:
    """A vase with bands and checks, its foot on z = 0."""
    profile = [
        (0.0, 0.0),
        (0.17, 0.0),
        (0.19, 0.03),
        (0.25, 0.14),
        (0.29, 0.25),
        (0.31, 0.36),
        (0.29, 0.47),
        (0.24, 0.57),
    ]
    profile += [
        (0.18, 0.66),
        (0.14, 0.73),
        (0.13, 0.80),
        (0.15, 0.86),
        (0.19, 0.90),
        (0.17, 0.90),
        (0.12, 0.80),
        (0, 0.78),
    ]
    materials = [
        plain("vase teal", (0.02, 0.28, 0.30)),
        plain("vase white", (0.75, 0.72, 0.66)),
        plain("vase rust", (0.50, 0.15, 0.05)),
    ]

    def material_at(row: int, k: int) -> int:
        if 4 <= row <= 6:
            return (row + k // 4) % 2
        return 2 if row in (3, 7) else 1 if row in (9, 10) else 0

    return lathe(name, profile, materials, material_at)


def build_tabletop() -> None:
    """Build the whole scene into the open file; pass indices number the objects."""
    new_scene((0.74, 0.85, 1.0), 0.62, 2.1, (32.0, -18.0, 20.0))
    rim = plain("table rim", (0.20, 0.09, 0.04))
    top = planks("table planks", ((0.46, 0.33, 0.21), (0.38, 0.26, 0.16), (0.25, 0.16, 0.09)), 0.42)
    profile = [(0.0, -0.14), (2.02, -0.14), (2.1, -0.10), (2.1, -0.04), (2.06, 0.0), (0.0, 0.0)]
    lathe("Table", profile, [rim, top], lambda row, k: int(row == 4), segments=96)
    foot = [(0, 0), (0.24, 0), (0.24, 0.04), (0.07, 0.07), (0.06, 0.2), (0, 0.2)]
    lathe("Globe stand", foot, [rim], lambda row, k: 0).location = (1.08, 0.62, 0)

    tilt = Euler((math.radians(18), math.radians(-12), 0)).to_quaternion()
    car, earth, thrown = toy_car("toy car"), globe("globe", 0.36), beach_ball("beach ball", 0.27)
    block, urn = toy_block("wooden block", 0.42), vase("vase")
    animate(car, drive((0, 0, 0), 1.38, 222.0, 76.0, 24.0))
    animate(earth, spin((1.08, 0.62, 0.52), tilt @ Vector((0, 0, 1)), 190.0, tilt=tilt))
    animate(thrown, throw((-1.35, 0.75, 0.62), (1.95, -0.95, 2.9), 5.2, (0.35, 1.0, 0.25), 170.0))
    animate(block, slide((-1.15, -0.02, 0), 4.0, 2.0, 1.15, 20.0, 75.0))
    urn.location = (-0.22, 1.12, 0)
    for number, ob in enumerate((car, earth, thrown, block, urn), start=1):
        for part in (ob, *ob.children_recursive):
            part.pass_index = number


def tabletop_settings(capture: ModuleType, directory: Path):
    """Settings of the bundled data set, as the ``CaptureSettings`` of the capture service."""
    return capture.CaptureSettings(
        directory=directory,
        resolution_x=128,
        resolution_y=128,
        samples=192,
        frame_step=4,
        t_max=0.74,
        test_views=3,
        rig="ARC",
        rig_observed=10,
        rig_novel=2,
        rig_target=(0.0, 0.05, 0.42),
        rig_radius=5.0,
        rig_elevation_deg=33.0,
        rig_elevation_spread_deg=14.0,
        rig_arc_deg=160.0,
        rig_fov_deg=42.0,
        objects="PASS_INDEX",
    )


def capture_tabletop(directory: Path) -> None:
    """Capture the open file with the add-on's service of this checkout, and print a line of JSON for each image."""
    capture = _load_capture()
    settings = tabletop_settings(capture, directory)
    result = capture.capture(bpy.context, settings, lambda state: print(json.dumps(vars(state)), flush=True))
    print(f"{result.directory}: {result.images}, objects {result.objects}, not seen {result.unseen or 'none'}")


def _load_capture() -> ModuleType:
    """The capture service, from the folder above this one as the package ``r5dgs``."""
    root = Path(__file__).resolve().parent.parent
    spec = importlib.util.spec_from_file_location("r5dgs", root / "__init__.py", submodule_search_locations=[str(root)])
    package = importlib.util.module_from_spec(spec)
    sys.modules["r5dgs"] = package
    spec.loader.exec_module(package)
    return importlib.import_module("r5dgs.r5dgs_addon.capture")


def main(arguments: Sequence[str]) -> None:
    """Build, and do what the arguments ask for."""
    parser = argparse.ArgumentParser(prog="build_tabletop.py", description=__doc__.split("\n", 1)[0])
    parser.add_argument("--blend", type=Path, help="save the scene here")
    parser.add_argument("--dataset", type=Path, help="capture the scene into this new folder")
    chosen = parser.parse_args(arguments)
    build_tabletop()
    if chosen.blend is not None:
        bpy.ops.wm.save_as_mainfile(filepath=str(chosen.blend.absolute()))
    if chosen.dataset is not None:
        capture_tabletop(chosen.dataset)


if __name__ == "__main__":
    main(
        sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:] if bpy.app.binary_path == "" else []
    )
