"""The losses of training against their definitions, in float64 with autograd: photometric, and roughness of tracks."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from r5dgs_core.model.tracks import Tracks
from r5dgs_core.motion import rotations
from r5dgs_core.raster import thread_pool
from r5dgs_core.train import losses


def by_definition(x, y, weight):
    """L1 and SSIM of 3DGS: Gaussian window 11, sigma 1.5, zero padding. [H, W, 3]"""
    offsets = torch.arange(11, dtype=x.dtype) - 5
    line = torch.exp(-(offsets**2) / (2 * 1.5**2))
    line = line / line.sum()
    window = torch.outer(line, line).expand(3, 1, 11, 11)

    def blur(image):
        return F.conv2d(image.permute(2, 0, 1)[None], window, padding=5, groups=3)

    mu1, mu2 = blur(x), blur(y)
    s1, s2, s12 = blur(x * x) - mu1**2, blur(y * y) - mu2**2, blur(x * y) - mu1 * mu2
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mu1 * mu2 + c1) * (2 * s12 + c2) / ((mu1**2 + mu2**2 + c1) * (s1 + s2 + c2))
    return (1 - weight) * (x - y).abs().mean() + weight * (1 - ssim.mean())


def pair(height, width, seed=0):
    draws = torch.Generator().manual_seed(seed)
    x = torch.rand(height, width, 3, generator=draws)
    return x, (x + 0.2 * torch.randn(height, width, 3, generator=draws)).clamp(0, 1)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", [(24, 24), (13, 40), (40, 13), (4, 5), (1, 1)])
def test_value_and_gradient_follow_the_definition(size, weight):
    x, y = pair(*size)
    single, double = x.clone().requires_grad_(True), x.double().requires_grad_(True)
    ours, theirs = losses.photometric(single, y, weight), by_definition(double, y.double(), weight)
    ours.backward()
    theirs.backward()
    assert float(ours.detach()) == pytest.approx(float(theirs.detach()), rel=2e-5, abs=1e-6)
    scale = float(double.grad.abs().max())
    torch.testing.assert_close(single.grad.double() / scale, double.grad / scale, rtol=0, atol=1e-4)


def awkward(kind):
    """Pairs of images where the variances of SSIM vanish, or values leave [0, 1]."""
    x, y = pair(17, 21)
    flat = torch.full_like(x, 0.4)
    return {
        "flat against texture": (flat, y),
        "texture against flat": (x, flat),
        "flat against flat": (flat, flat + 0.3),
        "black against white": (torch.zeros_like(x), torch.ones_like(x)),
        "one pixel": (torch.zeros_like(x).index_put_((torch.tensor([8]), torch.tensor([9])), torch.ones(3)), x * 0),
        "over and under": (3 * x - 1, y),
        "equal in half": (torch.where(torch.arange(21)[None, :, None] < 10, y, x), y),
    }[kind]


@pytest.mark.parametrize(
    "kind",
    [
        "flat against texture",
        "texture against flat",
        "flat against flat",
        "black against white",
        "one pixel",
        "over and under",
        "equal in half",
    ],
)
def test_awkward_images_have_the_gradient_of_the_definition(kind):
    x, y = awkward(kind)
    single, double = x.clone().requires_grad_(True), x.double().requires_grad_(True)
    ours, theirs = losses.photometric(single, y, 0.2), by_definition(double, y.double(), 0.2)
    ours.backward()
    theirs.backward()
    assert float(ours.detach()) == pytest.approx(float(theirs.detach()), rel=2e-5, abs=1e-6)
    # Variances are differences of squares of order one, so float32 knows them to 1e-7, beside c2 = 9e-4 in a quotient.
    scale = float(double.grad.abs().max())
    torch.testing.assert_close(single.grad.double() / scale, double.grad / scale, rtol=0, atol=1e-3)


def test_the_reference_definition_has_the_gradient_of_its_own_value():
    x, y = (image.double() for image in pair(3, 4))
    assert torch.autograd.gradcheck(lambda image: by_definition(image, y, 0.2), (x.requires_grad_(True),))


def test_the_roughness_of_tracks_has_the_gradient_of_its_value():
    draws = torch.Generator().manual_seed(2)
    quats = rotations.normalize(torch.randn(3, 5, 4, generator=draws, dtype=torch.float64))
    shifts = torch.randn(3, 5, 3, generator=draws, dtype=torch.float64)
    turns = 0.3 * torch.randn(3, 5, 3, generator=draws, dtype=torch.float64)

    def roughness(translations, rotvecs):
        tracks = Tracks(np.array([0.0, 0.1, 0.25, 0.3, 0.7]), torch.zeros(3, 3), shifts, quats)
        tracks.params |= {"translations": translations, "rotvecs": rotvecs}
        return tracks.roughness()

    assert torch.autograd.gradcheck(roughness, (shifts.requires_grad_(True), turns.requires_grad_(True)))


def test_equal_images_have_no_loss_and_no_gradient():
    x, _ = pair(20, 30)
    for image in (x, torch.zeros(20, 30, 3), torch.full((20, 30, 3), 0.5)):
        leaf = image.clone().requires_grad_(True)
        loss = losses.photometric(leaf, image, 0.2)
        loss.backward()
        assert float(loss.detach()) == pytest.approx(0, abs=1e-6)
        assert float(leaf.grad.abs().max()) < 1e-6


def test_the_gradient_scales_with_the_incoming_gradient():
    x, y = pair(9, 12)
    gradients = []
    for factor in (1.0, 3.0):
        leaf = x.clone().requires_grad_(True)
        (factor * losses.photometric(leaf, y, 0.2)).backward()
        gradients.append(leaf.grad)
    torch.testing.assert_close(3 * gradients[0], gradients[1])


def test_threads_do_not_change_the_loss():
    x, y = pair(37, 29)
    before = thread_pool.threads()
    results = []
    try:
        for threads in (1, 2, 5):
            thread_pool.set_threads(threads)
            leaf = x.clone().requires_grad_(True)
            loss = losses.photometric(leaf, y, 0.2)
            loss.backward()
            results.append((loss.detach(), leaf.grad))
    finally:
        thread_pool.set_threads(before)
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0]) and torch.equal(gradient, results[0][1])


def test_transposed_images_give_the_same_loss():
    x, y = pair(12, 8)
    turned = x.transpose(0, 1).contiguous().transpose(0, 1)
    assert not turned.is_contiguous()
    assert float(losses.photometric(turned, y, 0.3)) == float(losses.photometric(x, y, 0.3))


@pytest.mark.parametrize("height", [1, 4, 9, 40])
def test_the_loss_does_not_depend_on_the_number_of_threads(height):
    draw = np.random.default_rng(height)
    x, y = (draw.random((height, 3 * 20), np.float32) for _ in range(2))
    left_out = draw.random((height, 20)) < 0.3

    def compare(workers):
        sums, gradient = np.full((height, 2), np.nan), np.full(x.shape, np.nan, np.float32)
        for worker in range(workers):
            losses._compare(worker, workers, x, y, left_out, losses.WINDOW, np.float32(0.2), sums, gradient)
        return sums, gradient

    alone, shared = compare(1), compare(3)
    for one, other in zip(alone, shared, strict=True):
        np.testing.assert_array_equal(one, other)
