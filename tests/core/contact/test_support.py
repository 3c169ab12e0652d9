"""The plane under moving bodies."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.contact import support
from tests.support import scenes


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 1e12])
def test_cameras_at_different_places_are_kept_in_any_unit(scale):
    rig = [scenes.orbit_camera(angle, 16, 12) for angle in (0.1, 0.8, 1.3, 2.5)]

    def scaled(camera):
        T = camera.T_cam_world.copy()
        T[:3, 3] *= scale
        return dataclasses.replace(camera, T_cam_world=T)

    cameras = tuple(scaled(camera) for camera in rig)
    assert len(support._distinct(cameras)) == 4
    nudged = dataclasses.replace(rig[0], T_cam_world=rig[0].T_cam_world + 1e-9 * np.eye(4, 4, 3))
    assert len(support._distinct((*cameras, scaled(nudged), cameras[2]))) == 4
    assert support._distinct(cameras[:1] * 3) == [cameras[0]] and support._distinct(()) == []
