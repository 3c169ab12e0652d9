"""The `cpu` backend agrees with the float64 reference on random scenes of all kinds.

Hypothesis chooses the kind of scene. Its numbers come from a seed, rounded to float32 so that both precisions
see the same scene.
"""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from r5dgs_core.raster import RasterSettings, rasterize_splats
from r5dgs_core.scene.cameras import Camera
from tests.support.agreement import FORWARD, assert_within_bars
from tests.support.splats import NAMES, camera, draw, relative, splats

pytestmark = pytest.mark.heavy

THRESHOLDS = RasterSettings()


def assert_ids_are_heaviest(scene, view, labels, found):
    """Each pixel's label has the largest weight that the reference gives to any label; small alphas have none."""
    names = torch.unique(torch.cat([labels.clamp_min(-1), torch.tensor([-1])]))
    one_hot = (labels.clamp_min(-1)[:, None] == names).double()
    result = rasterize_splats(*scene[:4], one_hot, view, backend="reference")
    votes = result.image.gather(2, torch.searchsorted(names, found.ids.long())[..., None])[..., 0]
    enough = result.alpha >= THRESHOLDS.id_alpha_min
    decided = (result.alpha - THRESHOLDS.id_alpha_min).abs() > FORWARD
    assert (votes >= result.image.amax(2) - FORWARD)[enough & decided].all()
    assert (found.ids == -1)[~enough & decided].all()


# Kinds of scenes

OPACITIES = ("any", "opaque", "thin", "extremes")
PLACES = ("box", "near", "around", "same", "plane")


@st.composite
def scenes(draw, place):
    """Inputs of `rasterize_splats` in float64, a camera, a background and labels."""
    n = draw(st.sampled_from([1, 2, 7, 30, 100, 200]))
    n_channels = draw(st.sampled_from([1, 2, 3, 4, 5, 8, 19]))
    width, height = draw(st.integers(1, 50)), draw(st.integers(1, 50))
    # The seed contains the choices: Hypothesis often changes a single choice, and the numbers should change with it.
    random = np.random.default_rng([draw(st.integers(0, 2**32 - 1)), n, n_channels, width, height])
    focal = draw(st.sampled_from([0.3, 1.0, 20.0])) * max(width, height)
    view = _camera(random, width, height, focal, draw(st.booleans()))
    means, depths = _means(random, n, place, width, height, focal)
    sigma_px = 10 ** draw(st.floats(-3, 4))
    slenderness = draw(st.sampled_from([0.2, 1.0, 10.0]))
    scales = sigma_px * np.maximum(depths, 0.05)[:, None] / focal * np.exp(slenderness * random.normal(size=(n, 3)))
    values = (
        _to_world(view, means),
        random.normal(size=(n, 4)),
        scales * np.minimum(1e6 / scales.max(1, keepdims=True), 1),
        _opacities(random, n, draw(st.sampled_from(OPACITIES))),
        random.uniform(0, 1, (n, n_channels)),
    )
    shapes = {"none": None, "colour": (n_channels,), "image": (height, width, n_channels)}
    shape = shapes[draw(st.sampled_from(list(shapes)))]
    background = None if shape is None else _as_float32(random.uniform(0, 1, shape))
    labels = torch.tensor(random.integers(-2, 5, n)) if draw(st.booleans()) else None
    return [_as_float32(value) for value in values], view, background, labels


def _as_float32(values):
    return torch.tensor(values, dtype=torch.float32).double()


def _camera(random, width, height, focal, skewed):
    """A camera with any pose; if skewed, with a skew and a principal point that may lie off the image."""
    skew, offset = (0.1 * focal * random.normal(), 0.4 * random.normal(size=2)) if skewed else (0.0, (0.0, 0.0))
    intrinsics = np.array(
        [
            [focal, skew, (0.5 + offset[0]) * width],
            [0, focal * random.uniform(0.8, 1.2), (0.5 + offset[1]) * height],
            [0, 0, 1],
        ]
    )
    T_cam_world = np.eye(4)
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    T_cam_world[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    T_cam_world[:3, 3] = random.normal(size=3)
    return Camera(width, height, intrinsics, T_cam_world)


def _means(random, n, place, width, height, focal):
    """Centres in the camera frame [N, 3] and the depths by which sizes are measured [N]."""
    low, high = {"near": (0.005, 0.1), "around": (-1.0, 3.0)}.get(place, (1.0, 5.0))
    z = random.uniform(low, high, n)
    if place == "plane":
        z = random.choice([2.0, 3.0], n)
    slopes = random.uniform(-0.7, 0.7, (n, 2)) * np.array([width, height]) / focal
    means = np.column_stack([slopes * z[:, None], z])
    if place == "same":
        means = means[random.integers(0, max(n // 10, 1), n)]
    return means, means[:, 2]


def _to_world(view, means):
    return (means - view.T_cam_world[:3, 3]) @ view.T_cam_world[:3, :3]


def _opacities(random, n, kind):
    if kind == "opaque":
        return random.uniform(0.95, 1.0, n)
    if kind == "thin":
        return random.uniform(0.003, 0.02, n)
    if kind == "extremes":
        return random.choice([0.0, 1.0, THRESHOLDS.alpha_min, THRESHOLDS.alpha_max, 0.5], n)
    return random.uniform(0, 1, n)


@pytest.mark.default_cases("near", "around", "same")
@pytest.mark.parametrize("place", PLACES)
@given(st.data())
@settings(max_examples=100 // len(PLACES), derandomize=True, deadline=None)
def test_cpu_draws_any_scene_as_the_reference_does(place, data):
    inputs, view, background, labels = data.draw(scenes(place))
    found, _ = assert_within_bars(inputs, view, background, upstreams=3, labels=labels)
    if labels is not None:
        assert_ids_are_heaviest(inputs, view, labels, found)


@pytest.mark.parametrize("seed", range(3))
def test_cpu_draws_six_hundred_gaussians_as_the_reference_does(seed):
    background = torch.rand(40, 48, 5, generator=torch.Generator().manual_seed(seed)).double()
    assert_within_bars(splats(600, 5, seed=seed), camera(), background)


def test_float32_inputs_of_the_reference_are_drawn_in_float64():
    inputs, view = splats(300, 3, seed=4), camera()
    expected, gradients, _ = draw(inputs, view, "reference")
    leaves = [t.float().requires_grad_() for t in inputs]
    result = rasterize_splats(*leaves, view, backend="reference")
    assert result.image.dtype == torch.float32
    assert torch.equal(result.image, expected.image.float())
    result.image.sum().backward()
    again = [t.clone().requires_grad_() for t in inputs]
    rasterize_splats(*again, view, backend="reference").image.sum().backward()
    for name, single, double in zip(NAMES, leaves, again, strict=False):
        assert relative(single.grad, double.grad) < 1e-6, name
