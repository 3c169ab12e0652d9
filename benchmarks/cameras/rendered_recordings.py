"""Two recordings of one ray-traced scene, as H.264 videos with masks and a calibration.

| | CLEAN | DIRTY |
|---|---|---|
| moments, codec, blur | the same | the same |
| lens | pinhole | Brown-Conrady, k1 from -0.3 to 0.3 |
| poses in the calibration | exact | moved by half a pixel along each axis of the picture |
| times in the videos | exact | of clocks that are 7 ms wrong (standard deviation) |
| colours | exact | gain of each channel wrong by 10 %, offset by 2 % |

The cameras do not expose at the same moments. The clocks of CLEAN say so, those of DIRTY do not.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.data import images
from r5dgs_core.scene import cameras
from r5dgs_core.scene.camera_correction import Correction
from r5dgs_core.scene.cameras import Camera
from tests.support import recordings

from ..futures import ray_tracer, rendered_scenes

RATE = 30.0  # frames per second
BLUR = 0.6  # standard deviation of the blur of lenses, px
SHOWN = 0.5  # share of the scene's motion that the frames show
START = 0.05  # time of the first frame by the common clock, s
DEPTH = 4.8  # distance of the scene from the cameras
PIXELS, OFFSET_S, GAIN, LIFT, DISTORTION = 0.5, 7e-3, 0.1, 0.02, 0.3
VIDEO = {"crf": "14", "preset": "veryfast"}


@dataclass(frozen=True)
class Truth:
    """The scene and its cameras.

    Attributes:
        bodies: The moving bodies.
        ground: Texture of the floor.
        rig: Cameras with exact poses and pinhole lenses.
        clocks: Time by which each camera exposes later than the others, s. [C]
        frames: Number of frames of each camera.
    """

    bodies: Sequence[rendered_scenes.Body]
    ground: ray_tracer.Texture
    rig: recordings.Rig
    clocks: np.ndarray
    frames: int

    def moments(self, camera: int) -> np.ndarray:
        """Return the true times of a camera's frames, s. [F]"""
        return START + np.arange(self.frames) / RATE + self.clocks[camera]

    def draw(self, camera: Camera, seconds: float, lens: Lens | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the image [H, W, 3] and the ids [H, W] at a time, s."""
        t = SHOWN * rendered_scenes.T_MAX * (seconds - START) * RATE / max(1, self.frames - 1)
        return ray_tracer.render(camera, rendered_scenes.solids(self.bodies, t), self.ground, lens)


@dataclass(frozen=True)
class Recording:
    """A recording and what is wrong with it.

    Attributes:
        folder: Videos, ``calibration.toml``, and masks in ``masks/``.
        offsets: Time by which each clock is late, s. [C]
    """

    folder: Path
    offsets: np.ndarray

    @property
    def masks(self) -> Path:
        """Folder of the masks."""
        return self.folder.with_name(self.folder.name + "_masks")


def make(scene: str, seed: int, size: int, count: int, frames: int) -> Truth:
    """Return a scene of `rendered_scenes` with cameras on its arc.

    Args:
        scene: One of `rendered_scenes.SCENES`.
        seed: Seed of the scene and of everything that is wrong.
        size: Width and height of the images, even.
        count: Number of cameras.
        frames: Frames of each.
    """
    rng = np.random.default_rng([seed, sum(scene.encode())])
    bodies, ground = rendered_scenes.SCENES[scene](rng), ray_tracer.floor(rng)
    placed = tuple(_camera(k, size) for k in np.linspace(0, rendered_scenes.CAMERAS - 1, count))
    focal = float(placed[0].intrinsics[0, 0])
    lenses = (Lens("pinhole", focal, focal, size / 2, size / 2),) * count
    rig = recordings.Rig(tuple(f"cam{k}" for k in range(count)), placed, lenses)
    clocks = OFFSET_S * np.random.default_rng(seed + 1).normal(size=count)
    return Truth(bodies, ground, rig, clocks - clocks.mean(), frames)


def _camera(k: float, size: int) -> Camera:
    """Return a camera of the arc of `rendered_scenes` at another resolution."""
    camera = rendered_scenes.camera(k)
    intrinsics = camera.intrinsics * [[size / camera.width], [size / camera.height], [1.0]]
    return dataclasses.replace(camera, width=size, height=size, intrinsics=intrinsics)


def recorded(truth: Truth, folder: Path, seed: int) -> Recording:
    """Return the recording that the last part of a folder's name says, "clean" or "dirty"; it is written if missing."""
    lenses, wrong = list(truth.rig.lenses), [Correction() for _ in truth.rig.cameras]
    offsets = np.zeros(len(wrong))
    if folder.name == "dirty":
        lenses, wrong = _wrong(truth, np.random.default_rng(seed + 2))
        offsets = truth.clocks
    made = Recording(folder, offsets)
    if not (folder / "calibration.toml").is_file():
        _write(truth, made, lenses, wrong)
    return made


def _wrong(truth: Truth, rng: np.random.Generator) -> tuple[list[Lens], list[Correction]]:
    """Draw lenses, and errors of poses and colours."""
    lenses, wrong = [], []
    for camera, lens in zip(truth.rig.cameras, truth.rig.lenses, strict=True):
        k1 = DISTORTION * float(rng.uniform(-1, 1))
        lenses.append(dataclasses.replace(lens, model="brown", coefficients=(k1, -0.3 * k1, 1e-3, -1e-3, 0.0)))
        unit = PIXELS / camera.intrinsics[0, 0] / math.sqrt(2) * np.array([1, 1, 2.0])
        turn, shift = rng.normal(size=3) * unit, rng.normal(size=3) * unit * DEPTH
        gain, lift = np.diag(1 + GAIN * rng.normal(size=3)), LIFT * rng.normal(size=3)
        wrong.append(Correction(rotvec=turn, shift=shift, gain=gain, offset=lift))
    return lenses, wrong


def _write(truth: Truth, made: Recording, lenses: Sequence[Lens], wrong: Sequence[Correction]) -> None:
    """Write a recording with lenses, and with errors of poses and colours."""
    rig = truth.rig
    for k, name in enumerate(rig.names):
        moments, frames = truth.moments(k), []
        for number, seconds in enumerate(moments):
            color, ids = truth.draw(rig.cameras[k], float(seconds), lenses[k])
            seen = wrong[k].seen(ndimage.gaussian_filter(color, (BLUR, BLUR, 0)))
            frames.append(images.to_uint8(np.clip(seen, 0, 1)))
            images.write_png(made.masks / name / f"{number:06d}.png", ids)
        recordings.write_video(made.folder / f"{name}.mp4", frames, moments - made.offsets[k], options=VIDEO)
    placed = tuple(error.camera(camera) for error, camera in zip(wrong, rig.cameras, strict=True))
    names = {body.object_id: body.name for body in reversed(truth.bodies) if body.object_id}
    (made.masks / "objects.json").write_text(json.dumps(names))
    wrong_rig = dataclasses.replace(rig, cameras=placed, lenses=tuple(lenses))
    recordings.write_calibration(made.folder / "calibration.toml", wrong_rig)


def write_held_out(truth: Truth, data: Path, zero: float, unit: float, views: int, times: int) -> None:
    """Add exact pictures of further cameras to a prepared data set, as its split ``val``.

    Args:
        truth: The scene.
        data: Folder of the data set.
        zero: Time of its scene time 0, s.
        unit: Seconds per unit of its scene time.
        views: Number of cameras, between those of the recording.
        times: Number of times, between moments of the recording.
    """
    content = json.loads((data / "transforms_train.json").read_text())
    size, last = truth.rig.cameras[0].width, (truth.frames - 1) / RATE
    content["data"] = {}
    for number, k in enumerate(np.linspace(0.7, rendered_scenes.CAMERAS - 1.7, views)):
        camera, frames = _camera(float(k), size), []
        for row, seconds in enumerate(START + last * (np.arange(times) + 0.5) / times):
            color, ids = truth.draw(camera, float(seconds))
            name = f"val/novel{number}_{row:02d}.png"
            images.write_png(data / name, color)
            images.write_png(data / "object_mask" / name, ids)
            frames.append({"file_path": name, "time": (float(seconds) - zero) / unit})
        focal = float(camera.intrinsics[0, 0])
        lens = {"fl_x": focal, "fl_y": focal, "cx": size / 2, "cy": size / 2, "w": size, "h": size}
        pose = cameras.cam_world_to_opengl(camera.T_cam_world).tolist()
        content["data"][f"novel{number}"] = {**lens, "transform_matrix": pose, "frames": frames}
    (data / "transforms_val.json").write_text(json.dumps(content))
