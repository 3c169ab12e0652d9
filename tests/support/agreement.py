"""Error bounds of the `cpu` backend against the float64 `reference`, on any scene."""

import numpy as np
import torch

from tests.support.splats import draw

FORWARD = 2e-5  # of colours and alpha in [0, 1], and of the largest depth
GRADIENT = 1e-4  # of the largest entry of each gradient
FLOAT32_TINY = float(np.finfo(np.float32).tiny)


def assert_within_bars(scene, view, background=None, upstreams=1, **options):
    """Draw with both backends, compare everything that they give, and return both results.

    With few Gaussians the random terms of every entry of a gradient may cancel by chance, and leave rounding. With more
    ``upstreams`` than one, the largest entry is that of so many random gradients of the image; one of them is compared.
    """
    expected, expected_gradients, expected_stats = draw(scene, view, "reference", background, **options)
    found, gradients, stats = draw(scene, view, "cpu", background, **options)
    others = [draw(scene, view, "reference", background, seed, **options)[1:] for seed in range(upstreams - 1)]
    for name in ("image", "alpha", "depth"):
        assert torch.isfinite(getattr(found, name)).all() and torch.isfinite(getattr(expected, name)).all(), name
    colours = max(1.0, largest(expected.image))
    assert largest(found.image - expected.image) < FORWARD * colours, "image"
    assert largest(found.alpha - expected.alpha) < FORWARD, "alpha"
    # Depth weighted by alpha: dividing by an alpha of 1/255 amplifies rounding 255 times.
    assert relative_to_normal(found.depth * found.alpha, expected.depth * expected.alpha) < FORWARD, "depth"
    for name, gradient in expected_gradients.items():
        assert torch.isfinite(gradient).all() and torch.isfinite(gradients[name]).all(), f"gradient of {name}"
        likes = [gradient, *(other[name] for other, _ in others)]
        assert relative_to_normal(gradients[name], gradient, likes) < GRADIENT, f"gradient of {name}"
    assert torch.equal(stats.visible, expected_stats.visible)
    assert relative_to_normal(stats.radii, expected_stats.radii) < FORWARD, "radii"
    likes = [expected_stats.grad_norm, *(other.grad_norm for _, other in others)]
    assert relative_to_normal(stats.grad_norm, expected_stats.grad_norm, likes) < GRADIENT, "grad_norm"
    return found, expected


def largest(tensor):
    return tensor.detach().abs().max().item() if tensor.numel() else 0.0


def relative_to_normal(found, expected, likes=None):
    """Largest difference relative to the largest entry of ``likes``, or to the smallest normal float32 if larger."""
    difference = found.detach().double() - expected.detach().double()
    return largest(difference) / max(FLOAT32_TINY, *map(largest, likes or [expected]))
