"""Tiny multi-view data set with known truth: a textured floor and two textured objects, drawn by our rasterizer.

The brick (id 1) slides and turns about the vertical; the ball (id 2) is thrown. Times up to `T_MAX` are observed.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r5dgs_core.config import config
from r5dgs_core.data import dataset, images, mask_notes
from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import cameras
from r5dgs_core.scene.scene import Gaussians, MotionGroup, Scene, SceneObject, Tracks
from r5dgs_core.train import run_folder
from tests.support import scenes

T_MAX = 0.75
OBSERVED = np.linspace(0.0, T_MAX, 6)
LATER = np.array([0.85, 1.0])
FIELD_OF_VIEW = 0.75
BRICK, BALL = 1, 2
NAMES = {BRICK: ("brick", ["block"]), BALL: ("ball", [])}
CENTERS = {BRICK: np.array([0.55, -0.45, 0.42]), BALL: np.array([-0.65, 0.55, 0.85])}  # at T_MAX
MOTIONS = {
    BRICK: MotionModel("ballistic_spin", velocity=[0.9, 0.35, 0.0], angular_velocity=[0, 0, 1.4], radius=0.5),
    BALL: MotionModel("translation", velocity=[-0.7, 0.4, -0.9], acceleration=[0, 0, -2.0], radius=0.4),
}
SKY = np.array([0.55, 0.7, 0.9])
# Few Gaussians and early rounds, so that a run of some hundred steps shows what a long one does.
CAMERA_PARTS = ("camera_poses", "focal_lengths", "time_offsets", "camera_colours")
EXAMINED = tuple(f"needs.{part}=auto" for part in CAMERA_PARTS)
# Repair of poses and examination of cameras take a third of a tiny run and are off; their own tests switch them on.
SETTINGS = (
    "train.repair=false",
    *(f"needs.{part}=off" for part in CAMERA_PARTS),
    "init.object_points=150",
    "init.background_points=700",
    "init.shadow_points=10",
    "init.sweep_depths=32",
    "rates.rotvecs=0.02",
    "densify.start=20",
    "densify.every=20",
    "densify.max_gaussians=1400",
    "identity.iterations=80",
    "train.log_every=10",
)


@dataclass(frozen=True)
class TinyData:
    """A data set on disk and what it was drawn from.

    Attributes:
        root: Its folder.
        truth: The scene that was drawn, before ``scale`` and ``shift``.
        scale: World units of the data set per unit of ``truth``.
        shift: Origin of ``truth`` in the data set's world. [3]
    """

    root: Path
    truth: Scene
    scale: float
    shift: np.ndarray

    def center(self, object_id: int, t: float) -> np.ndarray:
        """True centre of an object in the data set's world. [3]"""
        _, displacement = scene_player.Player(self.truth).group_poses(t)
        return self.scale * (CENTERS[object_id] + displacement[object_id]) + self.shift

    def turn(self, object_id: int, t: float) -> np.ndarray:
        """True rotation of an object since `T_MAX`, unit wxyz. [4]"""
        return scene_player.Player(self.truth).group_poses(t)[0][object_id]


