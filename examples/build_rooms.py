"""Build an indoor scene in Blender, and capture it into a training data set.

    python examples/build_rooms.py dining --blend dining.blend --dataset DIR [--size 128] [--samples 24]
    blender -b --python examples/build_rooms.py -- dining --blend dining.blend     with Blender

Scenes: dining, chessboard, darkroom, factory; and nonrigid, in which two of the objects change their shape.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

sys.path.insert(0, str(Path(__file__).resolve().parent))
import rooms
from building import stage


def room_settings(
    capture: ModuleType,
    scene: str,
    directory: Path,
    *,
    size: int = 128,
    samples: int = 24,
    views: int = 12,
    novel: int = 2,
    frame_step: int = 4,
):
    """Settings of a capture, as the ``CaptureSettings`` of the capture service.

    Args:
        capture: The service.
        scene: Name of the scene.
        directory: New folder of the data set.
        size: Width and height of the images.
        samples: Cycles samples per pixel.
        views: Observed cameras, on an arc inside the room.
        novel: Cameras between them, for val and test.
        frame_step: Distance of captured frames, of 61 in total; those up to t = 0.75 are observed.
    """
    return capture.CaptureSettings(
        directory=directory,
        resolution_x=size,
        resolution_y=size,
        samples=samples,
        frame_step=frame_step,
        t_max=0.75,
        test_views=3,
        rig="ARC",
        rig_observed=views,
        rig_novel=novel,
        rig_target=(0.0, 0.0, 0.8),
        rig_radius=4.1,
        rig_elevation_deg=23.0,
        rig_elevation_spread_deg=13.0,
        rig_arc_deg=105.0,
        rig_fov_deg=rooms.FOV_DEG[scene],
        objects="PASS_INDEX",
    )


def _parser() -> argparse.ArgumentParser:
    parser = stage.parser("build_rooms.py", __doc__.split("\n", 1)[0])
    parser.add_argument("scene", choices=sorted(rooms.SCENES), help="which scene")
    stage.add_rendering(parser, samples=24, views=12)
    parser.add_argument("--novel", type=int, default=2, help="cameras between them, for val and test")
    parser.add_argument("--frame-step", type=int, default=4, help="distance of captured frames, of 61 in total")
    return parser


def main(arguments: Sequence[str]) -> None:
    """Build a scene, and save or capture it."""
    chosen = _parser().parse_args(arguments)
    rooms.SCENES[chosen.scene]()
    stage.use_threads(chosen.threads)
    if chosen.blend is not None:
        stage.save(chosen.blend)
    if chosen.dataset is not None:
        service = stage.capture_service()
        names = ("size", "samples", "views", "novel", "frame_step")
        settings = room_settings(
            service, chosen.scene, chosen.dataset, **{name: getattr(chosen, name) for name in names}
        )
        stage.capture(service, settings)


if __name__ == "__main__":
    main(stage.arguments())
