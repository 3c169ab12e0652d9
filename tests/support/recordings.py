"""Small recordings of calibrated cameras: H.264 videos with PyAV, drawn by our rasterizer or by a plain painter."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.data import images
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene.cameras import Camera
from tests.support import tiny_datasets

BASE = 90000  # time stamps per second
TINY_WIDTH, TINY_HEIGHT, TINY_FRAMES = 96, 72, 6  # images of each camera of `record_tiny`
COEFFICIENTS = (-0.12, 0.03, 0.002, -0.001, 0.0)  # of its lenses
SOUND_RATE = 48000


def write_video(
    path: Path,
    frames: Iterable[np.ndarray],
    times: Sequence[float],
    *,
    codec: str = "libx264",
    pixel_format: str = "yuv420p",
    options: dict[str, str] | None = None,
    turn: int = 0,
    color: dict[str, int] | None = None,
    sound: np.ndarray | None = None,
) -> Path:
    """Write a video.

    Args:
        path: The file; its folder is created if missing.
        frames: Pixels. [H, W, 3] uint8 each, even sizes
        times: Time of each frame, seconds.
        codec: Name of the encoder.
        pixel_format: Pixel format of the encoder.
        options: Options of the encoder.
        turn: Counter-clockwise degrees by which players turn the frames.
        color: Codes of ISO/IEC 23091-2, by attribute of the codec context.
        sound: Mono sound from time 0 on, at `SOUND_RATE`. [N] float32
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    given = options if options is not None else {"crf": "12", "preset": "veryfast"}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options=given)
        stream.codec_context.time_base = stream.time_base = Fraction(1, BASE)
        stream.gop_size = 12
        for name, code in (color or {}).items():
            setattr(stream.codec_context, name, code)
        if turn:
            stream.set_display_rotation(turn)
        speech = None if sound is None else container.add_stream("aac", rate=SOUND_RATE, layout="mono")
        for pixels, t in zip(frames, times, strict=True):
            if not stream.codec_context.is_open:
                stream.height, stream.width, stream.pix_fmt = *pixels.shape[:2], pixel_format
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = round(t * BASE), Fraction(1, BASE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if speech is not None:
            write_sound(container, speech, sound)
    return path


def write_sound(container, stream, sound: np.ndarray) -> None:
    """Encode mono sound into an open container."""
    for k in range(0, len(sound), 1024):
        block = np.ascontiguousarray(sound[None, k : k + 1024], np.float32)
        frame = av.AudioFrame.from_ndarray(block, format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = SOUND_RATE, k, Fraction(1, SOUND_RATE)
        container.mux(stream.encode(frame))
    container.mux(stream.encode(None))


def gray_frames(count: int, size: tuple[int, int] = (32, 48)) -> list[np.ndarray]:
    """Frames with a white bar at column 2 k in frame k. [H, W, 3] uint8 each"""
    frames = []
    for k in range(count):
        pixels = np.full((*size, 3), 60, np.uint8)
        pixels[:, 2 * k % size[1] : 2 * k % size[1] + 4] = 220
        frames.append(pixels)
    return frames


@dataclass(frozen=True)
class Rig:
    """Cameras around the tiny scene.

    Attributes:
        names: Their names.
        cameras: Pinhole cameras.
        lenses: Their lenses, of the same focal length and principal point.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    lenses: tuple[Lens, ...]


def make_rig(
    count: int, width: int, height: int, coefficients: Sequence[float] = (), angles: Sequence[float] | None = None
) -> Rig:
    """Return cameras on a circle, by default on 120 degrees of it, with given Brown-Conrady coefficients."""
    angles = np.linspace(0.0, 2.1, count) if angles is None else angles
    cameras = tuple(tiny_datasets.orbit_camera(angle, width, height) for angle in angles)
    centered = [camera.intrinsics - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]) for camera in cameras]
    lenses = tuple(Lens.from_opencv(matrix, coefficients) for matrix in centered)
    return Rig(tuple(f"cam{k}" for k in range(count)), cameras, lenses)


def write_calibration(path: Path, rig: Rig) -> Path:
    """Write the calibration of a rig in anipose's format."""
    blocks = []
    for name, camera, lens in zip(rig.names, rig.cameras, rig.lenses, strict=True):
        matrix = [[lens.fx, 0.0, lens.cx - 0.5], [0.0, lens.fy, lens.cy - 0.5], [0.0, 0.0, 1.0]]
        rotation = cv2.Rodrigues(camera.T_cam_world[:3, :3])[0].ravel().tolist()
        blocks.append(
            f'[{name}]\nname = "{name}"\nsize = [{camera.width}, {camera.height}]\nmatrix = {matrix}\n'
            f"distortions = {[*lens.coefficients, *[0.0] * 5][:5]}\nrotation = {rotation}\n"
            f"translation = {camera.T_cam_world[:3, 3].tolist()}\n"
        )
    path.write_text("\n".join(blocks))
    return path


def distorted(pixels: np.ndarray, lens: Lens) -> np.ndarray:
    """Return the image of a lens from one of a pinhole camera with the same matrix and a wide margin.

    Args:
        pixels: Pinhole image with a margin of a quarter of its size on each side. [H, W, 3] uint8
    """
    height, width = pixels.shape[0] * 2 // 3, pixels.shape[1] * 2 // 3
    v, u = np.mgrid[:height, :width] + 0.5
    rays = lens.unproject(np.stack([u.ravel(), v.ravel()], 1))
    at = rays[:, :2] / rays[:, 2:]
    x = lens.fx * at[:, 0] + lens.cx + width / 4 - 0.5
    y = lens.fy * at[:, 1] + lens.cy + height / 4 - 0.5
    maps = (part.reshape(height, width).astype(np.float32) for part in (x, y))
    return cv2.remap(pixels, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def draw_tiny(camera: Camera, lens: Lens, t: float) -> np.ndarray:
    """Draw the tiny scene through a lens. [H, W, 3] uint8"""
    wide = np.array(camera.intrinsics)
    wide[0, 2] += camera.width / 4
    wide[1, 2] += camera.height / 4
    larger = Camera(camera.width * 3 // 2, camera.height * 3 // 2, wide, camera.T_cam_world)
    truth = tiny_datasets.make_truth()
    output = scene_renderer.render_frame(truth, scene_player.Player(truth).frame(t), larger, background="scene")
    return distorted(images.to_uint8(output.color), lens)


def draw_ball(camera: Camera, lens: Lens, t: float) -> np.ndarray:
    """Paint a ball that swings over a static texture. [H, W, 3] uint8"""
    rng = np.random.default_rng(zlib.crc32(camera.center.round(6).tobytes()))
    rough = rng.integers(60, 140, (camera.height // 8 + 1, camera.width // 8 + 1, 3), np.uint8)
    pixels = cv2.resize(rough, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    center = camera.T_cam_world[:3, :3] @ ball(t) + camera.T_cam_world[:3, 3]
    (u, v), radius = lens.project(center[None])[0], 0.22 * lens.fx / center[2]
    shift = 4  # fractional bits of OpenCV's drawing
    at = (round((u - 0.5) * 2**shift), round((v - 0.5) * 2**shift))
    cv2.circle(pixels, at, round(radius * 2**shift), (240, 200, 40), -1, cv2.LINE_AA, shift)
    return pixels


def ball(t: float) -> np.ndarray:
    """Position of the painted ball. [3]"""
    return np.array([0.9 * np.sin(2.1 * t), 0.7 * np.sin(3.3 * t + 1.0), 0.6 + 0.4 * np.sin(2.7 * t + 2.0)])


def record(
    folder: Path,
    rig: Rig,
    times: Sequence[np.ndarray],
    draw: Callable[[Camera, Lens, float], np.ndarray],
    *,
    clocks: Sequence[float] | None = None,
    sound: Sequence[np.ndarray] | None = None,
    calibration: bool = True,
) -> Path:
    """Write a video per camera and the calibration; returns the folder.

    Args:
        folder: Where to.
        rig: The cameras.
        times: True times of each camera's frames, seconds.
        draw: Function that draws a camera's frame.
        clocks: Subtracted from the true times, they give the times in the videos; the result is shifted to start at 0
            or later by the caller's choice of times.
        sound: Sound of each camera, from time 0 of its video on.
        calibration: Write the calibration.
    """
    for k, name in enumerate(rig.names):
        frames = (draw(rig.cameras[k], rig.lenses[k], t) for t in times[k])
        own = np.asarray(times[k]) - (0.0 if clocks is None else clocks[k])
        write_video(folder / f"{name}.mp4", frames, own, sound=None if sound is None else sound[k])
    if calibration:
        write_calibration(folder / "calibration.toml", rig)
    return folder


def tiny_rig() -> Rig:
    """Return the rig of `record_tiny`."""
    return make_rig(3, TINY_WIDTH, TINY_HEIGHT, COEFFICIENTS)


def record_tiny(folder: Path) -> Path:
    """Write three short videos of the tiny scene through distorted lenses, and their calibration; return the folder."""
    return record(folder, tiny_rig(), [np.arange(TINY_FRAMES) / 10] * 3, draw_tiny)
