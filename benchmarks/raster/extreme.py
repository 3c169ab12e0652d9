"""Differences between backend and reference on stiff and extreme scenes (`extreme_scenes`).

    python -m benchmarks.raster extreme [--case NAME ...]

Each row is a scene, drawn by the `cpu` backend in float32 and by the `reference` in float64 from the same float32
numbers. ``image`` is the largest difference of colors and alpha (both in [0, 1]), ``depth`` that of depth times alpha
relative to the largest depth, ``gradient`` the largest difference of a gradient relative to the largest entry of its
tensor, for a random gradient of image, alpha and depth. Results: docs/results/rasterizer.md.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import torch

from r5dgs_core.raster import RasterStats, SplatImage, rasterize_splats

from .extreme_scenes import CASES, Case

NAMES = ("means", "quats", "scales", "opacities", "channels")


@dataclass(frozen=True)
class Drawing:
    """One backend's result."""

    result: SplatImage
    gradients: dict[str, torch.Tensor]
    stats: RasterStats


@dataclass(frozen=True)
class Errors:
    """Differences between two drawings; see the top of this file. ``gradients`` is by the name of the input."""

    image: float
    depth: float
    gradients: dict[str, float]


def draw(scene: Case, backend: str) -> Drawing:
    """Render, and propagate a random gradient back through image, alpha and depth times alpha."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = [t.to(dtype).clone().requires_grad_() for t in scene.inputs]
    background = None if scene.background is None else scene.background.to(dtype).clone().requires_grad_()
    stats = RasterStats()
    result = rasterize_splats(*leaves, scene.camera, background, settings=scene.settings, backend=backend, stats=stats)
    generator = torch.Generator().manual_seed(7)
    outputs = (result.image, result.alpha, result.depth * result.alpha.detach())
    upstream = [torch.randn(o.shape, generator=generator).to(dtype) for o in outputs]
    reached = [k for k, output in enumerate(outputs) if output.requires_grad]
    torch.autograd.backward([outputs[k] for k in reached], [upstream[k] for k in reached])
    gradients = dict(zip(NAMES, (leaf.grad for leaf in leaves), strict=True))
    if background is not None:
        gradients["background"] = background.grad
    return Drawing(result, gradients, stats)


def compare(found: Drawing, expected: Drawing) -> Errors:
    """Return the differences between two drawings."""

    def largest(tensor: torch.Tensor) -> float:
        return tensor.detach().abs().max().item() if tensor.numel() else 0.0

    def relative(a: torch.Tensor, b: torch.Tensor) -> float:
        # Values below the normal float32 range count as zero.
        return largest(a.double() - b.double()) / max(largest(b.double()), torch.finfo(torch.float32).tiny)

    a, b = found.result, expected.result
    colours = largest(b.image) if largest(b.image) > 1 else 1.0
    return Errors(
        max(largest(a.image.double() - b.image) / colours, largest(a.alpha.double() - b.alpha)),
        relative(a.depth.double() * a.alpha, b.depth * b.alpha),
        {name: relative(found.gradients[name], gradient) for name, gradient in expected.gradients.items()},
    )


def main(arguments: list[str] | None = None) -> None:
    """Print the table of the docs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", nargs="*", default=list(CASES), choices=list(CASES), metavar="NAME")
    parser.add_argument("--backend", default="cpu")
    options = parser.parse_args(arguments)
    print("| case | expected picture | image | depth | gradient | of |\n|---|---|---|---|---|---|")
    for name in options.case:
        scene = CASES[name]()
        errors = compare(draw(scene, options.backend), draw(scene, "reference"))
        worst = max(errors.gradients, key=lambda key: errors.gradients[key])
        numbers = (errors.image, errors.depth, errors.gradients[worst])
        figures = " | ".join(f"{number:.0e}" if number else "0" for number in numbers)
        print(f"| {name} | {scene.gives} | {figures} | {worst} |", flush=True)


if __name__ == "__main__":
    main()
