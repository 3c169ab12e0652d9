"""The reference implements 3D Gaussian splatting, and the fast backend agrees with it."""

import importlib.util
import math
import multiprocessing
import os
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r5dgs_core import errors
from r5dgs_core.raster import (
    RasterSettings,
    RasterStats,
    backends,
    rasterize,
    rasterize_splats,
    rasterizer,
    thread_pool,
)
from r5dgs_core.raster.cpu import blend, blend_backward, forward, projection, tiles
from r5dgs_core.render import warm_up
from r5dgs_core.scene import cameras, spherical_harmonics
from tests.support.splats import camera, draw, relative, splats

pytestmark = pytest.mark.heavy

# float32 against float64: rounding grows with the number of layers; the largest seen on these scenes is about 3e-6
TOLERANCE = 2e-5


def one_splat(z=3.0, sigma=0.2, opacity=0.8, value=(0.2, 0.5, 0.9)):
    """A round Gaussian at depth z on the optical axis of `straight_camera`."""
    return [
        torch.tensor([[0.0, 0.0, z]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.full((1, 3), sigma),
        torch.tensor([opacity]),
        torch.tensor([value]),
    ]


def straight_camera(width=33, height=33, focal=40.0):
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return cameras.Camera(width, height, intrinsics, np.eye(4))


def stack(*scenes):
    return [torch.cat(parts) for parts in zip(*scenes, strict=True)]


# A single Gaussian


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_one_gaussian_has_its_opacity_in_the_middle_and_falls_off_as_projected(backend):
    view = straight_camera()
    result = rasterize_splats(*one_splat(), view, backend=backend)
    variance = (40.0 * 0.2 / 3.0) ** 2 + 0.3
    distance = torch.arange(33) - 16.0
    expected = 0.8 * torch.exp(-0.5 * distance**2 / variance)
    expected = torch.where(expected >= 1 / 255, expected, 0)
    torch.testing.assert_close(result.alpha[16], expected, atol=2e-6, rtol=1e-5)
    torch.testing.assert_close(result.image[16, 16], 0.8 * torch.tensor([0.2, 0.5, 0.9]), atol=1e-6, rtol=1e-5)
    assert result.depth[16, 16].item() == pytest.approx(3.0, rel=1e-6)
    assert result.depth[0, 0] == 0 and result.alpha[0, 0] == 0


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_nearer_gaussians_cover_farther_ones_whatever_their_order(backend):
    near = one_splat(z=2.0, opacity=0.6, value=(1.0, 0.0, 0.0))
    far = one_splat(z=4.0, opacity=0.5, value=(0.0, 1.0, 0.0))
    for scene in (stack(near, far), stack(far, near)):
        result = rasterize_splats(*scene, straight_camera(), torch.ones(3), backend=backend)
        torch.testing.assert_close(result.image[16, 16], torch.tensor([0.8, 0.4, 0.2]), atol=1e-6, rtol=1e-5)
        expected_depth = (0.6 * 2.0 + 0.2 * 4.0) / 0.8
        assert result.depth[16, 16].item() == pytest.approx(expected_depth, rel=1e-5)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_centres_are_projected_as_by_the_camera(backend):
    view = camera(skew=3.0, offset=(2.0, -1.5))
    mean = np.array([[0.2, -0.3, 0.4]])
    pixel, depth = cameras.project(view, mean)
    scene = one_splat(sigma=0.05, opacity=0.9)
    scene[0] = torch.tensor(mean, dtype=torch.float32)
    alpha = rasterize_splats(*scene, view, backend=backend).alpha.numpy().astype(np.float64)
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    # The cut at 1/255 falls unevenly on the pixels around it.
    np.testing.assert_allclose([(alpha * x).sum(), (alpha * y).sum()] / alpha.sum(), pixel[0], atol=0.01)
    assert rasterize_splats(*scene, view, backend=backend).depth.max().item() == pytest.approx(depth[0], rel=1e-5)


def test_reference_is_the_loop_of_3dgs():
    """Pixel by pixel and Gaussian by Gaussian, as in the definition: an oracle of the oracle."""
    view, settings = camera(8, 6), RasterSettings()
    means, quats, scales, opacities, channels = scene = splats(60, 2, seed=3, radius_px=60.0)
    opacities[::3] = 0.999
    scales[:6] = 30.0
    result = rasterize_splats(*scene, view, backend="reference")
    T, k = view.T_cam_world, view.intrinsics
    order = np.argsort((means.numpy() @ T[2, :3]) + T[2, 3])
    image, passed = np.zeros((6, 8, 2)), np.ones((6, 8))
    stopped = capped = 0
    for y in range(6):
        for x in range(8):
            for i in order:
                p = T[:3, :3] @ means[i].numpy() + T[:3, 3]
                w, qx, qy, qz = quats[i].numpy() / np.linalg.norm(quats[i].numpy())
                cross = np.array([[0, -qz, qy], [qz, 0, -qx], [-qy, qx, 0]])
                rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
                low = -k[:2, 2] / k[[0, 1], [0, 1]] - 0.15 * np.array([8, 6]) / k[[0, 1], [0, 1]]
                u, v = np.clip(p[:2] / p[2], low, -low)
                jacobian = np.array([[k[0, 0], 0, -k[0, 0] * u], [0, k[1, 1], -k[1, 1] * v]]) / p[2]
                axes = jacobian @ T[:3, :3] @ rotation @ np.diag(scales[i].numpy())
                offset = np.array([x + 0.5, y + 0.5]) - (k @ p)[:2] / p[2]
                mahalanobis = offset @ np.linalg.solve(axes @ axes.T + 0.3 * np.eye(2), offset)
                alpha = opacities[i].item() * math.exp(-0.5 * mahalanobis)
                capped += alpha > settings.alpha_max
                alpha = min(alpha, settings.alpha_max)
                if alpha < settings.alpha_min:
                    continue
                if passed[y, x] * (1 - alpha) < settings.finished_at:
                    stopped += 1
                    break
                image[y, x] += passed[y, x] * alpha * channels[i].numpy()
                passed[y, x] *= 1 - alpha
    assert stopped and capped, "the scene must exercise both cut-offs"
    np.testing.assert_allclose(result.image.numpy(), image, atol=1e-12)
    np.testing.assert_allclose(result.alpha.numpy(), 1 - passed, atol=1e-12)


def test_reference_gradients_are_differences():
    view, scene = camera(7, 6), [t.requires_grad_() for t in splats(5, 2, seed=1, radius_px=40.0)]

    def outputs(*inputs):
        result = rasterize_splats(*inputs, view, torch.full((2,), 0.3, dtype=torch.float64), backend="reference")
        return result.image, result.alpha, result.depth

    assert torch.autograd.gradcheck(outputs, scene, eps=1e-7, atol=1e-5, rtol=1e-4)


# The fast backend agrees


@pytest.mark.parametrize("n_channels", [1, 3, 4, 5, 19])
def test_cpu_agrees_with_the_reference_in_images_and_gradients(n_channels):
    scene = splats(n_channels=n_channels, seed=n_channels)
    background = torch.rand(40, 48, n_channels, generator=torch.Generator().manual_seed(1)).double()
    assert_backends_agree(scene, camera(), background)


@pytest.mark.parametrize("size", [(1, 1), (33, 31), (65, 70)])
def test_cpu_agrees_with_the_reference_at_any_size(size):
    assert_backends_agree(splats(300, 3, seed=5), camera(*size, skew=2.0, offset=(1.5, -2.0)), torch.rand(3).double())


def test_cpu_agrees_with_the_reference_if_pixels_finish_early():
    scene = splats(800, 3, seed=6, radius_px=25.0)
    scene[3] = (0.9 + 0.1 * scene[3]).float().double()
    assert assert_backends_agree(scene, camera()).alpha.min() > 0.99


def assert_backends_agree(scene, view, background=None, tolerance=TOLERANCE):
    expected, expected_gradients, expected_stats = draw(scene, view, "reference", background)
    found, gradients, stats = draw(scene, view, "cpu", background)
    for name in ("image", "alpha", "depth"):
        assert relative(getattr(found, name), getattr(expected, name)) < tolerance, name
    for name, gradient in expected_gradients.items():
        assert relative(gradients[name], gradient) < tolerance, name
    assert torch.equal(stats.visible, expected_stats.visible)
    assert relative(stats.radii, expected_stats.radii) < tolerance
    assert relative(stats.grad_norm, expected_stats.grad_norm) < tolerance
    return found


def test_needles_and_discs_keep_their_gradients():
    scene = splats(60, 3, seed=8)
    scene[2][:20] = torch.tensor([3e-4, 3e-4, 1.0])
    scene[2][20:40] = torch.tensor([1.0, 1.0, 1e-3])
    scene[2][40:50] = torch.tensor([0.0, 0.0, 0.5])
    scene = [t.float().double() for t in scene]
    # Pixels see needles under a cut-off that one rounding can move, so a few terms of 1/255 may differ.
    assert_backends_agree(scene, camera(), tolerance=3e-4)


def test_gaussians_off_the_frustum_keep_their_gradients():
    scene = splats(200, 3, seed=9, radius_px=60.0)
    scene[0] = (scene[0] * torch.tensor([4.0, 4.0, 1.0])).float().double()
    assert_backends_agree(scene, camera(), tolerance=1e-4)


def test_results_do_not_depend_on_the_number_of_threads():
    scene, view = splats(9000, 3, seed=10, radius_px=3.0), camera(150, 130, 160.0)
    before, background = thread_pool.threads(), torch.tensor([0.1, 0.5, 0.9])
    try:
        results = []
        for count in (1, 2, 3):
            thread_pool.set_threads(count)
            result, gradients, stats = draw(scene, view, "cpu", background)
            results.append([result.image, result.alpha, result.depth, *gradients.values(), stats.grad_norm])
    finally:
        thread_pool.set_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("seed", range(3))
def test_rows_are_sorted_by_depth_and_then_by_row_on_any_number_of_threads(seed):
    random = np.random.default_rng(seed)
    depths = 1 + random.integers(0, 40, 30_000) * (2.0**-20 if seed else 1.0)
    depths += random.integers(0, 3, 30_000) * 1e-12  # equal in float32
    radii = random.integers(0, 2, 30_000).astype(np.float32)
    expected = np.argsort(depths, kind="stable")
    expected = expected[radii[expected] > 0]
    before = thread_pool.threads()
    try:
        for count in (1, 2, 3):
            thread_pool.set_threads(count)
            np.testing.assert_array_equal(tiles.sort_by_depth(depths, radii), expected)
    finally:
        thread_pool.set_threads(before)


def test_two_python_threads_can_draw_at_once():
    scene, view = splats(5000, 3, seed=11, radius_px=4.0), camera(150, 130, 160.0)
    expected = draw(scene, view, "cpu")[1]
    found = []
    workers = [threading.Thread(target=lambda: found.append(draw(scene, view, "cpu")[1])) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(found) == 4
    assert all(torch.equal(gradients[name], expected[name]) for gradients in found for name in gradients)


def test_every_kernel_is_compiled_once_for_all_inputs():
    warm_up.warm_up()
    for n_channels, background, labels in ((1, None, None), (3, torch.rand(3), torch.arange(50)), (19, None, None)):
        draw(splats(50, n_channels), camera(), "cpu", background, labels=labels)
    kernels = [
        *(projection.project, projection.project_backward, tiles.sort_part),
        *(tiles.count_pairs, tiles.fill_pairs, blend.blend, blend_backward.blend_backward),
    ]
    assert {kernel.py_func.__name__: len(kernel.signatures) for kernel in kernels} == {
        kernel.py_func.__name__: 1 for kernel in kernels
    }


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forking is a POSIX matter")
def test_a_forked_child_draws_too():
    scene, view = [t.float() for t in splats(9000, 3, seed=10, radius_px=3.0)], camera(150, 130, 160.0)
    before = thread_pool.threads()
    thread_pool.set_threads(2)
    try:
        expected = rasterize_splats(*scene, view).image
        context = multiprocessing.get_context("fork")
        receiver, sender = context.Pipe(duplex=False)
        child = context.Process(target=lambda: sender.send(rasterize_splats(*scene, view).image.numpy().tobytes()))
        child.start()
        assert receiver.poll(60), "the child hangs"
        assert receiver.recv() == expected.numpy().tobytes()
        child.join()
    finally:
        thread_pool.set_threads(before)


# Laws of gradients


def test_the_gradient_of_the_background_is_the_transmittance():
    scene, view = splats(300, 3, seed=12), camera()
    background = torch.rand(40, 48, 3, requires_grad=True)
    result = rasterize_splats(*[t.float() for t in scene], view, background)
    result.image.sum().backward()
    torch.testing.assert_close(background.grad, (1 - result.alpha)[..., None].expand(-1, -1, 3), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("position", range(5))
def test_gradients_do_not_depend_on_the_other_requested_gradients(backend, position):
    scene, view = splats(200, 19, seed=17), camera()
    expected = draw(scene, view, backend)[1]
    dtype = next(iter(expected.values())).dtype
    inputs = [t.to(dtype) for t in scene]
    inputs[position].requires_grad_()
    result = rasterize_splats(*inputs, view, backend=backend)
    generator = torch.Generator().manual_seed(7)
    outputs = (result.image, result.alpha, result.depth * result.alpha.detach())
    sum((o * torch.randn(o.shape, generator=generator, dtype=torch.float64)).sum() for o in outputs).backward()
    torch.testing.assert_close(inputs[position].grad, list(expected.values())[position])


@pytest.mark.parametrize("name", ["means", "opacities", "background", "alpha"])
def test_in_place_changes_of_tensors_needed_for_gradients_are_refused(name):
    leaves = [t.float().requires_grad_() for t in splats(50, 3)]
    background = torch.rand(40, 48, 3)
    result = rasterize_splats(*leaves, camera(), background)
    changed = {"means": leaves[0], "opacities": leaves[3], "background": background, "alpha": result.alpha}[name]
    with torch.no_grad():
        changed.mul_(0.5)
    with pytest.raises(RuntimeError, match="inplace"):
        result.image.sum().backward()


def test_the_image_may_be_changed_in_place():
    expected = draw(splats(50, 3), camera(), "cpu")[1]["channels"]
    leaves = [t.float().requires_grad_() for t in splats(50, 3)]
    result = rasterize_splats(*leaves, camera())
    generator = torch.Generator().manual_seed(7)
    outputs = (result.image.mul_(2.0), result.alpha, result.depth * result.alpha.detach())
    halves = (0.5, 1.0, 1.0)
    loss = 0
    for output, half in zip(outputs, halves, strict=True):
        upstream = torch.randn(output.shape, generator=generator, dtype=torch.float64)
        loss = loss + (half * output * upstream).sum()
    loss.backward()
    torch.testing.assert_close(leaves[4].grad, expected)


@pytest.mark.parametrize("without", [torch.no_grad, torch.inference_mode])
def test_without_gradients_nothing_is_kept_for_them(without, monkeypatch):
    leaves, kept = [t.float().requires_grad_() for t in splats(50, 3)], []
    original = forward.rasterize
    monkeypatch.setattr(forward, "rasterize", lambda *arguments: kept.append(original(*arguments)) or kept[-1])
    with without():
        still = rasterize_splats(*leaves, camera()).image
    assert kept[0][0] is None and not still.requires_grad
    assert torch.equal(rasterize_splats(*leaves, camera()).image, still) and kept[1][0] is not None


def test_second_derivatives_are_refused():
    leaves = [t.float().requires_grad_() for t in splats(50, 3)]
    image = rasterize_splats(*leaves, camera()).image
    (gradient,) = torch.autograd.grad(image.square().sum(), leaves[3], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_capped_pixels_pass_no_gradient_to_opacity(backend):
    scene = one_splat(opacity=1.0, sigma=5.0)
    opacities = scene[3].requires_grad_()
    result = rasterize_splats(*scene, straight_camera(3, 3), backend=backend)
    assert result.alpha.min().item() == pytest.approx(0.99, abs=1e-6)
    result.alpha.sum().backward()
    assert opacities.grad.item() == 0


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_length_and_sign_of_quaternions_do_not_matter(backend):
    scene, view = splats(200, 3, seed=13), camera()
    _, gradients, _ = draw(scene, view, backend)
    scaled = [*scene[:1], -3 * scene[1], *scene[2:]]
    _, scaled_gradients, _ = draw(scaled, view, backend)
    assert relative(-3 * scaled_gradients["quats"], gradients["quats"]) < TOLERANCE
    along = (gradients["quats"].double() * scene[1]).sum(1)
    assert along.abs().max() < TOLERANCE * gradients["quats"].abs().max() * scene[1].norm(dim=1).max()


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_degenerate_gaussians_draw_finite_images_with_finite_gradients(backend):
    scene, view = splats(40, 3, seed=14), camera()
    center = torch.tensor(view.center)
    forward = torch.tensor(view.forward)
    scene[0][:4] = center + forward * torch.tensor([-1.0, 0.0, 0.0100001, 0.02])[:, None]
    scene[1][4:8] = 0.0
    scene[2][6:10] = 0.0
    scene[2][10] = 1e4
    scene[2][11] = torch.tensor([1e4, 1e-6, 0.0])
    scene[2][12] = 1e-20
    scene[3][13:16] = torch.tensor([0.0, 1e-30, 1.0])
    scene[0][16:18] = torch.tensor([1e8, 0.0, 0.0])
    scene[0][18:20] = scene[0][20:22]  # pairs at exactly the same place
    result, gradients, _ = draw(scene, view, backend, torch.rand(3))
    for tensor in (result.image, result.alpha, result.depth, *gradients.values()):
        assert torch.isfinite(tensor).all()
    for name in ("means", "quats", "scales", "channels"):
        assert (gradients[name][[0, 1, 13, 14, 16]] == 0).all()


# Empty pictures


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_no_gaussians_leave_the_background(backend):
    background = torch.rand(40, 48, 3, requires_grad=True)
    result, gradients, stats = draw(splats(0, 3), camera(), backend, background)
    torch.testing.assert_close(result.image.float(), background)
    assert not result.alpha.any() and not result.depth.any()
    assert stats.visible.shape == (0,) and gradients["background"].any()


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_gaussians_behind_the_camera_or_transparent_show_the_background(backend):
    behind, transparent = one_splat(z=-3.0), one_splat(opacity=0.0)
    stats = RasterStats()
    result = rasterize_splats(
        *stack(behind, transparent), straight_camera(), torch.tensor([0.1, 0.2, 0.3]), backend=backend, stats=stats
    )
    assert torch.equal(result.image, torch.tensor([0.1, 0.2, 0.3]).expand(33, 33, 3))
    assert not stats.visible.any() and not stats.radii.any()


# Labels, colours and features


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_ids_name_the_heaviest_label(backend):
    scene = stack(
        one_splat(z=2.0, opacity=0.4), one_splat(z=3.0, opacity=0.5), one_splat(z=4.0, opacity=0.6), one_splat(z=5.0)
    )
    # weights in the middle: 0.4, 0.3, 0.18, 0.096
    for labels, winner in (([7, 2, 2, 0], 2), ([7, 2, 5, 0], 7), ([7, -1, -3, 0], -1), ([0, 0, 3, 3], 0)):
        ids = rasterize_splats(*scene, straight_camera(), labels=torch.tensor(labels), backend=backend).ids
        assert ids.dtype == torch.int32
        assert ids[16, 16] == winner
        assert ids[0, 0] == -1


def test_ids_agree_between_backends():
    scene, labels = splats(400, 1, seed=15), torch.randint(-1, 6, (400,), generator=torch.Generator().manual_seed(3))
    found, expected = (draw(scene, camera(), backend, labels=labels)[0].ids for backend in ("cpu", "reference"))
    assert (found != expected).sum() <= 1  # a tie within rounding
    assert len(found.unique()) == 7


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_ids_are_the_labels_even_if_large_and_sparse(backend):
    scene, view = splats(200, 1, seed=15), camera()
    few = torch.randint(-1, 6, (200,), generator=torch.Generator().manual_seed(3))
    names = torch.tensor([0, 7, 300, 301, 70_000, 2**20, -1])  # the last is reached as -1
    expected = draw(scene, view, backend, labels=few)[0].ids
    many = torch.where(few < 0, -5, names[few])
    found = draw(scene, view, backend, labels=many)[0].ids
    assert torch.equal(found.long(), torch.where(expected < 0, -1, names[expected.long()]))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32, torch.int64])
def test_labels_may_be_any_kind_of_integers(dtype):
    scene, labels = splats(200, 1, seed=15), torch.arange(200) % 5
    expected = draw(scene, camera(), "reference", labels=labels)[0].ids
    assert torch.equal(draw(scene, camera(), "cpu", labels=labels.to(dtype))[0].ids, expected)


@pytest.mark.parametrize("size", [(65_537, 1), (1, 65_537)])
def test_an_image_larger_than_any_rasterizer_accepts_is_refused(size):
    with pytest.raises(ValueError, match=r"camera.*1 to 65536.*65537"):
        rasterize_splats(*one_splat(), straight_camera(*size), backend="cpu")


def test_a_label_that_cannot_be_counted_is_named():
    with pytest.raises(ValueError, match=r"labels.*16777216 at index 2"):
        rasterize_splats(*[t.float() for t in splats(4, 1)], camera(), labels=torch.tensor([0, 1, 2**24, 3]))


def gaussians(n=300, k=16, seed=16):
    means, quats, scales, opacities, colors = (t.float() for t in splats(n, 3, seed=seed))
    sh = torch.cat([spherical_harmonics.rgb_to_dc(colors)[:, None], 0.2 * torch.randn(n, k - 1, 3)], 1)
    return SimpleNamespace(
        means=means, quats=quats, log_scales=scales.log(), opacity_logits=torch.logit(opacities, 1e-4), sh=sh
    )


def blended(scene, channels, view):
    """Image of any channels of the Gaussians."""
    scales, opacities = scene.log_scales.exp(), scene.opacity_logits.sigmoid()
    return rasterize_splats(scene.means, scene.quats, scales, opacities, channels, view)


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_colours_come_from_the_harmonics_along_the_line_of_sight(k):
    scene, view = gaussians(k=k), camera()
    directions = scene.means - torch.tensor(view.center, dtype=torch.float32)
    directions = directions / directions.norm(dim=1, keepdim=True)
    colors = (0.5 + spherical_harmonics.evaluate(scene.sh, directions)).clamp_min(0)
    expected = blended(scene, colors, view)
    torch.testing.assert_close(rasterize(scene, view).color, expected.image, atol=1e-5, rtol=1e-4)


def test_features_in_the_same_pass_equal_those_of_their_own():
    scene, view, features = gaussians(), camera(), torch.rand(300, 16)
    scene.object_ids = torch.randint(0, 3, (300,))
    background = torch.rand(40, 48, 3)
    both = rasterize(scene, view, features, background)
    alone = rasterize(scene, view, background=background)
    own = blended(scene, features, view)
    torch.testing.assert_close(both.color, alone.color)
    torch.testing.assert_close(both.features, own.image)
    assert alone.features is None and torch.equal(both.ids, alone.ids)
    assert rasterize(scene, view, ids=False).ids is None


def test_final_colours_replace_the_harmonics():
    scene, view = gaussians(k=4), camera()
    colors = torch.rand(300, 3, requires_grad=True)
    shown = rasterize(scene, view, colors=colors).color
    expected = blended(scene, colors, view)
    torch.testing.assert_close(shown, expected.image)
    shown.sum().backward()
    assert colors.grad.abs().sum() > 0
    torch.testing.assert_close(
        rasterize(scene, view, colors=rasterizer.seen_colors(scene, view)).color, rasterize(scene, view).color
    )


# Bad input


@pytest.mark.parametrize(
    ("position", "name", "index"),
    [
        (0, "means", (5, 1)),
        (1, "quats", (2, 3)),
        (2, "scales", (0, 0)),
        (3, "opacities", (9,)),
        (4, "channels", (7, 2)),
    ],
)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_the_first_value_that_is_not_finite_is_named(position, name, index, value):
    scene = [t.float() for t in splats(10, 3)]
    scene[position][index] = value
    with pytest.raises(ValueError, match=name) as caught:
        rasterize_splats(*scene, camera())
    assert str(index) in str(caught.value)


def test_infinities_that_cancel_are_detected():
    scene = [t.float() for t in splats(10, 3)]
    scene[0][3, 0], scene[0][4, 0] = math.inf, -math.inf
    with pytest.raises(ValueError, match=r"means.*\(3, 0\)"):
        rasterize_splats(*scene, camera())


@pytest.mark.parametrize(("position", "name"), [(0, "means"), (1, "quats"), (2, "scales"), (3, "opacities")])
def test_wrong_shapes_are_named(position, name):
    scene = [t.float() for t in splats(10, 3)]
    scene[position] = scene[position][..., :2] if position != 3 else scene[position][:2]
    with pytest.raises(ValueError, match=name):
        rasterize_splats(*scene, camera())


def test_a_background_of_another_size_is_named():
    with pytest.raises(ValueError, match=r"background.*\(40, 48, 3\)"):
        rasterize_splats(*[t.float() for t in splats(10, 3)], camera(), torch.zeros(48, 40, 3))


def test_unavailable_backends_raise_with_the_reason():
    single, double = [t.float() for t in splats(10, 3)], splats(10, 3)
    with pytest.raises(errors.BackendError, match="cuda"):
        rasterize_splats(*single, camera(), backend="cuda")
    with pytest.raises(errors.BackendError, match="float32.*float64"):
        rasterize_splats(*double, camera(), backend="cpu")
    with pytest.raises(ValueError, match="backend.*'metal'"):
        rasterize_splats(*single, camera(), backend="metal")
    assert rasterize_splats(*double, camera()).image.dtype == torch.float64


def test_without_numba_the_reference_draws_with_a_warning(monkeypatch, caplog):
    scene = [t.float() for t in splats(10, 3)]
    expected = rasterize_splats(*scene, camera(), backend="reference").image
    backends._warn_once.cache_clear()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert torch.equal(rasterize_splats(*scene, camera()).image, expected)
    assert "pip install numba" in caplog.text
    with pytest.raises(errors.BackendError, match="pip install numba"):
        rasterize_splats(*scene, camera(), backend="cpu")


@pytest.mark.parametrize("change", [{"near_plane": 0.0}, {"alpha_min": 0.0}, {"alpha_max": 1.0}, {"dilation": -1.0}])
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        RasterSettings(**change)
