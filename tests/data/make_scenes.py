"""Write the scene files of format version 1 beside this script; run once, with the release that first wrote them.

    python -m tests.data.make_scenes [FOLDER]

Never run it again to make a test pass: the files stand for what users have on their disks.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np

from r5dgs_core.motion import models, rotations
from r5dgs_core.scene import scene_file
from r5dgs_core.scene.lookup_table import EmbeddingSource, EncoderCard, LookupTable
from r5dgs_core.scene.scene import Scene
from tests.support.scenes import T_MAX, TIMES, make_scene


def tracks() -> Scene:
    """Two bodies on tracks and a shadow, with nothing optional."""
    return make_scene(n=60, objects=2, shading=False, identities=False)


def still() -> Scene:
    """Nothing moves: the file has no tracks."""
    scene = make_scene(n=40, objects=0, sh_degree=1, shading=False, identities=False)
    return scene.with_arrays(track_times=scene.tracks.times[-1:], track_poses=scene.tracks.poses[:, -1:])


def field() -> Scene:
    """Residuals, motion of each Gaussian on its own, and a body whose model swings."""
    scene = make_scene(n=60, objects=2, shading=False, identities=False, world_convention="colmap")
    rng = np.random.default_rng(1)
    rows = np.flatnonzero(scene.gaussians.object_ids == 1)[:5].astype(np.int32)
    ramp = (T_MAX - TIMES)[:, None]
    turns = rotations.rotvecs_to_quats(0.2 * ramp * rng.normal(size=(len(rows), 1, 3)))
    swinging = models.MotionModel("translation", velocity=[0.1, 0, 0], acceleration=[0.2, 0, 0], frequency=3.0)
    groups = (*scene.groups[:2], dataclasses.replace(scene.groups[2], model=swinging, seen=(0.1, T_MAX)))
    return dataclasses.replace(
        scene.with_arrays(
            residual_rows=rows,
            residual_offsets=(0.05 * ramp * rng.normal(size=(len(rows), 1, 3))).astype(np.float32),
            residual_quats=turns.astype(np.float32),
            residual_log_scales=(0.1 * ramp * rng.normal(size=(len(rows), 1, 3))).astype(np.float32),
            dynamics=(0.1 * rng.normal(size=(len(scene.gaussians.means), 12))).astype(np.float32),
            canonical_means=(scene.gaussians.means + np.float32(0.1)).astype(np.float32),
        ),
        groups=(*groups, *scene.groups[3:]),
        near_plane=0.04,
        harmonics_turn=False,
    )


def words() -> Scene:
    """Embeddings with a lookup table, a vocabulary, identities with their classifier, and shading."""
    scene = make_scene(n=60, objects=2)
    rng = np.random.default_rng(2)
    rows = len(scene.objects)
    unit = rotations.normalize(rng.normal(size=(rows + 3, 2, 8)))
    seen, said = EmbeddingSource("orbit_0.30", 0.21, 0.25, (13.0, 26.0, 43.0, 65.0)), EmbeddingSource("a mug", 0.3)
    views = tuple((seen, said) if item.id > 0 else () for item in scene.objects)
    return dataclasses.replace(
        scene.with_arrays(
            classifier_weight=rng.normal(size=(rows - 1, 16)).astype(np.float32),
            classifier_bias=rng.normal(size=rows - 1).astype(np.float32),
            shading_rest=rng.uniform(0.8, 1.2, len(scene.gaussians.means)).astype(np.float32),
            embeddings=unit[:rows, 0].astype(np.float32),
            vocabulary_embeddings=unit[rows : rows + 2, 0].astype(np.float32),
            canonical_embeddings=unit[rows + 2 :, 0].astype(np.float32),
            view_embeddings=unit[:rows].astype(np.float32),
        ),
        vocabulary=("mug", "tasse à café"),
        lookup=LookupTable(
            EncoderCard("clip", "tiny", "ab" * 32, 8, ("{}", "a photo of a {}"), 10.0),
            ("object",),
            views,
            tuple(0.2 if item.id > 0 else None for item in scene.objects),
            0.04,
            "max",
        ),
    )


SCENES = {f"{make.__name__}_v1": make for make in (tracks, still, field, words)}

if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for name, make in SCENES.items():
        print(scene_file.write(make(), folder / f"{name}.r5dgs"))
