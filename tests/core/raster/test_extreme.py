"""Stiff and extreme scenes give the picture that 3D Gaussian splatting defines, and invalid input is named."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from benchmarks.raster import extreme_scenes
from r5dgs_core.raster import RasterSettings, RasterStats, rasterize_splats
from tests.support.agreement import FORWARD, assert_within_bars
from tests.support.splats import camera, draw, splats

pytestmark = pytest.mark.heavy

BACKENDS = ("cpu", "reference")
NEAR = RasterSettings().near_plane
ALPHA_MIN, ALPHA_MAX = RasterSettings().alpha_min, RasterSettings().alpha_max


LARGE_IMAGES = (  # seconds to a minute of the reference
    "one Gaussian covers a 4K image",
    "an image of 4096 by 4096 px",
    "an image 16384 px wide and 8 high",
    "an image 8 px wide and 16384 high",
)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] * (name in LARGE_IMAGES)) for name in extreme_scenes.CASES]
)
def test_backends_agree_within_bounds_and_stay_finite(name):
    case = extreme_scenes.CASES[name]()
    assert_within_bars(case.inputs, case.camera, case.background, settings=case.settings)


@pytest.mark.parametrize("side", ["height", "width"])
def test_one_gaussian_covers_the_middle_strips_of_a_4k_image(side):
    case, thickness = extreme_scenes.CASES["one Gaussian covers a 4K image"](), 24
    intrinsics = case.camera.intrinsics.copy()
    intrinsics[int(side == "height"), 2] = thickness / 2
    view = dataclasses.replace(case.camera, intrinsics=intrinsics, **{side: thickness})
    assert_within_bars(case.inputs, view, case.background, settings=case.settings)


# Expected pictures


def render(name, backend):
    """A case of `extreme_scenes` with its result, gradients and stats."""
    case = extreme_scenes.CASES[name]()
    return case, *draw(case.inputs, case.camera, backend, case.background, settings=case.settings)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["centres at the near plane", "centres at the default near plane"])
def test_centres_are_drawn_from_one_step_beyond_the_near_plane_on(name, backend):
    case, result, gradients, stats = render(name, backend)
    beyond = case.inputs[0][:, 2].double() > case.settings.near_plane
    assert torch.equal(stats.visible, beyond) and 0 < beyond.sum() < len(beyond)
    assert (gradients["means"][~beyond] == 0).all() and (gradients["channels"][beyond] != 0).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_gaussians_around_the_camera_are_not_drawn_unless_their_centre_lies_before_it(backend):
    case, result, gradients, stats = render("camera inside Gaussians", backend)
    behind = case.inputs[0][:, 2] <= NEAR
    assert behind.sum() == 10 and stats.visible[~behind].all() and not stats.visible[behind].any()
    assert not gradients["opacities"][behind].any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_opacities_are_visible_from_alpha_min_on_and_capped_at_alpha_max(backend):
    case, result, gradients, stats = render("opacities at their limits", backend)
    for i, opacity in enumerate(case.inputs[3].tolist()):
        alone = [values[i : i + 1] for values in case.inputs]
        alpha = rasterize_splats(*alone, case.camera, backend=backend).alpha
        assert bool(stats.visible[i]) == (opacity >= ALPHA_MIN) == bool(alpha.any())
        assert alpha.max().item() == pytest.approx(min(opacity, ALPHA_MAX) if opacity >= ALPHA_MIN else 0, rel=1e-6)
        if abs(opacity - ALPHA_MIN) < 1e-6:
            assert (alpha > 0).sum() == (opacity >= ALPHA_MIN)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("steps", [-1, 0, 1])
def test_the_gradient_of_an_opacity_ends_where_the_cap_begins(steps, backend):
    opacity = extreme_scenes.ulp(ALPHA_MAX, steps)
    view = extreme_scenes.view(1, 1, 64.0)
    inputs = [torch.tensor([[0.0, 0, 2]]), torch.ones(1, 4), torch.full((1, 3), 0.1), torch.tensor([opacity])]
    inputs[3].requires_grad_()
    rasterize_splats(*inputs, torch.ones(1, 1), view, backend=backend).alpha.sum().backward()
    assert inputs[3].grad.item() == pytest.approx(1.0 if opacity <= ALPHA_MAX else 0.0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_ten_thousand_opaque_layers_show_only_the_nearest(backend):
    case, result, gradients, _ = render("ten thousand opaque layers", backend)
    expected = 0.99 * case.inputs[4][0].double() + 0.01 * case.background.double()
    assert (result.image[0, 0] - expected).abs().max() < FORWARD
    assert (result.alpha - 0.99).abs().max() < 1e-6
    assert gradients["channels"][0].all() and not gradients["channels"][1:].any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_layer_that_would_bring_transmittance_to_the_minimum_exactly_is_invisible(backend):
    case, result, gradients, _ = render("half transparent layers", backend)
    passed = torch.cumprod(1 - case.inputs[3].double(), 0)
    assert case.settings.transmittance_min in passed.tolist()
    seen = passed > case.settings.transmittance_min
    assert (result.alpha - (1 - passed[seen].min())).abs().max() < 1e-6
    assert torch.equal((gradients["channels"] != 0).any(1), seen)


@pytest.mark.parametrize("backend", BACKENDS)
def test_thin_layers_are_visible_until_transmittance_would_fall_below_its_minimum(backend):
    case = extreme_scenes.CASES["ten thousand thin layers"]()
    case.inputs[0][:, 0] = 0  # the very middle of the pixel, where alpha is the opacity
    result, gradients, _ = draw(case.inputs, case.camera, backend)
    count = math.floor(math.log(1e-4) / math.log1p(-case.inputs[3][0].item()))
    seen = (gradients["channels"] != 0).any(1)
    assert seen[:count].all() and not seen[count:].any()
    assert result.alpha.item() == pytest.approx(1 - 0.996**count, abs=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_lower_row_of_coincident_gaussians_is_in_front(backend):
    inputs, view = extreme_scenes.cloud(50, 50, seed=1), extreme_scenes.view(1, 1)
    inputs[0][:], inputs[4] = torch.tensor([0.0, 0.0, 3.0]), torch.eye(50)
    opacities = inputs[3].double()
    passed = torch.cumprod(1 - opacities, 0)
    expected = torch.where(passed >= 1e-4, opacities * passed / (1 - opacities), 0)
    weights = rasterize_splats(*inputs, view, backend=backend).image[0, 0].double()
    assert 5 < (expected > 0).sum() < 50
    torch.testing.assert_close(weights, expected, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_depths_are_sorted_in_float64(backend):
    """Two planes a micrometre apart at a distance of a hundred: float32 cannot tell them apart, their order can."""
    T_cam_world = np.eye(4)
    T_cam_world[2, 3] = 100.0
    view = extreme_scenes.view(3, 3, 1000.0, T_cam_world)
    means = torch.tensor([[0.0, 0, 1e-6], [0, 0, 0]])
    inputs = [means, torch.ones(2, 4), torch.ones(2, 3), torch.tensor([0.75, 0.5]), torch.eye(2)]
    assert torch.tensor(100.0) + 1e-6 == 100.0
    image = rasterize_splats(*inputs, view, backend=backend).image
    torch.testing.assert_close(image[1, 1], torch.tensor([0.375, 0.5]), atol=FORWARD, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_scene_looks_the_same_far_from_the_origin(backend):
    inputs, view = extreme_scenes.cloud(200, seed=2, sigma=1.0), extreme_scenes.view()
    inputs[0] = (inputs[0] * 20 * 16).round() / 16
    shift = torch.tensor([1e6, -1e6, 1e6])
    T_cam_world = view.T_cam_world.copy()
    T_cam_world[:3, 3] = -shift.numpy()
    far = dataclasses.replace(view, T_cam_world=T_cam_world)
    here = rasterize_splats(*inputs, view, backend=backend)
    there = rasterize_splats(inputs[0] + shift, *inputs[1:], far, backend=backend)
    assert here.alpha.max() > 0.5
    assert (here.image - there.image).abs().max() < FORWARD and (here.depth - there.depth).abs().max() < 1e-3


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_middle_of_a_wide_image_equals_a_small_image(backend):
    inputs = extreme_scenes.cloud(100, seed=3)
    inputs[0][:, :2] *= 0.002
    wide, small = (
        rasterize_splats(*inputs, extreme_scenes.view(width, 8, 8000.0), backend=backend) for width in (16384, 40)
    )
    middle = slice(8192 - 10, 8192 + 10)
    assert small.alpha[:, 10:30].max() > 0.5
    assert (wide.image[:, middle] - small.image[:, 10:30]).abs().max() < FORWARD


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_falloff_of_a_gaussian_is_correct_in_all_corners_of_a_4k_image(backend):
    view = extreme_scenes.view(3840, 2160, 3000.0)
    inputs = extreme_scenes.cloud(1, 1)
    inputs[0][:], inputs[2][:], inputs[3][:] = torch.tensor([0.0, 0, 3]), 2.0, 0.8
    with torch.no_grad():
        alpha = rasterize_splats(*inputs, view, backend=backend).alpha
    x, y = torch.tensor([0, 0, 3839, 3839, 1920]) + 0.5, torch.tensor([0, 2159, 0, 2159, 1080]) + 0.5
    u, v = (x - 1920) / 3000, (y - 1080) / 3000
    # the centre is on the axis, where the projection is that of a plane
    expected = 0.8 * torch.exp(-0.5 * 9 * (u**2 + v**2) / (4 + 0.3 / 1000**2))
    torch.testing.assert_close(alpha[y.long(), x.long()], expected, atol=FORWARD, rtol=0)


# Invalid input


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("name", "position", "index"), [
    ("means", 0, (9, 2)), ("quats", 1, (0, 0)), ("scales", 2, (3, 1)), ("opacities", 3, (4,)), ("channels", 4, (9, 1)),
])  # fmt: skip
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_value_that_is_not_finite_is_named_with_its_index(name, position, index, value, backend):
    inputs = [t.float() for t in splats(10, 2)]
    inputs[position][index] = value
    with pytest.raises(ValueError, match=rf"^{name}: expected finite values, found {value} at index ") as caught:
        rasterize_splats(*inputs, camera(), backend=backend)
    assert str(index) in str(caught.value)


@pytest.mark.parametrize("shape", [(2,), (40, 48, 2)])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_background_that_is_not_finite_is_named_with_its_index(shape, value):
    background = torch.zeros(shape)
    background.view(-1)[-1] = value
    last = tuple(n - 1 for n in shape)
    with pytest.raises(ValueError, match="^background: expected finite values") as caught:
        rasterize_splats(*[t.float() for t in splats(10, 2)], camera(), background)
    assert str(last) in str(caught.value)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("name", "index"), [("intrinsics", (0, 2)), ("intrinsics", (1, 1)), ("T_cam_world", (2, 3))])
def test_a_camera_that_is_not_finite_is_named_with_the_index(name, index, value):
    view = camera()
    matrix = getattr(view, name).copy()
    matrix[index] = value
    broken = dataclasses.replace(view, name="front", **{name: matrix})
    with pytest.raises(ValueError, match=f"^camera 'front': {name}: expected finite values, found {value}") as caught:
        rasterize_splats(*[t.float() for t in splats(10, 2)], broken)
    assert str(index) in str(caught.value)


@pytest.mark.parametrize("change", [
    {"width": 0}, {"height": -1}, {"intrinsics": np.diag([-50.0, 50, 1])}, {"intrinsics": np.diag([50.0, 0, 1])},
    {"intrinsics": np.eye(4)}, {"T_cam_world": np.eye(4)[:3]},
])  # fmt: skip
def test_a_camera_without_an_image_is_refused(change):
    with pytest.raises(ValueError, match="^camera: .*expected.*(got|found)"):
        rasterize_splats(*[t.float() for t in splats(10, 2)], dataclasses.replace(camera(), **change))


@pytest.mark.parametrize(("position", "index", "value", "message"), [
    (2, (6, 1), -1e-30, r"scales: expected 0 or more, found -1e-30 at index \(6, 1\); remedy: pass exp"),
    (3, (7,), -0.25, r"opacities: expected values from 0 to 1, found -0.25 at index \(7,\); remedy: pass sigmoid"),
    (3, (8,), 1.5, r"opacities: expected values from 0 to 1, found 1.5 at index \(8,\); remedy: pass sigmoid"),
])  # fmt: skip
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_outside_their_range_are_named_with_the_first_index(position, index, value, message, dtype):
    inputs = [t.to(dtype) for t in splats(10, 2)]
    inputs[position][index] = inputs[position][(9, *index[1:])] = value
    with pytest.raises(ValueError, match=message):
        rasterize_splats(*inputs, camera())


def test_minus_zero_is_a_scale_and_an_opacity():
    inputs = [t.float() for t in splats(10, 2)]
    inputs[2][3, 0], inputs[3][4] = -0.0, -0.0
    assert torch.isfinite(rasterize_splats(*inputs, camera()).image).all()


@pytest.mark.parametrize("labels", [torch.rand(10), torch.tensor([math.nan] * 10), torch.arange(9)])
def test_labels_that_are_no_integers_or_too_few_are_named(labels):
    with pytest.raises(ValueError, match="^labels: expected 10 integers, got"):
        rasterize_splats(*[t.float() for t in splats(10, 2)], camera(), labels=labels)


def test_values_whose_sum_overflows_are_drawn():
    inputs = [t.float() for t in splats(10, 2)]
    inputs[4][:] = torch.finfo(torch.float32).max / 4
    stats = RasterStats()
    image = rasterize_splats(*inputs, camera(), stats=stats).image
    assert stats.visible.any() and torch.isfinite(image).all()
