"""Compare Suzanne among the Gaussians of the demo, by Merge with Meshes, with the demo's meshes rendered in Cycles.

    python tests/blender/check_merge.py demo.r5dgs OUT [--samples 64]

The scene file is the result of `r5dgs demo`, the meshes are those of `examples/build_tabletop.py`. Each picture is
rendered twice: as it is, and with a Suzanne that glows, whose pixels are her mask. The merge is rendered without and
with Add Shadows. Prints the IoU of both masks, the number of pixels of the sky in front of her, and the PSNR within
40 px of her, of her own pixels and of the rest. Fails if the IoU is at most 0.98, the sky is in front of her, or the
PSNR within 40 px is below 26 dB with shadows or less than 3 dB above the one without. Writes the pictures to OUT.
Takes three minutes on two cores.
"""

import argparse
import importlib.util
import math
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "examples")]
SIZE, NEAR, GLOW = 512, 40, (1.0, 0.0, 1.0)
TIME = 0.5  # of the scene, observed
PLACE, TURN, WIDTH = (0.35, -0.35, 0.33), (-0.25, 0.0, 0.5), 0.66


def register() -> None:
    """Register the extension of this repository."""
    spec = importlib.util.spec_from_file_location("r5dgs", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules["r5dgs"] = module
    spec.loader.exec_module(module)
    module.register()


def prepare(samples: int) -> None:
    """Add Suzanne and the camera to the open scene, and set its size."""
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_monkey_add(size=WIDTH, location=PLACE, rotation=TURN)
    suzanne = bpy.context.object
    suzanne.modifiers.new("smooth", "SUBSURF").render_levels = 2
    suzanne.data.materials.append(bpy.data.materials.new("Suzanne"))
    camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
    camera.data.angle = math.radians(42)
    target, elevation = Vector((0, 0.05, 0.42)), math.radians(33)
    camera.location = target + 5 * Vector((0.2, -math.cos(elevation), math.sin(elevation)))
    camera.rotation_euler = (target - camera.location).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(camera)
    scene.camera = camera
    render = scene.render
    render.resolution_x = render.resolution_y = SIZE
    render.resolution_percentage, render.dither_intensity = 100, 0
    scene.cycles.samples, scene.cycles.use_denoising = samples, False


def pictures(out: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Render a picture and the mask of Suzanne. [H, W, 3], [H, W]"""
    from r5dgs_core.data import images

    found = []
    material = bpy.data.materials["Suzanne"]
    material.use_nodes = True
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    for kind in ("lit", "glowing"):
        glows = kind == "glowing"
        bpy.data.objects["Suzanne"].visible_diffuse = not glows  # its light on others is not a part of the mask
        shader.inputs["Base Color"].default_value = (0, 0, 0, 1) if glows else (0.8, 0.35, 0.1, 1)
        shader.inputs["Roughness"].default_value = 1.0
        shader.inputs["Specular IOR Level"].default_value = 0.0
        shader.inputs["Emission Color"].default_value = (*GLOW, 1)
        shader.inputs["Emission Strength"].default_value = 1.0 * glows
        bpy.context.scene.render.filepath = str(out / f"{name}_{kind}.png")
        bpy.ops.render.render(write_still=True)
        found.append(images.read(bpy.context.scene.render.filepath)[..., :3])
    lit, glowing = found
    return lit, (np.abs(glowing - GLOW).max(-1) < 0.5) & (np.abs(glowing - lit).max(-1) > 0.3)


def truth(out: Path, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """The demo's own meshes and Suzanne in Cycles."""
    import build_tabletop
    from building import motion

    build_tabletop.build_tabletop()
    prepare(samples)
    bpy.context.scene.frame_set(round(motion.FIRST_FRAME + TIME * motion.FRAMES_PER_UNIT))
    return pictures(out, "truth")


def merge(path: Path, samples: int) -> None:
    """Merge the Gaussians with Suzanne and the light of the demo."""
    from building import stage

    stage.new((0.74, 0.85, 1.0), 0.62)
    stage.sun(2.1, (32.0, -18.0, 20.0), angle_deg=14.0, color=(1.0, 0.95, 0.86))
    bpy.ops.r5dgs.load_scene(filepath=str(path.absolute()))
    loaded = next(one for one in bpy.data.collections if one.r5dgs.is_scene)
    prepare(samples)
    bpy.context.scene.timeline_markers.clear()
    bpy.context.scene.frame_set(round(loaded.r5dgs.frame_zero + TIME * loaded.r5dgs.frames_per_unit))
    bpy.ops.r5dgs.merge_with_meshes()
    meshes = bpy.context.scene.r5dgs_render.meshes
    meshes.cycles.samples, meshes.cycles.use_denoising = samples, False


def near(mask: np.ndarray) -> np.ndarray:
    """Pixels within `NEAR` of a mask."""
    from scipy import ndimage

    return ndimage.distance_transform_edt(~mask) <= NEAR


def psnr(a: np.ndarray, b: np.ndarray, where: np.ndarray) -> float:
    """PSNR of the pixels of a mask, dB."""
    return float(-10 * np.log10(((a - b)[where] ** 2).mean()))


def main() -> None:
    """Render, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--samples", type=int, default=64)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    register()
    true, true_mask = truth(options.out, options.samples)
    merge(options.scene, options.samples)
    plain, _ = pictures(options.out, "merged")
    bpy.ops.r5dgs.add_shadows()
    found, mask = pictures(options.out, "shadows")
    iou = (mask & true_mask).sum() / (mask | true_mask).sum()
    from scipy import ndimage

    sky = np.abs(found - found[4, 4]).max(-1) < 0.03
    shards = int((sky & ndimage.binary_erosion(true_mask, iterations=2)).sum())
    around = near(true_mask)
    print(f"mask: {true_mask.sum()} px, IoU {iou:.4f}; sky in front of her: {shards} px")
    for place, where in (("within 40 px", around), ("her own pixels", true_mask), ("the rest", ~around)):
        before, after = (psnr(true, image, where) for image in (plain, found))
        print(f"PSNR, {place}: {before:.2f} dB without shadows, {after:.2f} dB with")
    sys.stdout.flush()
    gain = psnr(true, found, around) - psnr(true, plain, around)
    if iou <= 0.98 or shards:
        raise SystemExit("check_merge: the mask differs")
    if psnr(true, found, around) < 26 or gain < 3:
        raise SystemExit("check_merge: the shadows differ")


if __name__ == "__main__":
    main()
