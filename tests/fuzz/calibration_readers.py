"""Readers of calibrations, and of the times of a capture, as readers for `campaign`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np

from r5dgs_core import errors
from r5dgs_core.capture.calibration import reading
from r5dgs_core.capture.calibration.calibration import CalibratedFrame, Calibration
from r5dgs_core.capture.calibration.formats import r5dgs_json
from r5dgs_core.prepare import capture_file, frame_times
from tests.core.capture.calibration.formats import (
    test_nerfstudio,
    test_opencv_yaml,
    test_qualisys,
    test_r5dgs_json,
    test_research_formats,
    test_toml_formats,
)
from tests.fuzz import mutations
from tests.fuzz.campaign import Files, Reader
from tests.support import colmap_files, scenes

POINTS = np.random.default_rng(0).normal(size=(20, 3)) + [0, 0, 4]


def formats() -> dict[str, Callable[[Path], object]]:
    """Functions that write a valid calibration of each format into a folder."""
    toml, research = test_toml_formats, test_research_formats

    def caliscope(folder: Path) -> None:
        tables = (toml.table(f"cameras.{k}", camera, k > 0) for k, camera in enumerate(toml.CAMERAS))
        (folder / "camera_array.toml").write_text("".join(tables))

    def anipose(folder: Path) -> None:
        tables = (toml.table(f"cam_{k}", camera, name=f'name = "{k}"\n') for k, camera in enumerate(toml.CAMERAS))
        (folder / "calibration.toml").write_text("".join(tables))

    def pose2sim(folder: Path) -> None:
        cameras = [{**camera, "d": camera["d"][:4]} for camera in toml.CAMERAS]
        tables = (toml.table(f"cam_{k}", camera, more="fisheye = false") for k, camera in enumerate(cameras))
        (folder / "Calib_scene.toml").write_text("".join(tables))

    def nerfstudio(folder: Path) -> None:
        frames = [{"file_path": f"images/{k}.png", "time": k / 3} for k in range(3)]
        test_nerfstudio.write(folder, frames, **test_nerfstudio.LENS, k1=-0.02, k2=0.01, p1=1e-3, p2=0.0)

    def llff(folder: Path) -> None:
        np.save(folder / "poses_bounds.npy", research.llff_rows())
        for k in range(3):
            (folder / f"cam{k}.mp4").touch()

    def colmap(folder: Path) -> None:
        cameras = {f"a/{k}.png": scenes.orbit_camera(0.4 * k, 32, 24) for k in range(3)}
        colmap_files.write(folder / "sparse" / "0", cameras, POINTS, text=True, model=colmap_files.OPENCV)

    return {
        "caliscope": caliscope,
        "anipose": anipose,
        "pose2sim": pose2sim,
        "qualisys": lambda folder: (folder / "Calib.qca.txt").write_text(test_qualisys.text()),
        "opencv_yaml": lambda folder: test_opencv_yaml.write(folder, [-0.3, 0.1, 1e-3, -2e-3, 0.02]),
        "panoptic": lambda folder: (folder / "train_meta.json").write_text(json.dumps(research.panoptic())),
        "nerfies": lambda folder: research.write_nerfies(folder, [research.nerfies_camera(k) for k in range(3)]),
        "nerfstudio": nerfstudio,
        "llff": llff,
        "r5dgs_json": lambda folder: r5dgs_json.write(folder / r5dgs_json.FILES, test_r5dgs_json.calibration()),
        "colmap": colmap,
    }


def use(calibration: Calibration) -> None:
    """Use everything that a reader has accepted."""
    assert calibration.cameras
    for camera in calibration.cameras:
        assert camera.name and camera.width >= 0 and camera.height >= 0
        frame = CalibratedFrame(Path(), None, camera.lens, camera.camera_to_world)
        for one in (frame, *camera.frames):
            pose = one.camera_to_world
            assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-3 and np.isfinite(pose).all()
            one.lens.project(POINTS)
            one.lens.unproject(np.array([[0.5, 0.5], [one.lens.cx, one.lens.cy]]))
    if calibration.points is not None:
        assert np.isfinite(calibration.points).all()


def calibration_reader(made_in: Callable[[Callable[[Path], object]], Files]) -> Reader:
    """Calibrations of all formats.

    Args:
        made_in: Returns the files that a function writes into a folder.
    """
    bases = list({name: made_in(write) for name, write in formats().items()}.values())

    def make(random: Random) -> Files:
        files = dict(random.choice(bases))
        name = random.choice([name for name, content in files.items() if content] or list(files))
        change = mutations.text if name.endswith((".yml", ".txt")) else mutations.by_name(name)
        files[name] = (mutations.npy if name.endswith(".npy") else change)(random, files[name])
        return files

    def read(folder: Path) -> None:
        use(reading.read_calibration(folder))

    return Reader("calibration", make, read)


def capture_reader() -> Reader:
    """Tables of times, and records of prepared data sets."""
    rows = "".join(f"{k // 2},{k % 2},{25 + k / 10:.4f}\n" for k in range(12))
    table = f"sync_index,cam_id,frame_time\n{rows}".encode()
    record = {"format_version": 1, "finished": True, "cameras": [{"name": "a", "offset_ms": 1.5, "notes": []}]}

    def make(random: Random) -> Files:
        if random.random() < 0.7:
            return {frame_times.FILE: mutations.text(random, table)}
        return {capture_file.FILE: mutations.tree(random, json.dumps(record).encode())}

    def read(folder: Path) -> None:
        if (folder / frame_times.FILE).exists():
            for times in frame_times.read(folder / frame_times.FILE).values():
                assert np.isfinite(times).all() and (np.diff(times) > 0).all()
        elif capture_file.read(folder) is None:
            raise errors.DatasetError("no record")

    return Reader("capture", make, read)
