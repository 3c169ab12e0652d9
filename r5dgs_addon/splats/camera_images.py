"""Images in front of the splats in a camera's view: splats cover the camera's background images that Blender draws."""

from __future__ import annotations

import bpy
import gpu
from gpu_extras.batch import batch_for_shader

from ..scene import captured_cameras


def draw(context: bpy.types.Context) -> None:
    """Draw the images of a captured camera that a 3D view looks through, if overlays are shown."""
    space, camera = context.space_data, context.space_data.camera or context.scene.camera
    if context.region_data.view_perspective != "CAMERA" or not space.overlay.show_overlays:
        return
    if camera is None or camera.type != "CAMERA" or captured_cameras.CAPTURED not in camera:
        return
    if not camera.data.show_background_images:
        return
    for background in camera.data.background_images:
        if background.image is None or not background.show_background_image or background.display_depth != "FRONT":
            continue
        right_top, right_bottom, left_bottom, left_top = (
            camera.matrix_world.normalized() @ corner for corner in camera.data.view_frame(scene=context.scene)
        )
        shader = gpu.shader.from_builtin("IMAGE_COLOR")
        places = {"pos": [left_bottom, right_bottom, left_top, right_top], "texCoord": [(0, 0), (1, 0), (0, 1), (1, 1)]}
        batch = batch_for_shader(shader, "TRI_STRIP", places)
        gpu.state.blend_set("ALPHA")
        gpu.state.depth_test_set("NONE")
        shader.bind()
        shader.uniform_sampler("image", gpu.texture.from_image(background.image))
        shader.uniform_float("color", (1.0, 1.0, 1.0, background.alpha))
        batch.draw(shader)
        gpu.state.blend_set("NONE")
