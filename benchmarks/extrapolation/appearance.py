"""Causes of the image error past t_max: poses, borders, sides never seen, shading, shadows, background.

    python -m benchmarks.extrapolation appearance DATA --run RUN [--json FILE] [--pictures FOLDER]

A run of ``tracks`` is baked, and its test views are drawn with the scene's motion and with the true poses of the data
set (the oracle). Each row is a share of the squared error with the scene's motion, summed over all pixels of all test
views; the shares add up to one:

- poses: that error minus the oracle's; negative if true poses are no better. The other rows are errors of the oracle.
- borders: pixels next to an edge of the object mask.
- unseen sides: other pixels of objects, drawn mostly by Gaussians that no training view showed from within 30 degrees.
- shading: the part that the best affine change of color of each object at each time removes from its other pixels.
- objects: the part that remains there.
- shadows: other pixels of the background at which the true image differs by more than three levels of 255 from the
  scene without moving objects. Wrong textures of the background count, too.
- background: the rest.

``if gone`` is the gain in PSNR if that share were zero. ``excess`` is the part of a share that exceeds the error of val
on pixels of that kind, in dB; these add up to the difference between test and a test with the errors of val. The last
rows compare the same scene with shading, shadows or both kept as at t_max. Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from r5dgs_core.bake import bake
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images
from r5dgs_core.error_vs_time import image_task
from r5dgs_core.evaluation import evaluate, metrics
from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.render import posed_scene, scene_renderer, segment_weights
from r5dgs_core.render.warm_up import warm_up
from r5dgs_core.scene import cameras
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.scene.scene import Scene
from r5dgs_core.train import run_folder

KINDS = ("borders", "unseen sides", "objects", "shadows", "background")
NEAR = math.cos(math.radians(30))
VISIBLE = 0.2  # of what a Gaussian would show alone, from which on a view has seen it
SHADOW_LEVEL = 3 / 255
MIN_PIXELS = 30  # to which a change of colour is fitted

Move = Callable[..., scene_player.Frame]  # from a time, and an origin or none


@dataclass(frozen=True)
class Picture:
    """A view and its rendering.

    Attributes:
        view: The view.
        truth: Its image. [H, W, 3]
        mask: Its objects. [H, W]
        drawn: The rendering, rounded to 8 bits. [H, W, 3]
        frame: The Gaussians drawn.
    """

    view: datasets.View
    truth: np.ndarray
    mask: np.ndarray
    drawn: np.ndarray
    frame: scene_player.Frame

    @property
    def squares(self) -> np.ndarray:
        """Squared error of each pixel, mean over the channels. [H, W] float64"""
        return ((self.drawn - self.truth).astype(np.float64) ** 2).mean(-1)


def pictures(scene: Scene, views: Sequence[datasets.View], move: Move) -> list[Picture]:
    """Renderings of views of a scene played in any mode. A view without a mask is an error."""
    found, behind = [], evaluate.truth_background(scene)
    for view in views:
        mask = datasets.load_mask(view)
        if mask is None:
            raise SystemExit(f"{view.name}: expected an object mask, found none; the causes need one")
        frame = move(view.t)
        found.append(Picture(view, datasets.load_image(view, behind), mask, draw(scene, frame, view.camera), frame))
    return found


def draw(scene: Scene, frame: scene_player.Frame, camera: Camera) -> np.ndarray:
    """Colour of a frame, rounded to 8 bits. [H, W, 3] float32"""
    color = scene_renderer.render_frame(scene, frame, camera).color
    return images.to_uint8(color).astype(np.float32) / np.float32(255)


def oracle(scene: Scene, dataset: datasets.Dataset) -> Move:
    """The scene with its bodies in their true poses past t_max."""
    move, reason = image_task.true_move(scene, dataset, [v.t for v in dataset.test])
    if move is None:
        raise SystemExit(f"{dataset.root}: {reason}; the benchmark needs them at the times of split test")
    return move


def frozen(scene: Scene, shading: bool, shadows: bool) -> tuple[Scene, Move]:
    """The scene with shading, shadows or both as they are at t_max, for times past it."""
    still = scene
    if shading and scene.shading is not None:
        still = scene.with_arrays(shading=np.zeros_like(scene.shading.vectors))

    player = scene_player.Player(still)

    def move(t: float) -> scene_player.Frame:
        quats, displacements = (array.copy() for array in player.group_poses(t))
        for group in still.groups:
            if shadows and group.role == "shadow":
                quats[group.id], displacements[group.id] = rotations.identity(), 0.0
        return player.frame_at_poses(quats, displacements, t)

    return still, move


class Sight:
    """Directions from which training views show each Gaussian.

    Args:
        scene: The scene.
        views: Training views.
    """

    def __init__(self, scene: Scene, views: Sequence[datasets.View]):
        self.scene = scene
        self.directions = np.zeros((len(views), len(scene.gaussians.means), 3), np.float32)  # zero where a view has not
        player = scene_player.Player(scene)
        for k, view in enumerate(views):
            frame = player.frame(view.t)
            seen = visibility(scene, frame, view.camera) > VISIBLE
            self.directions[k] = _towards(frame, view.camera) * seen[:, None]

    def share(self, frame: scene_player.Frame, camera: Camera) -> np.ndarray:
        """Share of each pixel's Gaussians that training views show from a similar direction. [H, W]"""
        now, nearest = _towards(frame, camera), np.full(len(frame.means), -1.0, np.float32)
        for directions in self.directions:
            np.maximum(nearest, (directions * now).sum(1), out=nearest)
        known = np.stack([nearest > NEAR, np.ones(len(nearest), bool)], axis=1)
        blended = scene_renderer.render_frame(self.scene, frame, camera, features=known).features
        return blended[..., 0] / np.maximum(blended[..., 1], 1e-6)


