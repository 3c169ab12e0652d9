"""Strokes of the brush with *Front Only*, against the light that reaches each centre by projecting all Gaussians."""

from itertools import pairwise

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

WIDTH, HEIGHT, RADIUS = 640, 480, 40.0
PATH = np.array([(0.3, 0.35), (0.5, 0.6), (0.7, 0.4)]) * (WIDTH, HEIGHT)


@pytest.fixture
def dense(blender, tmp_path):
    """A loaded scene whose Gaussians hide each other."""
    scene = scenes.make_scene(n=4000, objects=5, seed=1)
    return motions.load(blender, scene_file.write(scene, tmp_path / "dense.r5dgs"))


def read(cloud, name, kind, width):
    """Values of an attribute. [n, width]"""
    values = np.empty(width * len(cloud.data.points), np.float32)
    cloud.data.attributes[name].data.foreach_get(kind, values)
    return values.reshape(-1, width).astype(np.float64)


def project(cloud, to_camera, projection):
    """Pixels, depths, inverse covariances in pixels, and opacities of a cloud by the EWA projection."""
    matrix = to_camera @ np.array(cloud.matrix_world)
    places = read(cloud, "position", "vector", 3) @ matrix[:3, :3].T + matrix[:3, 3]
    x, y, depth = places[:, 0], places[:, 1], -places[:, 2]
    axes = matrix[:3, :3] @ rotations.quats_to_rotmats(read(cloud, "rotation", "value", 4))
    axes = axes * read(cloud, "scale", "vector", 3)[:, None]
    jacobian = np.zeros((len(places), 2, 3))
    for row, (along, side) in enumerate(((x, WIDTH), (y, HEIGHT))):
        focal = projection[row, row] * side / 2
        jacobian[:, row, row], jacobian[:, row, 2] = focal / depth, focal * along / depth**2
    covariances = (jacobian @ axes) @ (jacobian @ axes).swapaxes(1, 2) + 0.3 * np.eye(2)
    clip = np.column_stack([places, np.ones(len(places))]) @ projection.T
    pixels = (clip[:, :2] / clip[:, 3:] + 1) / 2 * (WIDTH, HEIGHT)
    return pixels, depth, np.linalg.inv(covariances), read(cloud, "radiance:base", "color", 4)[:, 3]


def light(row, pixels, depths, inverses, opacities):
    """Share of the light of a Gaussian's centre that the nearer Gaussians let through."""
    nearer = depths < depths[row]
    x, y = (pixels[row] - pixels[nearer]).T
    inverse = inverses[nearer]
    squares = inverse[:, 0, 0] * x**2 + 2 * inverse[:, 0, 1] * x * y + inverse[:, 1, 1] * y**2
    return np.prod(1 - np.minimum(opacities[nearer] * np.exp(-0.5 * squares), 0.99))


def under_brush(pixels):
    """Mask of the pixels within the radius of the path. [n]"""
    covered = np.zeros(len(pixels), bool)
    for start, stop in pairwise(PATH):
        share = np.clip((pixels - start) @ (stop - start) / np.sum((stop - start) ** 2), 0, 1)
        covered |= np.linalg.norm(pixels - start - share[:, None] * (stop - start), axis=1) <= RADIUS
    return covered


def test_the_brush_takes_the_visible_gaussians_and_leaves_the_hidden_ones(blender, dense):
    strokes, points = motions.addon("clean_up.strokes"), motions.addon("clean_up.selected_points")
    camera = blender.context.scene.camera
    blender.context.view_layer.update()
    depsgraph = blender.context.evaluated_depsgraph_get()
    projection = np.array(camera.calc_matrix_camera(depsgraph, x=WIDTH, y=HEIGHT), np.float64)
    to_camera = np.linalg.inv(np.array(camera.matrix_world, np.float64))
    view = strokes.StrokeView(projection @ to_camera, WIDTH, HEIGHT)
    strokes.select(blender.context, dense, view, strokes.Stroke(PATH, RADIUS, True), "SET")
    clouds = motions.clouds(dense)
    selected = np.concatenate([points.mask(cloud.data) for cloud in clouds])
    columns = zip(*(project(cloud, to_camera, projection) for cloud in clouds), strict=True)
    pixels, *others = (np.concatenate(parts) for parts in columns)
    covered = np.flatnonzero(under_brush(pixels))
    through = np.array([light(row, pixels, *others) for row in covered])
    visible, hidden = covered[through > 0.9], covered[through < 0.1]
    assert len(visible) > 20 and len(hidden) > 400
    assert selected[covered].sum() == selected.sum()
    assert selected[visible].mean() > 0.95
    assert selected[hidden].mean() < 0.1  # cells of the estimate are as large as the Gaussians
