"""Surfaces from depth pictures, against planes of known position."""

import numpy as np

from r5dgs_core.scene import cameras
from r5dgs_core.shapes import depth_surface

K = np.array([[40.0, 0, 16], [0, 42, 12], [0, 0, 1]])
T = np.eye(4)
T[:3, :3] = [[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]
T[:3, 3] = 0.3, -0.2, 1.5
CAMERA = cameras.Camera(32, 24, K, T)


def plane_depths(normal, distance):
    """Depth of the plane normal . x = distance in the camera's frame."""
    rays = cameras.pixel_rays(CAMERA) @ T[:3, :3].T
    return distance / (rays / rays[..., 2:] @ normal)


def test_vertices_are_on_the_plane_and_project_to_their_pixels():
    normal = np.array([0.2, -0.1, 1.0])
    vertices, triangles = depth_surface.triangulate(CAMERA, plane_depths(normal, 4.0))
    assert len(vertices) == 32 * 24 and len(triangles) == 2 * 31 * 23
    np.testing.assert_allclose((vertices @ T[:3, :3].T + T[:3, 3]) @ normal, 4.0)
    pixels, _ = cameras.project(CAMERA, vertices)
    np.testing.assert_allclose(pixels.reshape(24, 32, 2)[5, 7], [7.5, 5.5])


def test_triangles_are_counter_clockwise_for_the_camera():
    vertices, triangles = depth_surface.triangulate(CAMERA, plane_depths(np.array([0.2, -0.1, 1.0]), 4.0))
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    assert (np.einsum("ni,ni->n", np.cross(b - a, c - a), CAMERA.center - a) > 0).all()


def test_missing_pixels_leave_holes_and_steps_are_not_bridged():
    depths = plane_depths(np.array([0, 0, 1.0]), 4.0)
    depths[:, 16:] += 3
    depths[3, 4] = np.inf
    vertices, triangles = depth_surface.triangulate(CAMERA, depths)
    pixels, z = cameras.project(CAMERA, vertices)
    corners = np.floor(pixels[triangles]).astype(int)
    assert len(vertices) == 32 * 24 - 1
    assert not (corners == [4, 3]).all(-1).any()
    assert np.ptp(z[triangles], axis=1).max() < 1


def test_an_empty_picture_gives_no_surface():
    for depths in (np.full((24, 32), np.inf), np.full((1, 1), 2.0), np.full((24, 32), np.nan)):
        vertices, triangles = depth_surface.triangulate(CAMERA, depths)
        assert vertices.shape == (0, 3) and triangles.shape == (0, 3)