def _towards(frame: scene_player.Frame, camera: Camera) -> np.ndarray:
    """Directions from the Gaussians to a camera, unit, bind frame. [N, 3]"""
    arm = camera.center - frame.origin - frame.means
    arm /= np.linalg.norm(arm, axis=1, keepdims=True)
    return rotations.rotate(rotations.conjugate(frame.group_quats[frame.motion_ids]), arm).astype(np.float32)


def visibility(scene: Scene, frame: scene_player.Frame, camera: Camera) -> np.ndarray:
    """Visible share of each Gaussian in a view, relative to drawing it alone and completely. [N]"""
    posed = posed_scene.pose_frame(scene, frame)
    gaussians = scene_renderer.PosedGaussians(posed)
    shapes = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    everywhere = np.zeros((camera.height, camera.width), np.int64)
    weights = segment_weights.segment_weights(*shapes, camera, everywhere, 1).toarray()[0]
    _, depth = cameras.project(camera, posed.means.astype(np.float64))
    pixels = camera.intrinsics[0, 0] / np.maximum(depth, 1e-6)
    axes = np.sort(np.exp(posed.log_scales), axis=1)[:, 1:] * pixels[:, None]
    whole = 2 * np.pi * np.sqrt(axes**2 + 0.3).prod(1) * gaussians.opacities  # 0.3 px^2: the blur of 3DGS
    return np.where(depth > 0, weights / np.maximum(whole, 1e-6), 0.0)


def resting(scene: Scene) -> np.ndarray:
    """Mask of the Gaussians whose groups neither move nor follow a moving group. [N] bool"""
    still = np.array([g.model.is_static and not np.any(scene.tracks.poses[g.id, :, 1:]) for g in scene.groups])
    follow = np.array([True if g.follows is None else still[g.follows] for g in scene.groups])
    return (still & follow)[scene.gaussians.motion_ids]


def kinds(scene: Scene, sight: Sight, picture: Picture) -> np.ndarray:
    """Kind of each pixel of a picture, an index of `KINDS`. [H, W]"""
    mask, frame, camera = picture.mask, picture.frame, picture.view.camera
    edge = ndimage.maximum_filter(mask, 3) != ndimage.minimum_filter(mask, 3)
    unseen = sight.share(frame, camera) < 0.5
    alone = np.where(resting(scene), frame.opacity_logits, np.float32(-50))
    static = draw(scene, dataclasses.replace(frame, opacity_logits=alone), camera)
    crossed = np.abs(picture.truth - static).max(-1) > SHADOW_LEVEL
    inner = np.where(mask > 0, np.where(unseen, 1, 2), np.where(crossed, 3, 4))
    return np.where(edge, 0, inner)


