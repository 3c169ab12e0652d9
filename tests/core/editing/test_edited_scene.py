"""Edits written into a scene: unedited scenes keep every bit, and moved objects are at their new place."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.editing import edited_scene
from r5dgs_core.editing.edited_scene import Piece
from r5dgs_core.motion import models, rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import presence, row_runs, scene_file, slipped_rotations, validation
from r5dgs_core.scene.lookup_table import EmbeddingSource, EncoderCard, LookupTable
from tests.support.scenes import make_scene, with_absence

TURN = rotations.quats_to_rotmats(rotations.normalize(np.array([0.3, -0.5, 0.7, 0.2])))
LATER = np.linspace(0.75, 1.0, 21)[1:]
MATCHING = ("means", "quats", "log_scales", "opacity_logits", "sh", "object_ids", "motion_ids", "identities", "shading")


def matrix_of(linear, offset=(0.0, 0.0, 0.0)):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, offset
    return matrix


def times_of(scene):
    return np.concatenate([scene.tracks.times, LATER])


def played(scene, motion_id, times):
    """Maps from the bind state that playback gives a motion group. [T, 4, 4]"""
    result = []
    for t in times:
        quats, moves = scene_player.Player(scene).group_poses(t)
        turn, pivot = rotations.quats_to_rotmats(quats[motion_id]), np.asarray(scene.groups[motion_id].pivot)
        result.append(matrix_of(turn, pivot + moves[motion_id] - turn @ pivot))
    return np.array(result)


def pieces_of(scene, noise=0.0, before=None, after=None):
    """Clouds of a loaded scene. Their maps are those of playback, between ``after`` and ``before`` by object id."""
    random, pieces = np.random.default_rng(0), []
    pairs = scene.gaussians.object_ids.astype(np.int64) * 1000 + scene.gaussians.motion_ids
    for start, stop, pair in row_runs.runs(pairs):
        object_id, motion_id = (pair + 1) // 1000 if pair < 0 else pair // 1000, pair % 1000
        object_id = int(scene.gaussians.object_ids[start])
        maps = played(scene, motion_id, times_of(scene))
        maps[:, :3] += noise * random.normal(size=maps[:, :3].shape)
        own = np.asarray(scene.groups[motion_id].pivot)
        outer, inner = (where.get(object_id, np.eye(4)) for where in (before or {}, after or {}))
        pieces.append(
            Piece(
                f"object {object_id}",
                object_id,
                motion_id,
                start,
                stop - start,
                f"mover {motion_id} {object_id}",
                outer @ maps @ inner,
                pivot=outer[:3, :3] @ own + outer[:3, 3] if motion_id else None,
                parent=outer[:3, :3] if before else None,
                allowed=2e-5,
            )
        )
    return pieces


def edit(scene, pieces, table=None):
    result, notes = edited_scene.edit(scene, pieces, times_of(scene), table or {})
    validation.check(result, "the edited scene")
    return result, notes


def assert_same(found, wanted, names=MATCHING):
    for name in names:
        np.testing.assert_array_equal(found.arrays()[name], wanted.arrays()[name], err_msg=name)


def rich_scene(**options):
    """With residuals, dynamics, embeddings and a classifier."""
    scene = make_scene(n=300, sh_degree=2, **options)
    random, rows = np.random.default_rng(3), np.array([110, 150, 220])
    offsets = random.normal(scale=0.05, size=(3, len(scene.tracks.times), 3)).astype(np.float32)
    growths = random.normal(scale=0.1, size=offsets.shape).astype(np.float32)
    offsets[:, -1], growths[:, -1] = 0, 0
    turns = rotations.rotvecs_to_quats(0.3 * random.normal(size=offsets.shape))
    turns[:, -1] = (1, 0, 0, 0)
    named = sum(item.id >= 0 for item in scene.objects)
    units = rotations.normalize(random.normal(size=(len(scene.objects), 8))).astype(np.float32)
    views = tuple((EmbeddingSource("obs0", 0.1 * row, 0.5, (0, 0, 9, 9)),) for row in range(len(scene.objects)))
    card, limits = EncoderCard("clip", "tiny", "ab" * 32, 8, ("{}",)), tuple(map(float, range(len(views))))
    return dataclasses.replace(
        scene.with_arrays(
            residual_rows=rows.astype(np.int32),
            residual_offsets=offsets,
            residual_log_scales=growths,
            residual_quats=turns.astype(np.float32),
            dynamics=random.normal(size=(300, 12)).astype(np.float32),
            canonical_means=scene.gaussians.means + np.float32(0.1),
            classifier_weight=random.normal(size=(named, 16)).astype(np.float32),
            classifier_bias=random.normal(size=named).astype(np.float32),
            embeddings=units,
            vocabulary_embeddings=units[:1],
            canonical_embeddings=units[:1],
            view_embeddings=units[:, None],
        ),
        vocabulary=("mug",),
        lookup=LookupTable(card, ("object",), views, limits, 0.1, "mean"),
    )


@pytest.mark.parametrize("noise", [0.0, 5e-7])
def test_an_unedited_scene_is_saved_byte_for_byte(tmp_path, noise):
    scene = rich_scene()
    result, notes = edit(scene, pieces_of(scene, noise))
    assert notes == []
    for path, content in (("a", scene), ("b", result)):
        scene_file.write(content, tmp_path / path)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_deleted_objects_are_removed_with_all_their_data():
    scene = rich_scene()
    result, notes = edit(scene, [piece for piece in pieces_of(scene) if piece.object_id != 2])
    assert [item.id for item in result.objects] == [-1, 0, 1, 3]
    assert [group.object_id for group in result.groups] == [0, 1, 3, 1]
    assert result.groups[3].follows == 1 and notes == []
    keep = scene.gaussians.object_ids != 2
    assert_same(result, scene.with_arrays(**{n: scene.arrays()[n][keep] for n in MATCHING}), MATCHING[:6])
    np.testing.assert_array_equal(result.dynamics.rates, scene.dynamics.rates[keep])
    np.testing.assert_array_equal(result.embeddings, scene.embeddings[[0, 1, 2, 4]])
    np.testing.assert_array_equal(result.view_embeddings, scene.view_embeddings[[0, 1, 2, 4]])
    assert result.lookup.thresholds == (0, 1, 2, 4) and result.lookup.views[3] == scene.lookup.views[4]
    np.testing.assert_array_equal(result.classifier.weight, scene.classifier.weight[[0, 1, 3]])
    for t in (0.1, 0.6, 0.95):
        np.testing.assert_array_equal(
            scene_player.Player(result).frame(t).means, scene_player.Player(scene).frame(t).means[keep]
        )


def test_without_its_leader_a_shadow_keeps_its_motion():
    scene = rich_scene()
    result, _ = edit(scene, [piece for piece in pieces_of(scene) if piece.object_id != 1])
    shadow = next(group for group in result.groups if group.role == "shadow")
    assert shadow.follows is None and shadow.object_id == 0
    rows, old = result.gaussians.motion_ids == shadow.id, scene.gaussians.motion_ids == 4
    for t in (0.3, 0.9):
        np.testing.assert_allclose(
            scene_player.Player(result).frame(t).means[rows], scene_player.Player(scene).frame(t).means[old], atol=1e-4
        )


@pytest.mark.parametrize("matrix", [matrix_of(1.5 * TURN, (0.2, -1.0, 0.3)), matrix_of(np.diag([1.0, 1, -1]))])
def test_a_moved_object_keeps_the_motion_of_its_group(matrix):
    scene = rich_scene()
    result, notes = edit(scene, pieces_of(scene, after={1: matrix}))
    rows = scene.gaussians.object_ids == 1
    assert {name.split()[0] for name in notes} == {"'dynamics'", "'canonical_means'"}
    np.testing.assert_array_equal(result.tracks.poses, scene.tracks.poses)
    assert result.groups[1].model == scene.groups[1].model
    base = dataclasses.replace(scene, residuals=None)
    for t in (0.0, 0.31, 0.75, 0.9):
        maps = played(scene, 1, [t])[0] @ matrix
        wanted = base.gaussians.means[rows] @ maps[:3, :3].T + maps[:3, 3]
        bent = np.zeros(len(rows), bool)
        bent[scene.residuals.rows] = True
        straight = ~bent[rows]
        np.testing.assert_allclose(
            scene_player.Player(result).frame(t).means[rows][straight], wanted[straight], atol=2e-5
        )


def test_residuals_and_shading_rotate_with_their_object():
    scene = rich_scene()
    matrix = matrix_of(1.4 * TURN, (0.2, -1.0, 0.3))
    result, _ = edit(scene, pieces_of(scene, before={k: matrix for k in range(-1, 4)}))
    for t in (0.02, 0.4, 0.75, 0.9):
        found, plain = scene_player.Player(result).frame(t), scene_player.Player(scene).frame(t)
        np.testing.assert_allclose(found.means, plain.means @ matrix[:3, :3].T + matrix[:3, 3], atol=5e-5)
        np.testing.assert_allclose(found.log_scales, plain.log_scales + np.log(1.4), atol=1e-5)
        turned = rotations.multiply(rotations.rotmats_to_quats(TURN), plain.quats.astype(np.float64))
        np.testing.assert_allclose(np.abs((found.quats * turned).sum(-1)), 1, atol=1e-5)


@pytest.mark.parametrize("mirror", [1, -1])
def test_a_parent_turns_the_learned_motion_and_its_model(mirror):
    scene = rich_scene(seed=2)
    linear = 0.7 * TURN @ np.diag([mirror, 1, 1])
    matrix = matrix_of(linear, (1.0, 0.5, 0.0))
    result, _ = edit(scene, pieces_of(scene, before={1: matrix}))
    model, turned = scene.groups[1].model, result.groups[1].model
    assert turned.kind == model.kind
    np.testing.assert_allclose(turned.velocity, linear @ model.velocity)
    np.testing.assert_allclose(turned.angular_velocity, mirror * linear / 0.7 @ model.angular_velocity)
    rows = (scene.gaussians.object_ids == 1) & ~np.isin(np.arange(300), scene.residuals.rows)
    for t in (0.0, 0.31, 0.75, 0.99):
        wanted = scene_player.Player(scene).frame(t).means[rows] @ matrix[:3, :3].T + matrix[:3, 3]
        np.testing.assert_allclose(scene_player.Player(result).frame(t).means[rows], wanted, atol=2e-5)


def test_a_covariance_is_turned_with_its_model():
    covariance = np.diag(np.arange(1.0, 7.0))
    names = tuple(f"{field}.{axis}" for field in ("velocity", "angular_velocity") for axis in "xyz")
    model = models.MotionModel(
        "constant_twist", velocity=(1, 0, 0), angular_velocity=(0, 1, 0), covariance=covariance, covariance_names=names
    )
    scene = make_scene(n=200, objects=1, shadows=False)
    scene = dataclasses.replace(scene, groups=(scene.groups[0], dataclasses.replace(scene.groups[1], model=model)))
    result, _ = edit(scene, pieces_of(scene, before={1: matrix_of(2 * TURN)}))
    found = result.groups[1].model.covariance
    np.testing.assert_allclose(found[:3, :3], 4 * TURN @ covariance[:3, :3] @ TURN.T, atol=1e-12)
    np.testing.assert_allclose(found[3:, 3:], TURN @ covariance[3:, 3:] @ TURN.T, atol=1e-12)


def test_new_curves_become_a_track_and_the_nearest_model():
    scene, t = rich_scene(), times_of(rich_scene())
    speed = np.array([0.4, 0, 0.2])
    quats = rotations.rotvecs_to_quats(np.outer(t - 0.75, (0, 0, 2.0)))
    turns = rotations.quats_to_rotmats(quats)
    maps = np.tile(np.eye(4), (len(t), 1, 1))
    maps[:, :3, :3], maps[:, :3, 3] = turns, (t - 0.75)[:, None] * speed
    pieces = [
        dataclasses.replace(piece, matrices=maps) if piece.object_id == 2 else piece for piece in pieces_of(scene)
    ]
    result, notes = edit(scene, pieces)
    assert not [note for note in notes if "model" in note]
    rows = scene.gaussians.object_ids == 2
    bent = np.isin(np.flatnonzero(rows), scene.residuals.rows)
    for k in (0, 5, len(t) - 1):
        wanted = scene.gaussians.means[rows] @ maps[k, :3, :3].T + maps[k, :3, 3]
        np.testing.assert_allclose(scene_player.Player(result).frame(t[k]).means[rows][~bent], wanted[~bent], atol=5e-5)
    np.testing.assert_array_equal(
        scene_player.Player(result).frame(0.9).means[~rows], scene_player.Player(scene).frame(0.9).means[~rows]
    )


def test_a_future_without_matching_model_is_approximated_with_a_note():
    scene, t = rich_scene(), times_of(rich_scene())
    maps = np.tile(np.eye(4), (len(t), 1, 1))
    maps[:, 0, 3] = 0.2 * np.sin(40 * np.maximum(t - 0.75, 0))
    pieces = [
        dataclasses.replace(piece, matrices=maps) if piece.object_id == 2 else piece for piece in pieces_of(scene)
    ]
    _, notes = edit(scene, pieces)
    assert any(note.startswith("object 2: no motion model") for note in notes)


def test_scale_that_changes_with_time_is_reported():
    scene = rich_scene()
    pieces = pieces_of(scene)
    pieces[-1].matrices[:5, :3, :3] *= 1.2
    assert any("scale changes with time" in note for note in edit(scene, pieces)[1])


def test_a_still_object_that_is_animated_gets_its_own_group():
    scene, t = rich_scene(), times_of(rich_scene())
    maps = np.tile(np.eye(4), (len(t), 1, 1))
    maps[:, 2, 3] = 0.5 * (t - 0.75)
    pieces = [
        dataclasses.replace(piece, matrices=maps) if (piece.object_id, piece.motion_id) == (0, 0) else piece
        for piece in pieces_of(scene)
    ]
    result, _ = edit(scene, pieces)
    assert len(result.groups) == len(scene.groups) + 1
    group = result.groups[-1]
    assert (group.role, group.object_id, group.model.kind) == ("body", 0, "translation")
    rows = result.gaussians.motion_ids == group.id
    np.testing.assert_allclose(
        scene_player.Player(result).frame(0.95).means[rows], result.gaussians.means[rows] + (0, 0, 0.1), atol=1e-5
    )


def test_a_copy_is_a_separate_object_with_the_motion_and_embedding_of_the_original():
    scene = rich_scene()
    pieces = pieces_of(scene)
    first = next(piece for piece in pieces if piece.object_id == 3)
    aside = matrix_of(np.eye(3), (0.0, 2.0, 0.0))
    copy = dataclasses.replace(first, object_id=9, mover="the copy", matrices=aside @ first.matrices,
                               pivot=first.pivot + aside[:3, 3])  # fmt: skip
    table = {9: dataclasses.replace(scene.object(3), id=9, name="mug two")}
    result, _ = edit(scene, [*pieces, copy], table)
    assert result.object(9).name == "mug two" and result.object(9).count == first.count
    np.testing.assert_array_equal(result.embeddings[-1], scene.embeddings[-1])
    assert result.lookup.thresholds[-1] == scene.lookup.thresholds[-1]
    rows, old = result.gaussians.object_ids == 9, scene.gaussians.object_ids == 3
    straight = ~np.isin(np.flatnonzero(old), scene.residuals.rows)
    for t in (0.2, 0.9):
        np.testing.assert_allclose(
            scene_player.Player(result).frame(t).means[rows],
            scene_player.Player(result).frame(t).means[result.gaussians.object_ids == 3] + aside[:3, 3], atol=2e-5,
        )  # fmt: skip
        np.testing.assert_array_equal(
            scene_player.Player(result).frame(t).means[result.gaussians.object_ids == 3][straight],
            scene_player.Player(scene).frame(t).means[old][straight],
        )


def test_names_and_tints_are_stored_and_names_stay_unique():
    scene = rich_scene()
    table = {k: dataclasses.replace(scene.object(k), name="cup", aliases=("beaker",)) for k in (1, 2)}
    pieces = [dataclasses.replace(p, tint=np.array([0.5, 1, 2])) if p.object_id == 1 else p for p in pieces_of(scene)]
    result, _ = edit(scene, pieces, table)
    assert [item.name for item in result.objects[2:4]] == ["cup", "cup 2"]
    assert result.object(1).aliases == ("beaker",)
    rows = scene.gaussians.object_ids == 1
    colour = 0.5 + 0.28209479177387814 * scene.gaussians.sh[rows, 0]
    np.testing.assert_allclose(
        0.5 + 0.28209479177387814 * result.gaussians.sh[rows, 0], colour * (0.5, 1, 2), atol=1e-6
    )
    np.testing.assert_array_equal(result.gaussians.sh[~rows], scene.gaussians.sh[~rows])


@pytest.mark.parametrize("where", ["before", "after"])
def test_moved_scenes_lose_the_ground_of_their_simulations(where):
    contact = {"name": "contact", "object_id": 1, "friction": 0.2}
    simulated = {**contact, "simulation": {"normal": [0, 0, 1], "height": 0.025}}
    scene = dataclasses.replace(rich_scene(), needs=({"name": "motion"}, simulated))
    down = {number: matrix_of(np.eye(3), (0, 0, -5.0)) for number in range(-1, 4)}
    assert edit(scene, pieces_of(scene))[0].needs == scene.needs
    assert edit(scene, pieces_of(scene, **{where: down}))[0].needs == ({"name": "motion"}, contact)


def test_records_of_slipped_rotations_stay_with_their_groups():
    record = slipped_rotations.record({1: [(0.1, 0.2)], 2: [(0.3, np.inf)], 3: [(-np.inf, 0.4)]})
    scene = dataclasses.replace(rich_scene(), provenance={"hash": "ab", **record})
    assert edit(scene, pieces_of(scene))[0].provenance == scene.provenance
    result, _ = edit(scene, [piece for piece in pieces_of(scene) if piece.object_id != 1])
    assert [group.object_id for group in result.groups[:3]] == [0, 2, 3] and result.provenance["hash"] == "ab"
    assert slipped_rotations.recorded(result) == {1: [(0.3, np.inf)], 2: [(-np.inf, 0.4)]}
    assert slipped_rotations.RECORD not in edit(scene, [])[0].provenance


def test_everything_may_be_deleted():
    result, _ = edit(rich_scene(), [])
    assert len(result.gaussians.means) == 0 and [item.id for item in result.objects] == [0]


@pytest.mark.parametrize("move", [np.eye(4), matrix_of(TURN, (1.0, 2.0, 3.0))])
def test_times_of_absence_are_kept_or_follow_the_edit(move):
    scene = with_absence(make_scene(n=120), (-np.inf, 0.123), (0.33, 0.36))
    times, pieces = times_of(scene), pieces_of(scene, after={1: move})
    result, _ = edit(scene, pieces)
    assert {group.absent for group in result.groups if group.object_id == 1} == {scene.groups[1].absent}
    kept = np.array([bool(scene.groups[1].absent) and (t < 0.123 or t == 0.35) for t in times])
    same = [dataclasses.replace(one, absent=kept if one.motion_id in (1, 4) else 0 * kept > 0) for one in pieces]
    assert [group.absent for group in edit(scene, same)[0].groups] == [group.absent for group in result.groups]
    later = [dataclasses.replace(one, absent=times > (0.65 if one.object_id == 2 else 9)) for one in pieces]
    found = {group.object_id: group.absent for group in edit(scene, later)[0].groups if group.role == "body"}
    assert found == {1: (), 2: ((pytest.approx(0.65), np.inf),), 3: ()}


def test_what_is_absent_at_all_times_is_left_out_with_a_note():
    scene = make_scene(n=120)
    times, pieces = times_of(scene), pieces_of(scene)
    hidden = [dataclasses.replace(one, absent=np.full(len(times), one.object_id == 2)) for one in pieces]
    result, notes = edit(scene, hidden)
    assert notes == ["object 2: left out, as it is hidden at all times"]
    assert not (result.gaussians.object_ids == 2).any() and result.object(1).count == scene.object(1).count


def test_pieces_of_a_group_with_different_absence_get_groups_of_their_own():
    scene = make_scene(n=120)
    times, pieces = times_of(scene), []
    for one in pieces_of(scene):
        half = one.count // 2 if one.motion_id == 1 else one.count
        pieces.append(dataclasses.replace(one, count=half, absent=times < (0.1 if one.motion_id == 0 else -9)))
        if half < one.count:
            rest = dataclasses.replace(one, start=one.start + half, count=one.count - half, absent=times > 0.61)
            pieces.append(rest)
    result, notes = edit(scene, pieces)
    late = [group for group in result.groups if group.absent]
    assert notes == [] and [group.object_id for group in late] == [-1, 0, 1]
    for t in (0.05, 0.3, 0.7):
        frame = scene_player.Player(result).frame(t)
        hidden = int((frame.opacity_logits == presence.HIDDEN).sum())
        still = int((scene.gaussians.motion_ids == 0).sum())
        assert hidden == (still if t < 0.1 else rest.count if t > 0.6 else 0)
        places = (sorted(one.means.tolist()) for one in (frame, scene_player.Player(scene).frame(t)))
        np.testing.assert_allclose(*places, atol=2e-5)
