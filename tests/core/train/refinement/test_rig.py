"""Views are assigned to the poses and lenses of fixed and moving cameras."""

import dataclasses
from types import SimpleNamespace

import numpy as np

from r5dgs_core.train.refinement import rig
from tests.support import tiny_datasets


def view(name, t, angle=0.0):
    camera = dataclasses.replace(tiny_datasets.orbit_camera(angle, 48, 36), name=name)
    return SimpleNamespace(camera=camera, t=t)


def test_a_fixed_camera_has_one_pose_for_all_times():
    found = rig.of([view("left", 0.0), view("right", 0.0), view("left", 1.0), view("right", 1.0)])
    assert found.names == found.lens_names == ("left", "right")
    np.testing.assert_array_equal(found.pose_of, [0, 1, 0, 1])
    np.testing.assert_array_equal(found.lens_of, [0, 1, 0, 1])
    assert found.paths == ()


def test_a_moving_camera_has_a_pose_per_view_and_one_lens():
    found = rig.of([view("hand@1", 0.5), view("hand", 0.0), view("hand@2", 1.0), view("tripod", 0.0)])
    assert found.lens_names == ("hand", "tripod")
    np.testing.assert_array_equal(found.lens_of_pose, [0, 0, 0, 1])
    assert [path.tolist() for path in found.paths] == [[1, 0, 2]]


def test_views_without_names_and_with_a_pose_each_are_one_moving_camera():
    found = rig.of([view(f"cam{k}", 0.1 * k, angle=0.1 * k) for k in range(4)])
    assert found.poses == 4 and found.lenses == 1
    assert [path.tolist() for path in found.paths] == [[0, 1, 2, 3]]


def test_fixed_cameras_with_an_at_sign_in_their_names_have_a_lens_each():
    found = rig.of([view("left@home", 0.0), view("left@work", 0.0), view("left@work@1", 1.0)])
    assert found.lens_names == ("left@home", "left@work")
    np.testing.assert_array_equal(found.lens_of_pose, [0, 1, 1])