def recolored(shown: Sequence[Picture], regions: Sequence[np.ndarray]) -> float:
    """Total squared error that remains in regions of pictures after the best affine change of their colours."""
    x = np.concatenate([p.drawn[region] for p, region in zip(shown, regions, strict=True)]).astype(np.float64)
    y = np.concatenate([p.truth[region] for p, region in zip(shown, regions, strict=True)]).astype(np.float64)
    fitted = x
    if len(x) >= MIN_PIXELS:
        basis = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        fitted = basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    return float(((fitted - y) ** 2).mean(-1).sum()) if len(x) else 0.0


@dataclass(frozen=True)
class Sums:
    """Squared errors and pixels of some pictures.

    Attributes:
        error: Of each kind. [5]
        pixels: Of each kind. [5]
        objects: Of each object: error on the first three kinds without the part that shading could remove, and that
            part. {id: [4]}
    """

    error: np.ndarray
    pixels: np.ndarray
    objects: dict[int, np.ndarray]

    @property
    def shading(self) -> float:
        """Error of all objects that shading could remove."""
        return float(sum(parts[3] for parts in self.objects.values()))


def add_up(scene: Scene, sight: Sight, shown: Sequence[Picture]) -> Sums:
    """Sums over pictures of one split."""
    found = [kinds(scene, sight, picture) for picture in shown]
    error, pixels = np.zeros(len(KINDS)), np.zeros(len(KINDS))
    for picture, kind in zip(shown, found, strict=True):
        error += np.bincount(kind.ravel(), picture.squares.ravel(), len(KINDS))
        pixels += np.bincount(kind.ravel(), minlength=len(KINDS))
    objects = {}
    for object_id in sorted({int(i) for p in shown for i in np.unique(p.mask)} - {0}):
        parts = np.zeros(4)
        for t in sorted({p.view.t for p in shown}):
            then = [(p, kind) for p, kind in zip(shown, found, strict=True) if p.view.t == t]
            regions = [(p.mask == object_id) & (kind == 2) for p, kind in then]
            for picture, kind in then:
                mine = picture.mask == object_id
                parts[:3] += [picture.squares[mine & (kind == k)].sum() for k in range(3)]
            whole = sum(p.squares[region].sum() for (p, _), region in zip(then, regions, strict=True))
            gain = max(whole - recolored([p for p, _ in then], regions), 0.0)
            parts[2:] += [-gain, gain]
        objects[object_id] = parts
    return Sums(error, pixels, objects)


def table(fitted: float, test: Sums, val: Sums) -> list[dict[str, Any]]:
    """The shares of the module's docstring.

    Args:
        fitted: Squared error on test as the scene plays.
        test: Sums over test with true poses.
        val: Sums over val.
    """
    rate = val.error / np.maximum(val.pixels, 1)
    beyond = test.error - rate * test.pixels
    light = test.shading
    light_beyond = light - val.shading / max(val.pixels[2], 1) * test.pixels[2]
    poses = fitted - test.error.sum()
    rows = [("poses", poses, poses, 0.0)]
    for k, name in enumerate(KINDS):
        if name == "objects":
            rows.append(("shading", light, light_beyond, test.pixels[k]))
            rows.append((name, test.error[k] - light, beyond[k] - light_beyond, test.pixels[k]))
        else:
            rows.append((name, test.error[k], beyond[k], test.pixels[k]))
    total = sum(row[2] for row in rows)
    per_excess = 10 * math.log10(fitted / max(fitted - total, 1e-12)) / total if total else 0.0
    return [
        {
            "cause": name,
            "pixels": pixels / test.pixels.sum(),
            "share": error / fitted,
            "if_gone_db": -10 * math.log10(max(1 - error / fitted, 1e-12)),
            "excess_db": over * per_excess,
        }
        for name, error, over, pixels in rows
    ]


