"""A body's motion is simplified if neither the training images nor the poses need it, and not otherwise."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.bake import bake, bind_state, image_evidence, pose_errors, simplify_motion
from r5dgs_core.config.config import NeedsSection
from r5dgs_core.data import dataset as datasets
from r5dgs_core.motion import rotations
from r5dgs_core.motion.history import PoseErrors
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import predictability
from r5dgs_core.train import checkpoint, checkpoint_content
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

BRICK, BALL = tiny_datasets.BRICK, tiny_datasets.BALL
TIMES = tiny_datasets.OBSERVED
TAU = TIMES - TIMES[-1]
SLOW = np.radians(0.9) / tiny_datasets.T_MAX
LAW = 0.05  # dB of the training views that a baked scene may lose
MOTIONS = {
    "rest": MotionModel(radius=0.5),
    "turn": MotionModel("ballistic_spin", angular_velocity=[0, 0, SLOW], radius=0.5),
    "slide": MotionModel("translation", velocity=[0.05, 0.03, 0], radius=0.5),
}


@pytest.fixture(scope="module", params=MOTIONS)
def given(request, tmp_path_factory):
    """A data set whose brick rests, turns by 0.9 degrees in all or slides slowly, and its truth with static models."""
    points, *others = tiny_datasets._brick()
    # No two Gaussians in one place: their order would change with the last bit of a pose.
    points = points + np.random.default_rng(2).normal(scale=0.01, size=points.shape)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny_datasets, "_brick", lambda: (points, *others))
        patch.setitem(tiny_datasets.MOTIONS, BRICK, MOTIONS[request.param])
        folder = tmp_path_factory.mktemp(request.param)
        tiny = tiny_datasets.make_dataset(folder, width=96, height=72)
    groups = tuple(dataclasses.replace(g, model=MotionModel(radius=0.5)) for g in tiny.truth.groups)
    return request.param, dataclasses.replace(tiny.truth, groups=groups), datasets.read(tiny.root)


def evidence_of(scene, data, shown=None):
    """Images of the data set, or of the scene `shown`, with noise of 40 dB as pictures of a trained scene have."""
    evidence = image_evidence.ImageEvidence(scene, image_evidence.sample(data.train), None)
    draw, truths = np.random.default_rng(4), evidence._truths
    if shown is not None:
        player = scene_player.Player(shown)
        truths = [evidence._draw(evidence._frame(player, row), row)[0] for row in range(len(truths))]
    evidence._truths = [(t + 0.01 * draw.standard_normal(t.shape)).astype(np.float32) for t in truths]
    evidence.remember()
    return evidence


def simplified(scene, data, shown=None, **wanted):
    observed = np.ones(scene.tracks.poses.shape[:2], bool)
    found = simplify_motion.simplify(scene, observed, evidence_of(scene, data, shown), NeedsSection(**wanted))
    rows = {row["name"]: row for row in found.rows if row["object"] == "brick"}
    return found.scene, rows


def with_noise(scene, turn=0.0, shift=0.0):
    """The scene with noise in the poses of the brick that its images do not show. rad, world units"""
    draw, poses = np.random.default_rng(3), scene.tracks.poses.copy()
    noise = rotations.rotvecs_to_quats(turn * draw.standard_normal((len(TIMES), 3)))
    poses[BRICK, :, :4] = rotations.multiply(noise, poses[BRICK, :, :4])
    poses[BRICK, :, :4] = rotations.multiply(poses[BRICK, :, :4], rotations.conjugate(poses[BRICK, -1, :4]))
    poses[BRICK, :, 4:] += shift * draw.standard_normal((len(TIMES), 3))
    poses[BRICK, :, 4:] -= poses[BRICK, -1, 4:]
    return scene.with_arrays(track_poses=poses)


@pytest.mark.default_cases("turn")
def test_noise_is_simplified_to_rest_and_slow_motion_is_kept(given):
    name, truth, data = given
    scene, rows = simplified(with_noise(truth, 3e-4, 3e-5), data)
    decisions = {key: row["decision"] for key, row in rows.items()}
    assert decisions["rotation"] == ("on" if name == "turn" else "off")
    assert decisions["motion"] == ("on" if name == "slide" else "off")
    model = scene.groups[BRICK].model
    for t in (0.0, 0.4, truth.t_max, 2 * truth.t_max):
        quats, displacements = scene_player.Player(scene).group_poses(t)
        expected = [MOTIONS[name].angular_velocity * (t - truth.t_max), MOTIONS[name].velocity * (t - truth.t_max)]
        turn = rotations.quats_to_rotvecs(quats[BRICK])
        np.testing.assert_allclose(turn, expected[0], atol=2e-3 if name == "turn" else 0)
        np.testing.assert_allclose(displacements[BRICK], expected[1], atol=1e-3 if name == "slide" else 0)
    assert model.kind == {"rest": "static", "turn": "ballistic_spin", "slide": "translation"}[name]


@pytest.mark.default_cases("slide")
def test_overrides_of_the_user_keep_motion_below_the_noise(given):
    name, truth, data = given
    noisy = with_noise(truth, 3e-4, 3e-5)
    scene, rows = simplified(noisy, data, rotation="on", tracks="on")
    np.testing.assert_array_equal(scene.tracks.poses[BRICK], noisy.tracks.poses[BRICK])
    assert all(row["decision"] == "on" for row in rows.values())


@pytest.mark.parametrize("given", ["rest"], indirect=True)
def test_a_turn_that_carries_a_shadow_is_kept_while_it_is_seen_and_not_foretold(given):
    """The images need the colours of a turn that the body does not make: it ends with them."""
    _, truth, data = given
    turns = np.zeros((len(TIMES), 3))
    turns[:, 2] = 0.01 * TAU / -TAU[0]
    poses, vectors = truth.tracks.poses.copy(), np.zeros_like(truth.gaussians.means)
    poses[BRICK, :, :4] = rotations.rotvecs_to_quats(turns)
    vectors[truth.gaussians.motion_ids == BRICK, 1] = 30.0  # a turn of 0.01 rad darkens by a third
    light = np.array([1.0, 0, 0])
    carrier = truth.with_arrays(track_poses=poses, shading=vectors, light_direction=light)
    scene, rows = simplified(carrier, data, shown=carrier)
    row = rows["rotation"]
    assert row["decision"] == "on" and "only fits colours" in row["reason"] and "dB" in row["reason"]
    np.testing.assert_allclose(scene.tracks.poses[BRICK], poses[BRICK], atol=1e-12)
    later = scene_player.Player(scene).group_poses(2 * truth.t_max)
    assert scene.groups[BRICK].model.kind == "static"
    np.testing.assert_array_equal(later[0][BRICK], [1, 0, 0, 0])
    np.testing.assert_array_equal(later[1][BRICK], 0)


@pytest.mark.parametrize("by", ["masks", "errors"])
def test_the_motion_of_a_body_that_was_seen_once_is_not_predictable(given, by):
    name, truth, _ = given
    observed, measured = np.ones(truth.tracks.poses.shape[:2], bool), pose_errors.NOTHING
    if by == "masks":
        observed[BRICK, 1:] = False
    else:
        values = (0.01, *(np.inf,) * (len(TIMES) - 1))
        measured = pose_errors.Measured({BRICK: PoseErrors(values, values)}, {})
    found = simplify_motion.simplify(truth, observed, None, measured=measured).scene
    histories = {group.object_id: group.history for group in found.groups if group.role == "body"}
    assert not histories[BALL].warning(predictability.horizon(truth))
    if name != "rest" or by == "masks":
        assert histories[BRICK].warning() == f"not predictable past {truth.t_max:.2f}"
        assert histories[BRICK].band.half_width[0] > 1.0


def test_without_images_only_what_is_too_small_to_be_seen_is_dropped(given):
    name, truth, _ = given
    observed = np.ones(truth.tracks.poses.shape[:2], bool)
    small = simplify_motion.simplify(with_noise(truth, 1e-4, 1e-5), observed, None)
    rows = {row["name"]: row["decision"] for row in small.rows if row["object"] == "brick"}
    assert rows["rotation"] == ("on" if name == "turn" else "off")
    large = simplify_motion.simplify(with_noise(truth, 0.01, 0.01), observed, None)
    assert {row["decision"] for row in large.rows if row["object"] == "brick"} == {"on"}


def test_another_bind_state_shows_the_same_and_followers_follow(given):
    name, truth, data = given
    shadow = dataclasses.replace(
        truth.groups[BRICK], id=3, role="shadow", follows=BRICK, follow_matrix=np.diag([1.0, 1, 0]), anchor_index=-1
    )
    poses = np.concatenate([truth.tracks.poses, truth.tracks.poses[:1]])
    poses[BRICK, :-1, 4] += 0.003  # all poses but the last: it is the bind state that is off
    poses[3, :, 4:] = poses[BRICK, :, 4:] * [1, 1, 0]
    scene = dataclasses.replace(truth.with_arrays(track_poses=poses), groups=(*truth.groups, shadow))
    calm = poses.copy()
    calm[BRICK, -1, 4] += 0.003
    rebound = bind_state.rebind(scene, simplify_motion._move_followers(scene, calm))
    np.testing.assert_array_equal(rebound.tracks.poses[:, -1], [[1, 0, 0, 0, 0, 0, 0]] * 4)
    np.testing.assert_allclose(rebound.groups[BRICK].pivot - truth.groups[BRICK].pivot, [0.003, 0, 0], atol=1e-12)
    np.testing.assert_allclose(
        rebound.tracks.poses[3, :, 4:], rebound.tracks.poses[BRICK, :, 4:] * [1, 1, 0], atol=1e-12
    )
    before, after = scene_player.Player(scene).frame(0.3), scene_player.Player(rebound).frame(0.3)
    np.testing.assert_allclose(after.means, before.means, atol=1e-6)


def test_a_baked_scene_keeps_what_the_checkpoint_shows_in_the_training_views(trained, baked):
    compared = baked.provenance["training_views"]
    assert compared["baked_psnr"] > compared["checkpoint_psnr"] - LAW
    stored = float(checkpoint.load(trained.folder).tensors[checkpoint_content.TRAIN_PSNR])
    assert compared["checkpoint_psnr"] == stored


def test_without_training_images_a_warning_is_logged_and_poses_decide(trained, tiny, copied, caplog):
    data = datasets.read(copied)
    for view in data.train:
        view.image_path.unlink()
    scene = bake.bake(dataclasses.replace(trained, dataset_root=copied), data)
    assert "without the training images" in caplog.text and "--data" in caplog.text
    assert "training_views" not in scene.provenance


@pytest.mark.parametrize("given", ["slide"], indirect=True)
@pytest.mark.parametrize("whole", [image_evidence.WHOLE, 0])
def test_pixels_that_training_has_left_out_are_no_evidence(given, whole, monkeypatch):
    monkeypatch.setattr(image_evidence, "WHOLE", whole)
    _, truth, data = given
    noisy = with_noise(truth, 0.02, 0.02).tracks.poses
    region = np.zeros((72, 96), bool)
    region[20:45, 30:60] = True
    views = image_evidence.sample(data.train)
    found = []
    for changed in (np.zeros_like(region), region, ~region):
        evidence = image_evidence.ImageEvidence(truth, views, None, lambda view, image: ~region)
        for image in evidence._truths:
            image[changed] = 1 - image[changed]
        evidence.remember()
        support = evidence.support(BRICK, truth.tracks.poses, noisy, 0.1)
        found.append((evidence.psnr, evidence.loss(noisy), *dataclasses.astuple(support)))
    assert found[0] == found[1]
    assert found[2][0] < found[0][0] - 1
    everything = image_evidence.ImageEvidence(truth, views, None)
    assert everything.support(BRICK, truth.tracks.poses, noisy, 0.1) != support


@pytest.mark.parametrize("given", ["slide"], indirect=True)
def test_in_large_images_only_the_part_that_the_body_reaches_is_drawn(given, monkeypatch):
    _, truth, data = given
    evidence, noisy = evidence_of(truth, data), with_noise(truth, 0.02, 0.02).tracks.poses
    drawn = []

    def compare():
        drawn.append(0)
        return evidence.support(BRICK, truth.tracks.poses, noisy, 0.1), evidence.loss(noisy)

    draw = scene_renderer.render_frame

    def counted(scene, frame, camera, **options):
        drawn[-1] += camera.width * camera.height
        return draw(scene, frame, camera, **options)

    monkeypatch.setattr(scene_renderer, "render_frame", counted)
    support, loss = compare()
    monkeypatch.setattr(image_evidence, "WHOLE", 0)
    in_part, loss_in_part = compare()
    assert drawn[1] < 0.5 * drawn[0]
    assert dataclasses.astuple(in_part) == pytest.approx(dataclasses.astuple(support), rel=1e-4)
    assert loss_in_part == pytest.approx(loss, rel=1e-3) and loss > 0.1


@pytest.mark.parametrize("given", ["slide"], indirect=True)
def test_with_many_bodies_a_change_of_one_is_drawn_only_there_in_small_images_too(given, monkeypatch):
    _, truth, data = given
    evidence, noisy = evidence_of(truth, data), with_noise(truth, 0.02, 0.02).tracks.poses
    drawn, draw, found = [], scene_renderer.render_frame, []

    def counted(scene, frame, camera, **options):
        drawn[-1] += camera.width * camera.height
        return draw(scene, frame, camera, **options)

    monkeypatch.setattr(scene_renderer, "render_frame", counted)
    for few in (image_evidence.FEW, 1):
        monkeypatch.setattr(image_evidence, "FEW", few)
        drawn.append(0)
        found.append(dataclasses.astuple(evidence.support(BRICK, truth.tracks.poses, noisy, 0.1)))
    assert drawn[1] < 0.5 * drawn[0]
    assert found[1] == pytest.approx(found[0], rel=1e-4)


@pytest.mark.parametrize("given", ["slide"], indirect=True)
def test_a_change_of_one_body_poses_no_other_gaussians_again(given, monkeypatch):
    _, truth, data = given
    noisy = with_noise(truth, 0.02, 0.02).tracks.poses
    frame, posed, found = scene_player.Player.frame, [], []

    def counted(*given):
        posed.append(0)
        return frame(*given)

    for kept in (10**9, 0):
        monkeypatch.setattr(image_evidence, "KEPT", kept)
        evidence = evidence_of(truth, data)
        with monkeypatch.context() as patch:
            patch.setattr(scene_player.Player, "frame", counted)
            found.append((evidence.support(BRICK, truth.tracks.poses, noisy, 0.1), evidence.loss(noisy)))
        assert len(posed) == (0 if kept else 2 * len(evidence._views))
    assert found[0] == found[1]


@pytest.mark.parametrize("given", ["turn"], indirect=True)
def test_a_candidate_that_all_views_decide_is_compared_with_each_view_once(given, monkeypatch):
    _, truth, data = given
    compare, asked = image_evidence.ImageEvidence._compare, {}

    def counted(evidence, group, before, after, size, rows):
        asked.setdefault((group, after.tobytes()), []).append(list(rows))
        return compare(evidence, group, before, after, size, rows)

    monkeypatch.setattr(image_evidence.ImageEvidence, "_compare", counted)
    simplified(with_noise(truth, 3e-4, 3e-5), data)
    twice = [sum(calls, []) for calls in asked.values() if len(calls) > 1]
    assert twice and all(len(rows) == len(set(rows)) for rows in twice)


@pytest.mark.parametrize("given", ["slide"], indirect=True)
def test_views_compared_before_give_equal_support(given):
    _, truth, data = given
    evidence, noisy = evidence_of(truth, data), with_noise(truth, 0.02, 0.02).tracks.poses
    change, compared = (BRICK, truth.tracks.poses, noisy, 0.1), {}
    for rows in ([4, 1], None):
        assert evidence.support(*change, rows, compared) == evidence.support(*change, rows)


@pytest.mark.parametrize("given", ["slide"], indirect=True)
def test_with_many_bodies_only_gaussians_near_a_change_are_drawn(given, monkeypatch):
    _, truth, data = given
    evidence, noisy = evidence_of(truth, data), with_noise(truth, 0.02, 0.02).tracks.poses
    counts, draw, found = [], scene_renderer.render_frame, []

    def counted(scene, posed, camera, **options):
        counts[-1] += len(posed.means)
        return draw(scene, posed, camera, **options)

    monkeypatch.setattr(scene_renderer, "render_frame", counted)
    for few in (image_evidence.FEW, 1):
        monkeypatch.setattr(image_evidence, "FEW", few)
        counts.append(0)
        support = evidence.support(BRICK, truth.tracks.poses, noisy, 0.1)
        found.append((evidence.loss(noisy), *dataclasses.astuple(support)))
    assert counts[1] < 0.8 * counts[0]
    assert found[1] == pytest.approx(found[0], rel=1e-3)
