"""Paste of a picture of splats, over the sky, into the active framebuffer of a viewport."""

from __future__ import annotations

import functools

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ...r5dgs_core.color import srgb
from ...r5dgs_core.scene import spherical_harmonics
from . import gaussian_table, shaders
from . import splat_renderer as renderer

UNKNOWN = (0.5, 0.5, 0.5)  # background that is assumed behind soft edges if its color cannot be read


@functools.cache
def _screen() -> tuple[gpu.types.GPUShader, gpu.types.GPUBatch]:
    shader = shaders.paste()
    return shader, batch_for_shader(shader, "TRI_STRIP", renderer.CORNERS)


@functools.lru_cache(maxsize=8)
def _sky_texture(sky: bytes) -> gpu.types.GPUTexture:
    """Coefficients in one row: degree 0, then the others without gaps. Bytes of [K, 3] float32"""
    terms = np.frombuffer(sky, np.float32).reshape(-1, 3)
    texels = np.zeros((1 + gaussian_table.HARMONICS[3], 4), np.float32)
    texels[0, :3] = terms[0]
    texels[1:].reshape(-1)[: 3 * (len(terms) - 1)] = terms[1:].ravel()
    return renderer.texture(texels, len(texels), "RGBA32F")


def forget() -> None:
    """Release the shader and the textures."""
    _screen.cache_clear()
    _sky_texture.cache_clear()


def paste(
    buffer: renderer.SplatBuffer,
    meshes: gpu.types.GPUTexture | None,
    view: renderer.ViewMatrices,
    sky: np.ndarray | None,
    world: np.ndarray,
    behind: tuple[float, float, float] | None,
) -> None:
    """Blend a picture into the active framebuffer.

    Args:
        buffer: The picture.
        meshes: Depth buffer of the solid geometry, or None.
        view: View of the picture.
        sky: Coefficients of the sky, [K, 3] float32, or None.
        world: Map from the world of the sky to Blender's. [4, 4]
        behind: Display-referred color of the viewport's background; None if the framebuffer is display-referred itself.
    """
    shader, screen = _screen()
    terms = renderer.nothing() if sky is None else _sky_texture(sky.tobytes())
    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("ALPHA_PREMULT")
    shader.bind()
    shader.uniform_float("to_world", renderer.matrix(_rays(view, world)))
    shader.uniform_float("behind", UNKNOWN if behind is None else behind)
    shader.uniform_int("overlay", int(behind is not None))
    shader.uniform_int("sky_degree", -1 if sky is None else spherical_harmonics.degree_of(len(sky)))
    shader.uniform_int("meshes_drawn", int(meshes is not None))
    shader.uniform_sampler("splats", buffer.texture)
    shader.uniform_sampler("holes", buffer.holes or renderer.nothing())
    shader.uniform_int("has_holes", int(buffer.holes is not None))
    shader.uniform_sampler("meshes", meshes or renderer.nothing())
    shader.uniform_sampler("sky_terms", terms)
    screen.draw(shader)
    gpu.state.blend_set("NONE")


def _rays(view: renderer.ViewMatrices, world: np.ndarray) -> np.ndarray:
    """Linear map from (x, y, 1, 1), x and y in [-1, 1] over the picture, to rays in the world of a scene. [4, 4]"""
    p, rays = view.projection, np.zeros((4, 4))
    if not view.parallel:
        rays[0, :3], rays[1, :3] = (1 / p[0, 0], 0, p[0, 2] / p[0, 0]), (0, 1 / p[1, 1], p[1, 2] / p[1, 1])
    rays[2, 2] = -1
    to_scene = np.linalg.inv(view.view_matrix @ world)
    to_scene[:3, 3] = 0
    return to_scene @ rays


def background(context: bpy.types.Context) -> tuple[float, float, float]:
    """Display-referred color of a viewport's background, as far as it is known."""
    shading = context.space_data.shading
    if shading.type == "SOLID" and shading.background_type == "VIEWPORT":
        return tuple(srgb.from_linear(np.array(shading.background_color, np.float64)))
    if shading.type == "SOLID" and shading.background_type == "THEME":
        return tuple(context.preferences.themes[0].view_3d.space.gradients.high_gradient)
    return UNKNOWN
