"""Build the demo scene "tabletop" in Blender, and capture it into the data set that `r5dgs demo` trains on.

Five objects on a round table, each with a motion in closed form: a toy car drives along an arc, a globe spins about its
tilted axis, a ball is thrown, a block slides with friction, a vase stands still. Poses are keyed at every frame, so the
scene is exact there. The motion after the last observed time continues the observed motion.

    python examples/build_tabletop.py --blend tabletop.blend --dataset DIR     with the bpy module
    blender -b --python examples/build_tabletop.py -- --blend tabletop.blend   with Blender
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from mathutils import Euler, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
from building import materials, motion, shapes, stage, toys


def build_tabletop() -> None:
    """Build the whole scene into the open file; pass indices number the objects."""
    stage.new((0.74, 0.85, 1.0), 0.62)
    stage.sun(2.1, (32.0, -18.0, 20.0), angle_deg=14.0, color=(1.0, 0.95, 0.86))
    rim = materials.plain("table rim", (0.20, 0.09, 0.04))
    top = materials.planks("table planks", ((0.46, 0.33, 0.21), (0.38, 0.26, 0.16), (0.25, 0.16, 0.09)), 0.42)
    profile = [(0.0, -0.14), (2.02, -0.14), (2.1, -0.10), (2.1, -0.04), (2.06, 0.0), (0.0, 0.0)]
    shapes.lathe("Table", profile, [rim, top], lambda row, k: int(row == 4), segments=96)
    foot = [(0, 0), (0.24, 0), (0.24, 0.04), (0.07, 0.07), (0.06, 0.2), (0, 0.2)]
    shapes.lathe("Globe stand", foot, [rim], lambda row, k: 0).location = (1.08, 0.62, 0)

    tilt = Euler((math.radians(18), math.radians(-12), 0)).to_quaternion()
    car, earth, thrown = toys.toy_car("toy car"), toys.globe("globe", 0.36), toys.beach_ball("beach ball", 0.27)
    block, urn = toys.toy_block("wooden block", 0.42), toys.vase("vase")
    urn.location = (-0.22, 1.12, 0)
    motion.perform(
        [
            motion.Actor(car, motion.drive((0, 0, 0), 1.38, 222.0, 76.0, 24.0)),
            motion.Actor(earth, motion.spin((1.08, 0.62, 0.52), tilt @ Vector((0, 0, 1)), 190.0, tilt=tilt)),
            motion.Actor(thrown, motion.throw((-1.35, 0.75, 0.62), (1.95, -0.95, 2.9), 5.2, (0.35, 1.0, 0.25), 170.0)),
            motion.Actor(block, motion.slide((-1.15, -0.02, 0), 4.0, 2.0, 1.15, 20.0, 75.0)),
            motion.Actor(urn),
        ]
    )


def tabletop_settings(capture: ModuleType, directory: Path):
    """Settings of the bundled data set, as the ``CaptureSettings`` of the capture service."""
    return capture.CaptureSettings(
        directory=directory,
        resolution_x=128,
        resolution_y=128,
        samples=192,
        frame_step=4,
        t_max=0.74,
        test_views=3,
        rig="ARC",
        rig_observed=10,
        rig_novel=2,
        rig_target=(0.0, 0.05, 0.42),
        rig_radius=5.0,
        rig_elevation_deg=33.0,
        rig_elevation_spread_deg=14.0,
        rig_arc_deg=160.0,
        rig_fov_deg=42.0,
        objects="PASS_INDEX",
    )


def main(arguments: Sequence[str]) -> None:
    """Build the scene, and save or capture it."""
    chosen = stage.parser("build_tabletop.py", __doc__.split("\n", 1)[0]).parse_args(arguments)
    build_tabletop()
    if chosen.blend is not None:
        stage.save(chosen.blend)
    if chosen.dataset is not None:
        service = stage.capture_service()
        stage.capture(service, tabletop_settings(service, chosen.dataset))


if __name__ == "__main__":
    main(stage.arguments())