def make_dataset(
    folder: Path,
    *,
    views: int = 6,
    width: int = 48,
    height: int = 36,
    masks: bool = True,
    alpha: bool = False,
    ball_from: float = 0.0,
    breath: float = 0.0,
    still: bool = False,
    scale: float = 1.0,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> TinyData:
    """Write the data set.

    Args:
        folder: Where to.
        views: Observed cameras, on a circle around the objects.
        width: Of the images, pixels.
        height: Of the images, pixels.
        masks: Write object masks.
        alpha: Write RGBA images without sky and floor.
        ball_from: Time before which the ball is not there.
        breath: Share of its radius by which the ball swells and shrinks in the observed time.
        still: Nothing moves; there is no ground truth of poses then.
        scale: World units of the data set per unit of the truth.
        shift: Where the truth's origin lies in the data set's world.

    Returns:
        The folder and its truth.
    """
    truth = make_truth(floor=not alpha)
    truth = breathing(truth, breath) if breath else truth
    offset = np.asarray(shift, np.float64)
    novel = views
    plan = {
        "train": [(k, t) for t in OBSERVED for k in range(views)],
        "val": [(novel, OBSERVED[1]), (novel, OBSERVED[4])],
        "test": [(k, t) for t in LATER for k in (0, novel)],
    }
    for split, wanted in plan.items():
        frames = []
        for i, (k, t) in enumerate(wanted):
            camera = orbit_camera(2 * np.pi * k / views if k < views else 0.5, width, height)
            shown = truth if t >= ball_from else without(truth, BALL)
            output = scene_renderer.render_frame(
                shown,
                scene_player.Player(shown).frame(T_MAX if still else float(t)),
                camera,
                background=None if alpha else "scene",
            )
            color = output.color
            if alpha:
                opacity = output.alpha[..., None]
                color = np.concatenate([np.where(opacity > 0, color / np.maximum(opacity, 1e-6), 0), opacity], -1)
            images.write_png(folder / split / f"r_{i:03d}.png", color)
            if masks:
                assert output.ids is not None
                ids = np.maximum(output.ids, 0).astype(np.uint8)
                images.write_png(folder / "object_mask" / split / f"r_{i:03d}.png", ids)
            matrix = cameras.cam_world_to_opengl(camera.T_cam_world)
            matrix[:3, 3] = scale * matrix[:3, 3] + offset
            frames.append({"file_path": f"./{split}/r_{i:03d}", "time": float(t), "transform_matrix": matrix.tolist()})
        content = {"camera_angle_x": FIELD_OF_VIEW, "frames_per_unit": 40.0, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    data = TinyData(folder, truth, scale, offset)
    (folder / "objects.json").write_text(json.dumps({i: {"name": n, "aliases": a} for i, (n, a) in NAMES.items()}))
    if not still:
        (folder / "ground_truth.json").write_text(json.dumps(_poses(data)))
    return data


def settings(*overrides: str) -> config.Config:
    """Configuration for this data set, with further ``section.key=value`` overrides."""
    return config.load(None, [*SETTINGS, *overrides])


def as_trained(made: run_folder.Run) -> run_folder.Run:
    """The run, to be baked with its trained motion including noise."""
    kept = made.config.override(("needs.tracks=on", "needs.rotation=on"))
    return dataclasses.replace(made, config=kept)


def make_truth(*, floor: bool = True) -> Scene:
    """The scene that is drawn; Gaussians in their state at `T_MAX`, group k carries object k."""
    rng = np.random.default_rng(11)
    parts = [_floor(rng)] if floor else []
    parts += [_brick(), _ball(rng)]
    ids = [0] * floor + [BRICK, BALL]
    counts = [len(p[0]) for p in parts]
    means, quats, log_scales, colors = (np.concatenate(c).astype(np.float32) for c in zip(*parts, strict=True))
    object_ids = np.repeat(ids, counts).astype(np.int32)
    poses = [np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(OBSERVED), 1))]
    groups = [MotionGroup(0, 0, "pinned", 0 if floor else -1, np.zeros(3), models.STATIC)]
    for k, model in MOTIONS.items():
        turns, displacements, _, _ = models.curve(model, OBSERVED - T_MAX)
        poses.append(np.concatenate([rotations.normalize(turns), displacements], -1))
        anchor = int(np.flatnonzero(object_ids == k)[0])
        groups.append(MotionGroup(k, k, "body", anchor, CENTERS[k], model))
    table = []
    for k in (0, BRICK, BALL):
        rows = np.flatnonzero(object_ids == k)
        name, aliases = NAMES.get(k, ("background", []))
        start = int(rows[0]) if len(rows) else 0
        table.append(SceneObject(k, name, tuple(aliases), "", (0.5, 0.5, 0.5), start, len(rows)))
    return Scene(
        name="tiny",
        gaussians=Gaussians(
            means=means,
            quats=quats,
            log_scales=log_scales,
            opacity_logits=np.full(len(means), 4.0, np.float32),
            sh=((colors - 0.5) / 0.28209479)[:, None].astype(np.float32),
            object_ids=object_ids,
            motion_ids=object_ids.copy(),
        ),
        objects=tuple(table),
        groups=tuple(groups),
        tracks=Tracks(times=OBSERVED.copy(), poses=np.stack(poses)),
        t_max=T_MAX,
        frames_per_unit=40.0,
        world_convention="blender",
        cameras=(orbit_camera(0.0, 48, 36),),
        background_sh=((SKY - 0.5) / 0.28209479)[None].astype(np.float32),
    )


def breathing(scene: Scene, share: float) -> Scene:
    """The scene with a ball that swells and shrinks by a share of its radius, at rest at `T_MAX`."""
    rows = np.flatnonzero(scene.gaussians.object_ids == BALL)
    growth = 1 + share * np.sin(2 * np.pi * (T_MAX - OBSERVED) / 0.6)  # [S]
    arms = scene.gaussians.means[rows].astype(np.float64) - CENTERS[BALL]
    return scene.with_arrays(
        residual_rows=rows.astype(np.int32),
        residual_offsets=(arms[:, None] * (growth - 1)[:, None]).astype(np.float32),
        residual_quats=np.tile(np.float32([1, 0, 0, 0]), (len(rows), len(OBSERVED), 1)),
        residual_log_scales=np.tile(np.log(growth)[:, None], (len(rows), 1, 3)).astype(np.float32),
    )


