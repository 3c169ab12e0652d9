"""The fused photometric loss against its definition by convolutions, in float64 with autograd."""

import pytest
import torch
import torch.nn.functional as F

from r5dgs_core.raster import compile as kernels
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


def test_equal_images_have_no_loss_and_no_gradient():
    x, _ = pair(20, 30)
    for image in (x, torch.zeros(20, 30, 3), torch.full((20, 30, 3), 0.5)):
        leaf = image.clone().requires_grad_(True)
        loss = losses.photometric(leaf, image, 0.2)
        loss.backward()
        assert float(loss.detach()) == pytest.approx(0, abs=1e-6)
        assert float(leaf.grad.abs().max()) < 1e-6


def test_the_gradient_scales_with_what_comes_from_above():
    x, y = pair(9, 12)
    gradients = []
    for factor in (1.0, 3.0):
        leaf = x.clone().requires_grad_(True)
        (factor * losses.photometric(leaf, y, 0.2)).backward()
        gradients.append(leaf.grad)
    torch.testing.assert_close(3 * gradients[0], gradients[1])


def test_threads_do_not_change_the_loss():
    x, y = pair(37, 29)
    before = kernels.threads()
    results = []
    try:
        for threads in (1, 2, 5):
            kernels.set_threads(threads)
            leaf = x.clone().requires_grad_(True)
            loss = losses.photometric(leaf, y, 0.2)
            loss.backward()
            results.append((loss.detach(), leaf.grad))
    finally:
        kernels.set_threads(before)
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0]) and torch.equal(gradient, results[0][1])


def test_a_transposed_input_is_read_by_its_meaning_not_its_memory():
    x, y = pair(12, 8)
    turned = x.transpose(0, 1).contiguous().transpose(0, 1)
    assert not turned.is_contiguous()
    assert float(losses.photometric(turned, y, 0.3)) == float(losses.photometric(x, y, 0.3))
