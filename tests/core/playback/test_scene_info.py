"""The summary of a scene holds what the scene does."""

import json

import numpy as np
import pytest

from r5dgs_core.playback import scene_info
from tests.support.scenes import T_MAX, TIMES, make_scene


@pytest.mark.parametrize("degree", range(4))
def test_the_summary_counts_what_the_scene_holds(degree):
    scene = make_scene(90, objects=2, sh_degree=degree, unassigned=3)
    info = scene_info.info(scene)
    assert info == json.loads(json.dumps(info))
    assert (info["sh_degree"], info["gaussians"], info["knots"], info["cameras"]) == (degree, 90, len(TIMES), 2)
    assert (info["times"], info["residuals"], info["vocabulary"], info["modes"]) == ([0.0, T_MAX], 0, 0, ["rigid"])
    assert [o["gaussians"] for o in info["objects"]] == [(scene.gaussians.object_ids == k).sum() for k in (-1, 0, 1, 2)]
    members = [(g["gaussians"], g["model"]) for g in info["motion_groups"]]
    kinds = ["static", "ballistic_spin", "translation", "follows 1"]
    assert members == [((scene.gaussians.motion_ids == k).sum(), kind) for k, kind in enumerate(kinds)]
    assert info["identities"] and info["shading"] and info["lookup"] is None and "origin" not in info
    far = scene.with_arrays(origin=np.array([0.0, 5e6, 0.0]))
    assert scene_info.info(far)["origin"] == [0.0, 5e6, 0.0]
