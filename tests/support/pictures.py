"""Data set of the images of a synthetic scene, for which all measurements are known, and readers of rendered images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenImageIO

from r5dgs_core.data import dataset, images
from r5dgs_core.evaluation import evaluate
from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import cameras
from r5dgs_core.scene.scene import Scene
from tests.support import scenes

WIDTH, HEIGHT = 48, 36
OBSERVED, LATER = (0.0, 0.3, 0.75), (0.85, 1.0)
BACKEND = "cpu"


def write_dataset(root: Path, scene: Scene) -> dataset.Dataset:
    """The scene's own pictures, id maps and poses, written in a layout that `dataset.read` knows and read back."""
    views = {
        "train": [(k, t) for t in OBSERVED for k in (0, 1)],
        "val": [(2, 0.1), (2, 0.6)],
        "test": [(k, t) for t in LATER for k in (0, 2)],
    }
    for split, wanted in views.items():
        frames = []
        for i, (k, t) in enumerate(wanted):
            camera = scenes.orbit_camera(0.5 * k, WIDTH, HEIGHT)
            shown = evaluate.render(scene, camera, t, backend=BACKEND)
            images.write_png(root / split / f"r_{i}.png", shown.color)
            images.write_png(root / "object_mask" / split / f"r_{i}.png", shown.ids.astype(np.uint8))
            matrix = cameras.cam_world_to_opengl(camera.T_cam_world).tolist()
            frame = {"file_path": f"{split}/r_{i}", "time": t, "transform_matrix": matrix, "view": f"cam{k}"}
            frames.append(frame)
        camera_file = {"camera_angle_x": 0.9, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(camera_file))
    times = sorted({*OBSERVED, *LATER})
    bodies = [group for group in scene.groups if group.role == "body"]
    rows = []
    for group in bodies:
        offset = np.eye(4)  # the frames of object and scene differ
        offset[:3, :3] = rotations.quats_to_rotmats(rotations.normalize(np.array([1.0, 0.3, -0.5, group.id])))
        offset[:3, 3] = [0.1 * group.id, -0.2, 5.0]
        matrices = []
        for t in times:
            quats, displacements = scene_player.Player(scene).group_poses(t)
            motion = np.eye(4)
            motion[:3, :3] = rotations.quats_to_rotmats(quats[group.id])
            motion[:3, 3] = group.pivot + displacements[group.id] - motion[:3, :3] @ group.pivot
            matrices.append((motion @ offset).tolist())
        rows.append({"id": group.object_id, "name": scene.object(group.object_id).name, "matrices": matrices})
    (root / "ground_truth.json").write_text(json.dumps({"t_max": 0.75, "times": times, "objects": rows}))
    return dataset.read(root)


def read_exr(path, parts=2):
    """Channels of all images of an EXR by pass and channel, with 3 parts of a name by layer, too. [H, W] each"""
    source, found, part = OpenImageIO.ImageInput.open(str(path)), {}, 0
    while source.seek_subimage(part, 0):
        pixels = source.read_image("float").reshape(source.spec().height, source.spec().width, -1)
        for index, name in enumerate(source.spec().channelnames):
            found[".".join(name.split(".")[-parts:])] = pixels[..., index]
        part += 1
    return found
