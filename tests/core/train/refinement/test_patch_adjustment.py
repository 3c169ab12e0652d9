"""Poses and clocks from patches of images: of a textured plane that moves, drawn exactly."""

import dataclasses
import functools
import math

import numpy as np
import pytest

from r5dgs_core.config.sections.training import RefineSection
from r5dgs_core.scene import cameras
from r5dgs_core.scene.camera_correction import TIME, Correction
from r5dgs_core.train.refinement import agreement, gauge, patch_adjustment, patches
from r5dgs_core.train.refinement.refinement import CLOCKS, POSES
from tests.support import tiny_datasets

SIZE, STEP, MOMENTS, EACH = 96, 0.02, 4, 25
RIG = [tiny_datasets.orbit_camera(0.35 * k, SIZE, SIZE) for k in range(5)]
POINTS = np.random.default_rng(1).normal([0, 0, 0], [0.6, 0.6, 0.02], (400, 3))
WAVES = np.random.default_rng(2).normal(0, 7, (24, 2)), np.random.default_rng(3).uniform(0, 6.3, (24, 3))


def texture(places):
    """Smooth colours of places on the plane. [..., 2] -> [..., 3]"""
    phase = places @ WAVES[0].T
    return 0.5 + 0.06 * np.sin(phase[..., None] + WAVES[1]).sum(-2)


def drawn(camera, t, rate=9):
    """Image of the plane z = 0, whose texture moves on a circle, the depth, and the velocity."""
    rays = cameras.pixel_rays(camera)
    depth = -camera.center[2] / rays[..., 2]
    places = (camera.center + depth[..., None] * rays)[..., :2]
    shift = 0.15 * np.array([math.cos(rate * t), math.sin(rate * t)])
    velocity = np.broadcast_to([-rate * shift[1], rate * shift[0], 0], (SIZE, SIZE, 3))
    return texture(places - shift), depth * (rays @ camera.forward), velocity


@functools.cache
def depth_views(late=(0.0,) * 5, contrast=1.0, rate=9, carried=False):
    """Pictures of the true cameras with clocks that are late, the true depths, and the true velocities if carried."""
    found = []
    for moment, t in enumerate(np.linspace(0.1, 0.6, MOMENTS)):
        for pose, camera in enumerate(RIG):
            images = [0.5 + contrast * (drawn(camera, t + late[pose] + h, rate)[0] - 0.5) for h in (-STEP, 0, STEP)]
            depth, velocity = drawn(camera, t, rate)[1:]
            known = np.ones((SIZE, SIZE), bool)
            found.append(patches.depth_view(pose, moment, t, images, 2 * STEP, depth, carried * velocity, known))
    return found


def adjusted(seen, given, *, clocks=True):
    units = np.stack([gauge.pixel_units(camera, POINTS) for camera in given])
    rig = patch_adjustment.Cameras(given, [Correction() for _ in given], units, STEP)
    return patch_adjustment.adjust(seen, rig, patches.find(seen, rig.corrected(), EACH), clocks=clocks)


def moved(pixels, seed):
    """Cameras whose pictures have moved by some pixels, and the corrections that undo it."""
    rng = np.random.default_rng(seed)
    units = [gauge.pixel_units(camera, POINTS) for camera in RIG]
    errors = [Correction().plus(np.append(pixels * unit @ rng.normal(size=6), np.zeros(14))) for unit in units]
    return [error.camera(camera) for error, camera in zip(errors, RIG, strict=True)]


def error(found):
    """Distance of the pictures of cameras from the true ones up to the gauge, rms px."""
    units = np.stack([gauge.pixel_units(camera, POINTS) for camera in RIG])
    off = []
    for camera, true in zip(found, RIG, strict=True):
        change = camera.T_cam_world @ np.linalg.inv(true.T_cam_world)
        turn = 0.5 * (change[:3, :3] - change[:3, :3].T)
        off.append([turn[2, 1], turn[0, 2], turn[1, 0], *change[:3, 3]])
    left = gauge.Gauge(RIG, units).fix(np.array(off))
    return float(np.sqrt(np.mean(np.linalg.solve(units, left[..., None]) ** 2)))