def without(scene: Scene, object_id: int) -> Scene:
    """The scene with one object made invisible."""
    hidden = np.where(scene.gaussians.object_ids == object_id, -30.0, scene.gaussians.opacity_logits).astype(np.float32)
    return scene.with_arrays(opacity_logits=hidden)


def orbit_camera(angle_rad: float, width: int, height: int) -> cameras.Camera:
    """A camera on a circle around the objects, a little above them, that looks at their middle."""
    target = np.array([0.0, 0.0, 0.45])
    position = np.array([3.9 * np.cos(angle_rad), 3.9 * np.sin(angle_rad), 2.1 + 0.4 * np.sin(3 * angle_rad + 0.5)])
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], -1)
    matrix[:3, 3] = position
    return scenes.camera_from_field_of_view(matrix, FIELD_OF_VIEW, width, height)


def number_by_camera(root: Path, folder: Path, ids: tuple[int, ...]) -> mask_notes.MaskNotes:
    """Note in a folder of masks that those of each training camera of a data set have a numbering of their own."""
    videos = {}
    for view in dataset.read(root).train:
        before = videos.get(view.camera.name, mask_notes.Video((), ids))
        videos[view.camera.name] = dataclasses.replace(before, images=(*before.images, view.name))
    notes = mask_notes.MaskNotes("tracker", mask_notes.VIDEO, videos=videos)
    mask_notes.write(notes, folder)
    return notes


def _floor(rng: np.random.Generator):
    x, y = np.meshgrid(np.linspace(-2, 2, 41), np.linspace(-2, 2, 41))
    means = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], -1)
    n = len(means)
    # Blobs of about three pixels: fine enough to place them, coarse enough to survive the pixels.
    seeds, shades = rng.uniform(-2, 2, (150, 2)), rng.uniform(0.1, 0.9, (150, 3))
    weights = np.exp(-(((means[:, None, :2] - seeds) / 0.18) ** 2).sum(-1)) + 1e-9
    colors = weights @ shades / weights.sum(1, keepdims=True)
    log_scales = np.tile(np.log([0.065, 0.065, 0.004]), (n, 1))
    return means, np.tile([1.0, 0, 0, 0], (n, 1)), log_scales, colors


def _brick():
    half, steps = np.array([0.5, 0.32, 0.4]), np.linspace(-1, 1, 9)
    points, colors = [], []
    faces = np.array([[0.9, 0.2, 0.15], [0.2, 0.8, 0.25], [0.95, 0.8, 0.2], [0.25, 0.3, 0.9], [0.9, 0.9, 0.9]])
    u, v = (g.ravel() for g in np.meshgrid(steps, steps))
    for index, (axis, side) in enumerate([(0, 1), (0, -1), (1, 1), (1, -1), (2, 1)]):
        face = np.insert(np.stack([u, v], -1), axis, side, axis=1)
        points.append(face * half)
        colors.append(np.where((u * v > 0)[:, None], faces[index], 0.45 * faces[index]))
    means = np.concatenate(points)
    n = len(means)
    return (
        means + CENTERS[BRICK],
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), np.log(0.05)),
        np.concatenate(colors),
    )


def _ball(rng: np.random.Generator):
    n, radius = 320, 0.38
    k = np.arange(n) + 0.5
    polar, around = np.arccos(1 - 2 * k / n), np.pi * (1 + 5**0.5) * k  # Fibonacci sphere
    normals = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    seeds = rng.normal(size=(14, 3))
    nearest = (normals @ (seeds / np.linalg.norm(seeds, axis=1, keepdims=True)).T).argmax(1)
    colors = rng.uniform(0.1, 0.95, (14, 3))[nearest]
    return radius * normals + CENTERS[BALL], np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), np.log(0.05)), colors


def _poses(data: TinyData) -> dict:
    times = [float(t) for t in (*OBSERVED, *LATER)]
    rows = []
    for k in MOTIONS:
        matrices = []
        for t in times:
            matrix = np.eye(4)
            matrix[:3, :3] = rotations.quats_to_rotmats(data.turn(k, t))
            matrix[:3, 3] = data.center(k, t)
            matrices.append(matrix.tolist())
        rows.append({"id": k, "name": NAMES[k][0], "matrices": matrices})
    return {"t_max": T_MAX, "times": times, "objects": rows}