def measure(scene: Scene, dataset: datasets.Dataset) -> dict[str, Any]:
    """All rows of the benchmark in JSON types."""
    sight, player = Sight(scene, dataset.train), scene_player.Player(scene)
    fitted = float(sum(p.squares.sum() for p in pictures(scene, dataset.test, player.frame)))
    test = add_up(scene, sight, pictures(scene, dataset.test, oracle(scene, dataset)))
    val = add_up(scene, sight, pictures(scene, dataset.val, player.frame))
    shares, count, names = table(fitted, test, val), test.pixels.sum(), {o.id: o.name for o in scene.objects}
    psnr = {
        "as played": metrics.psnr_of_mse(fitted / count),
        "true poses": metrics.psnr_of_mse(test.error.sum() / count),
    }
    psnr["errors of val"] = psnr["as played"] + sum(row["excess_db"] for row in shares)
    rows = []
    for name, shading, shadows in (
        ("shading and shadows go on", False, False),
        ("shading as at t_max", True, False),
        ("shadows as at t_max", False, True),
        ("both as at t_max", True, True),
    ):
        still, move = frozen(scene, shading, shadows)
        errors = [p.squares.mean() for p in pictures(still, dataset.test, move)]
        rows.append({"appearance": name, "psnr": float(np.mean([metrics.psnr_of_mse(e) for e in errors]))})
    return {
        "data": dataset.name,
        "psnr_pooled": psnr,
        "shares": shares,
        "objects": [
            {
                "object": names.get(object_id, str(object_id)),
                **dict(zip((*KINDS[:3], "shading"), (parts / fitted).tolist(), strict=True)),
            }
            for object_id, parts in test.objects.items()
        ],
        "extrapolation": rows,
    }


def write_sheet(scene: Scene, dataset: datasets.Dataset, folder: Path, rows: int = 6) -> Path:
    """Write true image, rendering with true poses, eight times their difference, and kinds, of some test views."""
    from matplotlib import image

    sight = Sight(scene, dataset.train)
    views = [dataset.test[k] for k in np.unique(np.linspace(0, len(dataset.test) - 1, rows).astype(int))]
    colors = np.array([[1, 1, 0], [1, 0, 1], [0, 0.6, 1], [0.5, 0.5, 0.5], [0, 0, 0]])
    lines = [
        np.concatenate([p.truth, p.drawn, 0.5 + 8 * (p.drawn - p.truth), colors[kinds(scene, sight, p)]], axis=1)
        for p in pictures(scene, views, oracle(scene, dataset))
    ]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "appearance.png"
    image.imsave(path, np.clip(np.concatenate(lines), 0, 1).repeat(2, 0).repeat(2, 1))
    return path


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="Break down the image error past t_max by cause.")
    parser.add_argument("data", type=Path)
    parser.add_argument("--run", type=Path, required=True, help="folder of a finished run of tracks")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--pictures", type=Path, help="folder for a sheet of errors")
    args = parser.parse_args()
    warm_up()
    dataset = datasets.read(args.data)
    scene = bake.bake(run_folder.open_run(args.run), dataset)
    result = measure(scene, dataset)
    print("test, pooled PSNR: " + ", ".join(f"{name} {value:.2f} dB" for name, value in result["psnr_pooled"].items()))
    print(f"{'cause':>14} {'pixels':>7} {'share':>7} {'if gone':>8} {'excess':>7}")
    for row in result["shares"]:
        print(
            f"{row['cause']:>14} {row['pixels']:>7.1%} {row['share']:>7.1%} {row['if_gone_db']:>+8.2f} "
            f"{row['excess_db']:>+7.2f}"
        )
    for row in result["objects"]:
        print(f"{row['object']:>14} " + ", ".join(f"{k} {v:.1%}" for k, v in row.items() if k != "object"))
    for row in result["extrapolation"]:
        print(f"{row['appearance']:>26} {row['psnr']:.2f} dB")
    if args.json:
        args.json.write_text(json.dumps(result, indent=2))
    if args.pictures:
        print(write_sheet(scene, dataset, args.pictures))


if __name__ == "__main__":
    main()
