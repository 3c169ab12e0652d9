"""Colours from spherical harmonics: the kernels against plain torch in float64, with every gradient."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r5dgs_core.raster import backends, rasterize, rasterizer, shade, thread_pool
from r5dgs_core.raster.cpu import forward
from r5dgs_core.render import posed_scene
from r5dgs_core.scene import spherical_harmonics
from r5dgs_core.scene.cameras import Camera
from tests.support import scenes, splats

EYE = np.array([0.4, -3.0, 1.5])
COUNTS = [4, 9, 16]


def draw(n, count, seed=0, poses=5):
    """Gaussians with a factor and poses whose maps are neither rotations nor of one size."""
    random = np.random.default_rng(seed)
    tensors = {
        "means": random.normal(size=(n, 3)),
        "sh": 0.7 * random.normal(size=(n, count, 3)),
        "factor": random.uniform(0, 2, n),
    }
    where = {
        "eyes": random.normal(size=(poses, 3)) * 3,
        "view_maps": random.normal(size=(poses, 3, 3)),
        "pose_ids": random.integers(0, poses, n),
    }
    return {name: torch.tensor(value, dtype=torch.float32) for name, value in tensors.items()}, where


def differentiate(function, tensors, seed=7):
    """Value of a function of named tensors, and the gradients of a fixed sum over it."""
    leaves = {name: value.clone().requires_grad_() for name, value in tensors.items()}
    value = function(**leaves)
    weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(seed))
    (value * weights.to(value.dtype)).sum().backward()
    return value.detach(), {name: leaf.grad for name, leaf in leaves.items()}


def assert_near(found, expected, tolerance, name=""):
    scale = max(float(expected.abs().max()), 1e-30)
    torch.testing.assert_close(found.double() / scale, expected.double() / scale, rtol=0, atol=tolerance, msg=name)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("n", [1, 9, 700])
def test_colours_and_every_gradient_are_those_of_plain_autograd(n, count):
    tensors, where = draw(n, count)
    wide = {name: value.double() for name, value in tensors.items()}
    value, gradients = differentiate(lambda **t: shade.seen_colors(**t, **where), tensors)
    expected, wanted = differentiate(lambda **t: shade.seen_colors(**t, **where), wide)
    if n > 100:
        assert (expected == 0).any() and (expected > 1).any()  # clamped below, not above
    assert_near(value, expected, 2e-6)
    for name, gradient in gradients.items():
        assert_near(gradient, wanted[name], 2e-6, name)


@pytest.mark.parametrize("count", COUNTS)
def test_the_gradient_along_the_line_of_sight_is_zero_and_across_it_a_difference(count):
    tensors, _ = draw(50, count)
    means = (tensors["means"].double() + torch.tensor([0, 9.0, 0])).requires_grad_()
    sh = tensors["sh"]
    shade.seen_colors(means.float(), sh, EYE).sum().backward()
    offsets = means.detach() - torch.from_numpy(EYE)
    assert (means.grad * offsets).sum(-1).abs().max() < 1e-5 * means.grad.abs().max() * offsets.norm(dim=-1).max()
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-5
        ahead, behind = (shade.seen_colors(means.detach() + side * step, sh.double(), EYE).sum(-1) for side in (1, -1))
        torch.testing.assert_close((ahead - behind) / 2e-5, means.grad[:, axis].double(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("count", COUNTS)
def test_coefficients_may_be_given_in_two_parts(count):
    tensors, where = draw(300, count)
    means, factor = tensors["means"], tensors["factor"]
    parts = {"sh": tensors["sh"][:, :1], "rest": tensors["sh"][:, 1:]}
    whole, gradients = differentiate(
        lambda sh: shade.seen_colors(means, sh, factor=factor, **where), {"sh": tensors["sh"]}
    )
    value, of_parts = differentiate(lambda **t: shade.seen_colors(means, factor=factor, **t, **where), parts)
    assert torch.equal(value, whole)
    assert torch.equal(torch.cat([of_parts["sh"], of_parts["rest"]], 1), gradients["sh"])


def test_results_do_not_depend_on_the_number_of_threads():
    tensors, where = draw(9001, 16)
    before, results = thread_pool.threads(), []
    try:
        for threads in (1, 2, 3):
            thread_pool.set_threads(threads)
            value, gradients = differentiate(lambda **t: shade.seen_colors(**t, **where), tensors)
            sky = shade.sky(tensors["sh"][0].numpy(), scenes.orbit_camera(0.3, 90, 300))
            results.append([value, *gradients.values(), torch.from_numpy(sky)])
    finally:
        thread_pool.set_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_a_gaussian_at_the_eye_shows_degree_zero_and_sends_no_gradient_to_its_centre(backend):
    tensors, _ = draw(40, 16)
    eye = tensors["means"][3].double().numpy()
    colors, gradients = differentiate(
        lambda means, sh: shade.seen_colors(means, sh, eye, backend=backend),
        {name: tensors[name] for name in ("means", "sh")},
    )
    torch.testing.assert_close(colors[3], spherical_harmonics.dc_to_rgb(tensors["sh"][3, 0]).clamp_min(0))
    assert (gradients["means"][3] == 0).all() and (gradients["sh"][3, 1:] == 0).all()
    assert all(torch.isfinite(gradient).all() for gradient in gradients.values())
    assert (gradients["means"][4] != 0).any()


def test_far_from_the_origin_colours_are_those_near_it_to_the_bit():
    tensors, _ = draw(200, 16)
    means = (4 * tensors["means"]).round() / 4  # a grid that float32 still has at 2^20
    far = means + 2.0**20
    assert torch.equal(far - 2.0**20, means)
    near = shade.seen_colors(means, tensors["sh"], EYE)
    assert torch.equal(shade.seen_colors(far, tensors["sh"], EYE + 2.0**20), near)


@pytest.mark.parametrize("backend", ["auto", "reference"])
@pytest.mark.parametrize("count", [1, *COUNTS])
def test_clamped_colours_have_no_gradient(count, backend):
    tensors, _ = draw(30, count)
    dark = tensors["sh"].clone()
    dark[:, 0, 1] -= 50
    colors, gradients = differentiate(
        lambda means, sh: 0 * means.sum() + shade.seen_colors(means, sh, EYE, backend=backend),
        {"means": tensors["means"], "sh": dark},
    )
    assert (colors[:, 1] == 0).all() and (gradients["sh"][..., 1] == 0).all()
    assert (gradients["sh"][..., 0] != 0).any()
    dark[:, 0] -= 50
    _, gradients = differentiate(
        lambda means, sh: 0 * means.sum() + shade.seen_colors(means, sh, EYE, backend=backend),
        {"means": tensors["means"], "sh": dark},
    )
    assert (gradients["means"] == 0).all()


def test_no_gaussians_have_no_colours_and_no_gradients():
    tensors, where = draw(0, 9)
    colors, gradients = differentiate(lambda **t: shade.seen_colors(**t, **where), tensors)
    assert colors.shape == (0, 3)
    assert {name: tuple(g.shape) for name, g in gradients.items()} == {"means": (0, 3), "sh": (0, 9, 3), "factor": (0,)}


@pytest.mark.parametrize("count", COUNTS)
def test_gradients_through_the_rasterizer_are_those_of_plain_colours(count):
    means, quats, scales, opacities, _ = (t.float() for t in splats.splats(300, 3, seed=5))
    tensors = {"means": means, "quats": quats, "log_scales": scales.log(), "sh": draw(300, count)[0]["sh"]}
    view = scenes.orbit_camera(0.3, 48, 40)

    def render(fused, **named):
        gaussians = SimpleNamespace(**named, opacity_logits=torch.logit(opacities, 1e-4))
        colors = None if fused else rasterizer.seen_colors(gaussians, view, backend="reference")
        return rasterize(gaussians, view, colors=colors).color

    value, gradients = differentiate(lambda **t: render(True, **t), tensors)
    expected, wanted = differentiate(lambda **t: render(False, **t), tensors)
    torch.testing.assert_close(value, expected, rtol=0, atol=1e-5)
    assert float(wanted["sh"].abs().max()) > 0
    for name, gradient in gradients.items():
        assert_near(gradient, wanted[name], 1e-5, name)


def test_a_coefficient_that_is_not_a_number_is_an_error_and_not_a_black_dot():
    means, quats, scales, opacities, _ = (t.float() for t in splats.splats(20, 3))
    sh = draw(20, 4)[0]["sh"]
    sh[7, 2, 1] = float("nan")
    broken = SimpleNamespace(
        means=means, quats=quats, log_scales=scales.log(), opacity_logits=torch.logit(opacities, 1e-4), sh=sh
    )
    with pytest.raises(ValueError, match=r"\(7, "):
        rasterize(broken, scenes.orbit_camera(0.0))


@pytest.mark.parametrize("kind", ["array", "tensor"])
def test_changing_poses_after_a_call_does_not_change_gradients(kind):
    tensors, where = draw(40, 4)
    where = {name: np.ascontiguousarray(value) for name, value in where.items()}
    expected = differentiate(lambda **t: shade.seen_colors(**t, **where), tensors)[1]
    if kind == "tensor":
        where["pose_ids"] = torch.from_numpy(where["pose_ids"])

    def shade_and_forget(**named):
        colors = shade.seen_colors(**named, **where)
        for value in where.values():
            value[:] = 0
        return colors

    found = differentiate(shade_and_forget, tensors)[1]
    assert all(torch.equal(found[name], gradient) for name, gradient in expected.items())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sh": torch.zeros(6, 4, 3)}, r"sh: expected shape \(5, 4, 3\), got \(6, 4, 3\)"),
        ({"sh": torch.zeros(5, 4)}, "sh: expected shape"),
        ({"sh": torch.zeros(5, 5, 3)}, "1, 4, 9 or 16"),
        ({"rest": torch.zeros(5, 3, 3)}, r"sh: expected shape \(5, 1, 3\)"),
        ({"sh": torch.zeros(5, 1, 3), "rest": torch.zeros(4, 3, 3)}, r"sh_rest: expected shape \(5, 3, 3\)"),
        ({"factor": torch.zeros(5, 1)}, "factor: expected shape"),
        ({"pose_ids": np.array([0, 1, 2, 3, 9])}, "pose_ids: expected 5 rows of 5 poses"),
        ({"pose_ids": np.zeros(4, int)}, "pose_ids"),
        ({"eyes": np.zeros((2, 3))}, "view_maps: expected one for each of 2 eyes, got 5"),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    tensors, where = draw(5, 4)
    with pytest.raises(ValueError, match=message):
        shade.seen_colors(**{**tensors, **where, **change})


def test_degree_zero_needs_no_kernel_and_other_tensors_take_none(monkeypatch):
    def refuse(*_):
        raise AssertionError("a kernel ran")

    monkeypatch.setattr(forward, "run", refuse)
    constant, _ = draw(5, 1)
    expected = (0.5 + 0.28209479177387814 * constant["sh"][:, 0]).clamp_min(0) * constant["factor"][:, None]
    torch.testing.assert_close(shade.seen_colors(**constant, eyes=EYE), expected)
    tensors, where = draw(5, 4)
    shade.seen_colors(**{name: value.double() for name, value in tensors.items()}, **where)
    shade.seen_colors(**tensors, **where, backend="reference")
    with pytest.raises(AssertionError, match="a kernel ran"):
        shade.seen_colors(**tensors, **where)


@pytest.mark.parametrize("count", [1, *COUNTS])
def test_the_sky_is_the_harmonics_along_each_ray(count, monkeypatch):
    sh = np.random.default_rng(count).normal(scale=2.0, size=(count, 3))
    sh[0] = 0
    intrinsics = np.array([[40.0, 3.0, 11.0], [0, 55.0, 70.0], [0, 0, 1]])
    for camera in (scenes.orbit_camera(0.7, 60, 130), Camera(70, 30, intrinsics, scenes.orbit_camera(2.0).T_cam_world)):
        image = shade.sky(sh, camera)
        assert image.shape == (camera.height, camera.width, 3) and image.dtype == np.float32
        assert count == 1 or ((image == 0).any() and (image == 1).any())
        with monkeypatch.context() as without_numba:
            without_numba.setattr(backends, "MODULES", {"reference": "reference"})
            np.testing.assert_allclose(image, shade.sky(sh, camera), atol=1e-6)


def test_without_numba_scenes_keep_their_colours(monkeypatch):
    from r5dgs_core.playback import scene_player
    from r5dgs_core.render import scene_renderer

    scene, camera = scenes.make_scene(300, sh_degree=3), scenes.orbit_camera(0.4)
    posed = posed_scene.pose_frame(scene, scene_player.Player(scene).frame(1.1))
    fused = scene_renderer.colors(posed, camera)
    monkeypatch.setattr(backends, "MODULES", {"reference": "reference"})
    np.testing.assert_allclose(scene_renderer.colors(posed, camera), fused, atol=2e-6)
