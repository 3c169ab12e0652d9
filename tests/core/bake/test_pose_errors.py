"""Errors of observed poses from images: as large as those of poses fitted to noisy images, infinite without views."""

import numpy as np
import pytest
from scipy import ndimage

from r5dgs_core.bake import pose_errors
from r5dgs_core.bake.unseen_rotations import Unseen
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.motion import rotations
from r5dgs_core.motion.history import PoseErrors
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import sampling
from tests.support import tiny_datasets

HIDDEN = 2  # knot


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """The true scene of a tiny data set, and the data set."""
    tiny = tiny_datasets.make_dataset(tmp_path_factory.mktemp("errors"), width=96, height=72)
    return tiny.truth, datasets.read(tiny.root)


def measured(monkeypatch, scene, data, noise=0.02, shown=None):
    """Errors of all bodies of a scene whose images show another one, with noise; no mask shows them at one knot."""
    shown = scene if shown is None else shown
    player, draw = scene_player.Player(shown), np.random.default_rng(3)

    def image(view, _):
        color = scene_renderer.render_frame(shown, player.frame(view.t), view.camera).color
        return (color + noise * draw.standard_normal(color.shape)).astype(np.float32)

    def mask(view):
        ids = scene_renderer.render_frame(shown, player.frame(view.t), view.camera).ids
        return 0 * ids if abs(view.t - scene.tracks.times[HIDDEN]) < 1e-6 else ids

    monkeypatch.setattr(datasets, "load_given_image", image)
    monkeypatch.setattr(datasets, "load_mask", mask)
    bodies = [group.id for group in scene.groups if group.role == "body"]
    return pose_errors.measure(scene, data, config.Config(), bodies, True).errors


def test_errors_follow_the_misfit_and_are_infinite_at_knots_that_no_image_shows(monkeypatch, given):
    scene, data = given
    found, noisy = (measured(monkeypatch, scene, data, noise) for noise in (0.01, 0.04))
    assert set(found) == {group.id for group in scene.groups if group.role == "body"}
    for group, own in found.items():
        place, turn = np.array(own.place), np.array(own.turn)
        assert np.flatnonzero(np.isinf(place)).tolist() == np.flatnonzero(np.isinf(turn)).tolist() == [HIDDEN]
        seen = np.isfinite(place)
        assert (place[seen] > 0).all() and (place[seen] < 0.1 * scene.groups[group].model.radius).all()
        for name in ("place", "turn"):
            growth = np.median(np.array(getattr(noisy[group], name))[seen] / np.array(getattr(own, name))[seen])
            assert 2 < growth < 8


def moved(scene, groups, axis, step):
    """The scene with its bodies turned about axes 0 to 2, by radians, or shifted along axes 3 to 5, by world units."""
    poses = scene.tracks.poses.copy()
    for group in groups if axis < 3 else ():
        poses[group, :, :4] = rotations.multiply(
            rotations.rotvecs_to_quats(step * np.eye(3)[axis]), poses[group, :, :4]
        )
    if axis >= 3:
        poses[groups, :, 1 + axis] += step
    return scene_player.Player(scene.with_arrays(track_poses=poses))


def fitted_errors(scene, data, groups, knot, noise, draws=40, step=0.01):
    """Errors per component of rotations and displacements that fit images with noise best, by body; to first order."""
    views = [view for view in data.train if abs(view.t - scene.tracks.times[knot]) < 1e-6]
    players = [scene_player.Player(scene), *(moved(scene, groups, axis, step) for axis in range(6))]
    slopes = {group: [] for group in groups}
    for view in sampling.spread(views, pose_errors.VIEWS):
        drawn = [scene_renderer.render_frame(scene, player.frame(view.t), view.camera) for player in players]
        change = np.stack([picture.color.astype(np.float64) - drawn[0].color for picture in drawn[1:]], -1) / step
        for group in groups:
            near = ndimage.binary_dilation(drawn[0].ids == scene.groups[group].object_id, iterations=3)
            slopes[group].append(change[near].reshape(-1, 6))
    found = {}
    for group, parts in slopes.items():
        columns = np.concatenate(parts)
        wrong = np.random.default_rng(0).normal(scale=noise, size=(len(columns), draws))
        off = np.linalg.lstsq(columns, wrong, rcond=None)[0]
        found[group] = np.sqrt((off[:3] ** 2).mean()), np.sqrt((off[3:] ** 2).mean())
    return found


def test_errors_are_as_large_as_those_of_poses_fitted_to_noisy_images(monkeypatch, given):
    scene, data = given
    claimed = measured(monkeypatch, scene, data, noise=0.02)
    for knot in (0, 4):
        for group, (turn, place) in fitted_errors(scene, data, list(claimed), knot, 0.02).items():
            assert 0.5 < claimed[group].turn[knot] / turn < 2
            assert 0.5 < claimed[group].place[knot] / place < 2


def test_rotations_are_unknown_if_the_images_show_another_texture(monkeypatch, given):
    scene, data = given
    group = tiny_datasets.BRICK
    index = next(g.id for g in scene.groups if g.object_id == group and g.role == "body")
    sh = scene.gaussians.sh.copy()
    mine = np.flatnonzero(scene.gaussians.motion_ids == index)
    sh[mine] = sh[np.random.default_rng(0).permutation(mine)]
    other = scene.with_arrays(sh=sh)
    found = measured(monkeypatch, other, data, shown=scene)[index]
    seen = np.isfinite(found.turn)
    assert (np.array(found.turn)[seen] == pose_errors.UNKNOWN).all()
    assert (np.array(measured(monkeypatch, scene, data)[index].turn)[seen] < 0.5).all()


def test_rotations_about_unseen_axes_are_stored_as_unknown():
    errors = PoseErrors((0.1, 0.1), (0.01, np.inf))
    some = pose_errors.with_unseen(errors, Unseen(np.eye(3)[:1], 0.1))
    assert some.turn == pytest.approx((np.sqrt((2 * 0.01**2 + 1) / 3), np.inf)) and some.place == errors.place
    assert pose_errors.with_unseen(errors, Unseen(np.eye(3), 0.1)).turn == (pose_errors.UNKNOWN, np.inf)