def corrected(given, changes):
    return [Correction().plus(row).camera(camera) for row, camera in zip(changes, given, strict=True)]


@pytest.mark.parametrize("carried", [False, True])
def test_slopes_are_those_of_the_differences(carried):
    seen = depth_views(carried=carried)
    found = patches.find(seen, RIG, EACH)
    pair = int(np.flatnonzero(found.target != found.host[found.patch])[7])
    here = found.patch[pair : pair + 1]
    ends = [seen[found.host[here[0]]], seen[found.target[pair]]]

    def compared(change):
        placed = []
        for one, part in zip(ends, (change[:7], change[7:14]), strict=True):
            wide = np.concatenate([part[:6], [0.0], part[6:], np.zeros(12)])
            error = Correction().plus(wide)
            placed.append(patches.Placed(one, error.camera(RIG[one.pose]), error.shift, one.t + error.time))
        return patches.differences(*placed, found.centers[here], found.planes[here] + change[14:])

    slopes = compared(np.zeros(17))[1][0]
    pixel = 1 / RIG[0].intrinsics[0, 0]
    steps = 0.5 * np.array([*[pixel] * 3, *[4 * pixel] * 3, STEP] * 2 + [0.1 * pixel] + [0.02 * pixel] * 2)
    for k, step in enumerate(steps):
        up, down = (compared(sign * step * np.eye(17)[k])[0][0] for sign in (1, -1))
        true = (up - down) / (2 * step)
        assert np.linalg.norm(slopes[:, k] - true) < 0.3 * np.linalg.norm(true)


def test_wrong_poses_and_clocks_are_found_together():
    late = STEP * np.array([0.2, -0.15, 0.1, -0.25, 0.1])
    given = moved(0.5, 5)
    found = adjusted(depth_views(tuple(late)), given)
    assert error(given) > 0.3
    assert error(corrected(given, found.changes)) < 0.1
    off = found.changes[:, TIME.start] - late
    assert np.abs(off - off.mean()).max() < 0.04 * STEP
    limits = RefineSection()
    assert agreement.agreed(POSES, given, *found.halves, POINTS, STEP) > limits.pixels
    assert agreement.agreed(CLOCKS, given, *found.halves, POINTS, STEP) > limits.intervals


def test_the_motion_of_the_scene_gives_clocks_of_what_moves_too_fast_for_slopes():
    late = STEP * np.array([0.2, -0.15, 0.1, -0.25, 0.1])
    errors = []
    for carried in (False, True):
        found = adjusted(depth_views(tuple(late), rate=60, carried=carried), RIG)
        off = -late if found is None else found.changes[:, TIME.start] - late
        errors.append(np.abs(off - off.mean()).max())
    assert errors[1] < 0.04 * STEP < errors[0]
    assert errors[1] < 0.25 * errors[0]


def test_exact_cameras_need_no_correction():
    found = adjusted(depth_views(), RIG)
    assert error(corrected(RIG, found.changes)) < 0.1
    limits = RefineSection()
    assert agreement.agreed(POSES, RIG, *found.halves, POINTS, STEP) < limits.pixels
    assert agreement.agreed(CLOCKS, RIG, *found.halves, POINTS, STEP) < limits.intervals


def test_clocks_stay_unless_they_are_wanted():
    late = STEP * np.array([0.2, -0.15, 0.1, -0.25, 0.1])
    assert not adjusted(depth_views(tuple(late)), RIG, clocks=False).changes[:, TIME].any()


def test_pictures_without_contrast_adjust_nothing():
    assert adjusted(depth_views(contrast=1e-3), RIG) is None


def test_hidden_patches_are_not_compared():
    seen = depth_views()
    hidden = [dataclasses.replace(one, inverse=one.inverse * (1.1 if one.pose == 2 else 1.0)) for one in seen]
    found = patches.find(hidden, RIG, EACH)
    with_2 = [{hidden[a].pose, hidden[b].pose} for a, b in zip(found.host[found.patch], found.target, strict=True)]
    assert with_2 and not any(2 in both for both in with_2)
