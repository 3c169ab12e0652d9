"""Textures of a ball that count as seen: share of the contrast that shade does not explain.

    python -m benchmarks.futures textures [--seeds 3] [--json FILE]

A ball turns and moves on the floor of the rendered scenes, in its true place. `unseen_rotations.find` judges its images
at four times in four views. A plain ball should count as plain, all others as textured. Colours and motions are drawn
from the seed; none of these textures was used to choose the limit.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from r5dgs_core.bake import unseen_rotations
from r5dgs_core.bake.unseen_rotations import Surface
from r5dgs_core.scene import cameras

from . import ray_tracer, rendered_scenes
from .ray_tracer import Texture

RADIUS = 0.3
TIMES, VIEWS = (0.0, 0.25, 0.5, 0.75), (0, 2, 4, 5)
Maker = Callable[[np.random.Generator], Texture]


def faint(make: Maker, contrast: float) -> Maker:
    """Return a texture with a share of the contrast of another one."""

    def made(rng: np.random.Generator) -> Texture:
        texture, mean = make(rng), rng.uniform(0.3, 0.7, 3)
        return lambda p: mean + contrast * (texture(p) - 0.5)

    return made


def patches(count: int) -> Maker:
    """Patches of random colours."""
    return lambda rng: ray_tracer.patches(rng, count)


def two_colors(rng: np.random.Generator) -> np.ndarray:
    """Two random colours. [2, 3]"""
    return rng.uniform(0.1, 0.9, (2, 3))


def stripes(count: int) -> Maker:
    """Stripes of two colours across an axis."""

    def made(rng: np.random.Generator) -> Texture:
        colors = two_colors(rng)
        return lambda p: colors[np.floor((p[:, 2] / (2 * RADIUS) + 0.5) * count).astype(int) % 2]

    return made


def waves(radians: float) -> Maker:
    """Smooth colours, the sum of waves with these radians per radius."""

    def made(rng: np.random.Generator) -> Texture:
        ways = rng.normal(size=(12, 3))
        ways *= radians / RADIUS / np.linalg.norm(ways, axis=1, keepdims=True)
        phases, colors, mean = rng.uniform(0, math.tau, 12), rng.normal(size=(12, 3)), rng.uniform(0.3, 0.7, 3)
        return lambda p: np.clip(mean + 0.1 * np.sin(p @ ways.T + phases) @ colors, 0.02, 0.98)

    return made


def dots(count: int, degrees: float) -> Maker:
    """Round spots of this angular radius."""

    def made(rng: np.random.Generator) -> Texture:
        centers, colors = rng.normal(size=(count, 3)), two_colors(rng)
        centers /= np.linalg.norm(centers, axis=1, keepdims=True)
        least = RADIUS * math.cos(math.radians(degrees))
        return lambda p: colors[(p @ centers.T > least).any(1).astype(int)]

    return made


TEXTURES: dict[str, Maker] = {
    "plain": ray_tracer.plain,
    "14 patches": patches(14),
    "14 patches, a quarter of the contrast": faint(patches(14), 0.25),
    "14 patches, an eighth of the contrast": faint(patches(14), 0.125),
    "5 patches": patches(5),
    "two halves": stripes(2),
    "8 stripes": stripes(8),
    "8 stripes, a quarter of the contrast": faint(stripes(8), 0.25),
    "waves of 1 rad per radius": waves(1),
    "waves of 2 rad per radius": waves(2),
    "waves of 4 rad per radius": waves(4),
    "8 dots": dots(8, 10),
    "one dot": dots(1, 15),
}


def surfaces(make: Maker, rng: np.random.Generator) -> list[Surface]:
    """Render a ball, and return its surface at all times."""
    texture, spin, ground = make(rng), 3 * rng.normal(size=3), ray_tracer.floor(rng)
    found = []
    for t in TIMES:
        place, turn = np.array([0.5 * t - 0.2, 0.1, RADIUS]), Rotation.from_rotvec(spin * t)
        ball = ray_tracer.Solid(1, ray_tracer.ball(RADIUS), texture, RADIUS, place, turn)
        parts = [_view(rendered_scenes.camera(k), ball, ground) for k in VIEWS]
        directions, colors, planes, moments = zip(*parts, strict=True)
        quat = np.roll(turn.as_quat(), 1)
        found.append(
            Surface(np.concatenate(directions), np.concatenate(colors), np.stack(planes), np.stack(moments), quat)
        )
    return found


def _view(camera: cameras.Camera, ball: ray_tracer.Solid, ground: Texture) -> tuple[np.ndarray, ...]:
    """Directions and colours of a view's pixels, and axes and second moments of its outline."""
    image, ids = ray_tracer.render(camera, [ball], ground)
    rays = cameras.pixel_rays(camera)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    mine = ids == 1
    core = np.asarray(ndimage.binary_erosion(mine), bool)
    away = camera.center - ball.place
    along = rays[core] @ away
    depths = -along - np.sqrt(np.maximum(along**2 - away @ away + RADIUS**2, 0))
    middle = rays[mine].mean(0) / np.linalg.norm(rays[mine].mean(0))
    plane = np.linalg.svd(middle[None])[2][1:]
    moments = np.cov(rays[mine] @ plane.T / (rays[mine] @ middle)[:, None], rowvar=False) * (away @ away)
    return (away + depths[:, None] * rays[core]) / RADIUS, image[core], plane, moments


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    print(f"| texture | share, limit {unseen_rotations.TEXTURE:g} | plain |\n|---|---|---|")
    rows = {}
    for name, make in TEXTURES.items():
        drawn = [surfaces(make, np.random.default_rng([seed, 7])) for seed in range(args.seeds)]
        shares = [unseen_rotations.texture_share(every, None) for every in drawn]
        plain = sum(unseen_rotations.find(every) is not None for every in drawn)
        rows[name] = {"shares": shares, "plain": plain}
        print(f"| {name} | {min(shares):.2f} to {max(shares):.2f} | {plain} of {len(drawn)} |", flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
