"""A trial finds objects that bend; these get residuals that play, and other objects do not change."""

import json
import shutil

import numpy as np
import pytest
import torch

from r5dgs_core.bake import bake, point_motion
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import ConfigError, TrainingError
from r5dgs_core.model import residual_field
from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.train import checkpoint, residual_trial, run
from r5dgs_core.train.representations import residual
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

BRICK, BALL = tiny_datasets.BRICK, tiny_datasets.BALL
KNOTS = 4


def random_state(count=60, bodies=2, *, seed=0):
    """Means, quats, weights and groups 0 .. bodies of Gaussians, float64."""
    generator = torch.Generator().manual_seed(seed)
    ids = torch.arange(count) % (bodies + 1)
    means = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 0.3 + ids[:, None]
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    return means, quats, torch.rand(count, generator=generator, dtype=torch.float64) + 0.4, ids


def field_on(means, ids, weights, bodies=(1, 2), *, nodes=8):
    return residual_field.spread(means, ids, weights, list(bodies), nodes, KNOTS)


def set_linear(field, matrix, body=1):
    """Give the nodes of a body the values of the offset ``matrix (x - mean of the nodes)``."""
    mine = field.owners == body
    nodes = field.nodes[mine]
    length = (nodes - nodes.mean(0)).pow(2).sum(1).mean().sqrt()
    with torch.no_grad():
        field.values[:, mine, 0] = (nodes - nodes.mean(0)) @ matrix.T
        field.values[:, mine, 1:] = matrix.T * length


def about_mean(points, weights):
    return points - (weights[:, None] * points).sum(0) / weights.sum()


def test_a_new_field_changes_nothing():
    means, quats, weights, ids = random_state()
    change = field_on(means, ids, weights).change(means, quats, weights, ids, {1: 1.0})
    assert sorted(change.rows.tolist()) == torch.nonzero(ids > 0)[:, 0].tolist()
    assert not change.offsets.any() and change.log_scales.abs().max() < 1e-12
    assert torch.equal(change.quats, torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand_as(change.quats))


def test_a_linear_change_of_shape_is_kept_exactly():
    means, quats, weights, ids = random_state()
    field = field_on(means, ids, weights)
    stretch = torch.tensor([[0.3, 0.1, 0.0], [0.1, -0.2, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    set_linear(field, stretch)
    change = field.change(means, quats, weights, ids, {0: 1.0})
    mine = ids[change.rows] == 1
    x, w = means[change.rows][mine], weights[change.rows][mine]
    moved = about_mean(x @ stretch.T, w)
    middle = about_mean(x, w)
    left = change.offsets[mine] - moved  # at most a small rotation, which the track takes
    basis = [torch.linalg.cross(axis.expand_as(middle), middle).reshape(-1) for axis in torch.eye(3).double()]
    turned = torch.stack(basis, 1)
    spin = torch.linalg.lstsq(turned, left.reshape(-1, 1)).solution
    torch.testing.assert_close(turned @ spin, left.reshape(-1, 1), atol=1e-9, rtol=0)
    assert change.offsets[~mine].abs().max() == 0


def test_breathing_grows_the_gaussians_too():
    means, quats, weights, ids = random_state()
    field = field_on(means, ids, weights)
    set_linear(field, 0.25 * torch.eye(3, dtype=torch.float64))
    change = field.change(means, quats, weights, ids, {2: 1.0})
    mine = ids[change.rows] == 1
    torch.testing.assert_close(change.log_scales[mine], torch.full((int(mine.sum()), 3), np.log(1.25)).double())
    expected = 0.25 * about_mean(means[change.rows][mine], weights[change.rows][mine])
    torch.testing.assert_close(change.offsets[mine], expected, atol=1e-9, rtol=0)


def test_rigid_gaussians_follow_their_track():
    means, quats, weights, ids = random_state()
    field = field_on(means, ids, weights)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        field.values.copy_(torch.randn(field.values.shape, generator=generator, dtype=torch.float64) * 0.1 + 0.5)
    change = field.change(means, quats, weights, ids, {0: 0.3, 1: 0.7})
    assert change.offsets.abs().max() > 0.05
    for body in (1, 2):
        mine = ids[change.rows] == body
        x, o, w = means[change.rows][mine], change.offsets[mine], weights[change.rows][mine][:, None]
        assert (w * o).sum(0).abs().max() < 1e-9
        assert (w * torch.linalg.cross(about_mean(x, w[:, 0]), o)).sum(0).abs().max() < 1e-4


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.4, 2.0])
def test_a_rotation_matrix_gives_back_its_quaternion(angle):
    quat = rotations.rotvecs_to_quats(torch.tensor([[0.6, -0.64, 0.48]], dtype=torch.float64) * angle)
    found = residual_field._turn(rotations.quats_to_rotmats(quat))
    torch.testing.assert_close(found, quat, atol=1e-12, rtol=0)


def test_gradients_of_a_change_are_those_of_differences():
    means, quats, weights, ids = random_state(9, 1)
    field = field_on(means, ids, weights, (1,), nodes=3)
    start = 0.1 * torch.randn(field.values.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def changed(values, turns):
        field.values = values
        change = field.change(means, turns, weights, ids, {1: 0.6, 2: 0.4})
        return change.offsets, change.quats, change.log_scales, field.penalty(0.5, 2.0)

    assert torch.autograd.gradcheck(changed, (start.requires_grad_(), quats.requires_grad_()))


def test_nodes_spread_over_each_body_and_strays_carry_none():
    means, _, weights, ids = random_state(300)
    means[1] += 50.0
    field = field_on(means, ids, weights, nodes=12)
    assert field.bodies == [1, 2] and [(field.owners == b).sum().item() for b in (1, 2)] == [12, 12]
    assert field.nodes.abs().max() < 10
    only = field.only([2])
    assert only.bodies == [2] and torch.equal(only.nodes, field.nodes[field.owners == 2])
    assert field_on(means, ids, weights, (1, 9)).bodies == [1]


def test_a_part_of_a_field_measures_no_body_again(monkeypatch):
    means, quats, weights, ids = random_state(300)
    field = field_on(means, ids, weights, nodes=12)
    field.values = torch.randn_like(field.values)
    fresh = residual_field.ResidualField(
        *(x[field.owners == 2] for x in (field.nodes, field.owners)), field.only([2]).values
    )
    monkeypatch.setattr(residual_field, "_lengths", None)
    found = [f.change(means, quats, weights, ids, {1: 1.0}) for f in (field.only([2]), fresh)]
    assert torch.equal(found[0].rows, torch.nonzero(ids == 2)[:, 0])
    assert torch.equal(found[0].offsets, found[1].offsets) and found[0].offsets.abs().max() > 0


def test_rows_of_bodies_are_padded_to_the_largest():
    index, there = residual_field._padded(torch.tensor([7, 2, 0, 7, 7, 5]), [2, 5, 7])
    assert index.tolist() == [[1, 0, 0], [5, 0, 0], [0, 3, 4]]
    assert there.tolist() == [[True, False, False], [True, False, False], [True, True, True]]


def test_a_field_without_bodies_changes_nothing():
    means, quats, weights, ids = random_state()
    field = field_on(means, ids, weights).only([])
    assert field.bodies == [] and len(field.change(means, quats, weights, ids, {0: 1.0}).rows) == 0


def test_a_body_of_one_gaussian_cannot_bend():
    means, quats, weights, _ = random_state(3)
    ids = torch.tensor([0, 1, 0])
    field = field_on(means, ids, weights, (1,))
    with torch.no_grad():
        field.values += 0.3
    change = field.change(means, quats, weights, ids, {0: 1.0})
    assert change.offsets.abs().max() < 1e-9 and change.log_scales.isfinite().all()


def test_residual_rotation_is_shaded_like_track_rotation():
    generator = torch.Generator().manual_seed(4)
    colors, shading = torch.rand(5, 3, generator=generator), 0.3 * torch.randn(5, 3, generator=generator)
    light, turn = torch.tensor([0.2, -0.5, 0.9]), rotations.rotvecs_to_quats(torch.tensor([[0.3, 0.1, -0.8]]))
    rows, groups, none = torch.tensor([1, 3]), torch.tensor([0, 0]), torch.zeros(2, 3)
    still, matrix = torch.tensor([[1.0, 0, 0, 0]]), rotations.quats_to_rotmats(turn)
    found = []
    for own, track in ((turn, torch.eye(3)[None]), (still, matrix)):
        change = residual_field.Change(rows, none, own.expand(2, 4), none)
        found.append(residual.relight(change, colors, shading, light, track, groups))
    (a, left), (b, _) = found
    torch.testing.assert_close(a, b)
    factor = 1 + (shading @ (matrix[0].T @ light - light))[:, None]
    torch.testing.assert_close(a[rows], (colors * factor.clamp(min=0))[rows])
    others = torch.tensor([0, 2, 4])
    assert (
        torch.equal(a[others], colors[others]) and torch.equal(left[others], shading[others]) and not left[rows].any()
    )


def test_bodies_that_gain_more_than_the_threshold_keep_residuals():
    means, _, weights, ids = random_state()
    field = field_on(means, ids, weights)
    settings = config.load(None, ["residual.threshold=0.5"])
    assert residual_trial.flexible(np.array([0.4, 0.6]), field, settings) == [2]
    assert residual_trial.flexible(np.array([np.nan, -1.0]), field, settings) == []
    assert residual_trial.flexible(np.array([np.nan, -1.0]), field, settings.replace(**{"needs.residuals": "on"})) == [
        1,
        2,
    ]


@pytest.mark.parametrize("override", ["needs.residuals=off", "needs.tracks=off", "train.representation=field"])
def test_disabled_residuals_are_not_tried(override):
    assert residual_trial.decision_step(config.load(None, [override]), 600) is None


def test_bodies_are_tried_once_all_times_take_part():
    settings = config.load(None, ["train.iterations=1000"])
    assert residual_trial.decision_step(settings, 300) == 400 and residual_trial.decision_step(settings, 500) == 500
    assert residual_trial.decision_step(settings, 1000) is None


def test_unusable_values_are_refused():
    with pytest.raises(ConfigError, match=r"residual\.start: expected 0 to 1"):
        config.load(None, ["residual.start=1.5"])


def make(data, *overrides):
    return Trainer(datasets.read(data.root), tiny_datasets.settings(*overrides))


def advance(trainer, iteration):
    decision = run.decision_step(trainer)
    while trainer.iteration < iteration:
        run.take_step(trainer, decision, lambda event: None)
    return trainer


def assert_same_tensors(a, b):
    assert a.keys() == b.keys()
    for name, tensor in a.items():
        torch.testing.assert_close(tensor, b[name], atol=0, rtol=0, equal_nan=True, msg=name)


def test_a_trial_that_finds_nothing_leaves_no_trace(tiny):
    tried = advance(make(tiny, "train.iterations=60"), 40).state()
    plain = advance(make(tiny, "train.iterations=60", "needs.residuals=off"), 40).state()
    assert tried.tensors.pop("residual.gains").shape == (2,)
    assert_same_tensors(tried.tensors, plain.tensors)
    assert (tried.queue, tried.running_loss, tried.entered) == (plain.queue, plain.running_loss, plain.entered)


def test_a_failed_trial_does_not_change_the_run(tiny, monkeypatch):
    trainer = advance(make(tiny, "train.iterations=60"), 23)
    step = type(trainer).step

    def failing(self):
        if self.motion.residuals is not None:
            raise TrainingError("step 25: nothing is finite")
        return step(self)

    monkeypatch.setattr(type(trainer), "step", failing)
    advance(trainer, 24)
    assert trainer.iteration == 24 and trainer.motion.residuals is None
    assert trainer.state().tensors["residual.gains"].isnan().all()


def test_nothing_is_tried_with_a_single_observed_time(tiny, tmp_path):
    shutil.copytree(tiny.root, tmp_path / "still")
    path = tmp_path / "still" / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"] = [frame for frame in content["frames"] if frame["time"] == tiny_datasets.T_MAX]
    path.write_text(json.dumps(content))
    settings = tiny_datasets.settings("train.iterations=60", "needs.residuals=on")
    trainer = advance(Trainer(datasets.read(tmp_path / "still"), settings), 30)
    tensors = trainer.state().tensors
    assert trainer.motion.name == "still" and not any(name.startswith("residual.") for name in tensors)
    row = point_motion.residual_need(tensors, {}, {}, settings, there=False)
    assert (row.value, row.on) == (0.0, False) and "none was tried" in row.reason


def test_the_table_marks_deformation_too_small_to_store():
    means, _, weights, ids = random_state()
    tensors = residual.tensors_of(field_on(means, ids, weights).only([2]))
    tensors |= {"residual.gains": torch.tensor([-1.0, 0.7]), "object_ids": torch.tensor([0, 1, 2])}
    for there in (True, False):
        reason = point_motion.residual_need(tensors, {2: "ball"}, {}, config.load(None), there).reason
        assert "ball (+0.7)" in reason and ("too little to be stored" in reason) != there


def test_the_table_names_objects_that_are_divided_into_parts():
    tensors = {"residual.gains": torch.tensor([-1.0, 3.0, 0.1]), "object_ids": torch.tensor([0, 1, 2, 3])}
    names, settings = {2: "arm"}, config.load(None)
    before = point_motion.residual_need(tensors, names, {1: 1, 2: 1, 3: 1}, settings, there=False).reason
    assert before.endswith("3 of 3 objects are rigid")
    after = point_motion.residual_need(tensors, names, {1: 1, 2: 2, 3: 1}, settings, there=False).reason
    assert after.endswith("divided into parts: arm (2); 2 of 3 objects are rigid")


SETTINGS = ("train.iterations=240", "residual.trial_steps=250", "identity.iterations=0")


@pytest.fixture(scope="module")
def breathing(tmp_path_factory):
    """A data set with a ball that breathes, the finished run on it, and its scene."""
    data = tiny_datasets.make_dataset(tmp_path_factory.mktemp("breathing"), breath=0.35)
    done = run.train(data.root, tmp_path_factory.mktemp("runs") / "run", tiny_datasets.settings(*SETTINGS))
    return data, done, bake.bake(done)


@pytest.mark.slow
def test_only_the_deforming_object_gets_residuals(breathing):
    _, done, scene = breathing
    tensors = checkpoint.load(done.folder).tensors
    assert set(tensors["residual.owners"].tolist()) == {BALL}
    assert tensors["residual.gains"][BALL - 1] > 0.5 > tensors["residual.gains"][BRICK - 1]
    row = next(row for row in scene.needs if row["name"] == "residuals")
    assert row["decision"] == "on" and "ball (+" in row["reason"] and "1 of 2 objects are rigid" in row["reason"]
    assert set(scene.gaussians.motion_ids[scene.residuals.rows].tolist()) == {BALL}
    assert scene.groups[BRICK].rigid_rms == scene.groups[BRICK].rigid_max == 0
    assert 0.02 < scene.groups[BALL].rigid_rms < scene.groups[BALL].rigid_max < 1


def error_on_the_ball(trainer, data):
    total = 0.0
    for view, drawn in zip(trainer.dataset.train, trainer.views, strict=True):
        with torch.no_grad():
            image = trainer.render(drawn.camera, drawn.t).numpy()
        shown = datasets.load_mask(view) == BALL
        total += ((image - drawn.image / 255)[shown] ** 2).sum()
    return total


@pytest.mark.slow
def test_residuals_improve_the_images_of_a_breathing_object(breathing):
    data, done, _ = breathing
    bent = make(data, *SETTINGS)
    bent.restore(checkpoint.load(done.folder))
    rigid = advance(make(data, *SETTINGS, "needs.residuals=off"), 240)
    assert error_on_the_ball(bent, data) < 0.7 * error_on_the_ball(rigid, data)


@pytest.mark.slow
def test_the_ball_grows_and_shrinks_as_in_the_data(breathing):
    data, _, scene = breathing
    rows = scene.residuals.rows
    arms = scene.gaussians.means[rows] - scene.groups[BALL].pivot
    far = np.linalg.norm(arms, axis=1) > 0.2
    sizes = [np.linalg.norm(arms[far] + scene.residuals.offsets[far, s], axis=1).mean() for s in range(6)]
    true = 1 + 0.35 * np.sin(2 * np.pi * (tiny_datasets.T_MAX - tiny_datasets.OBSERVED) / 0.6)
    assert np.corrcoef(sizes, true)[0, 1] > 0.9


@pytest.mark.slow
def test_the_scene_shows_what_was_trained_and_then_keeps_its_last_shape(breathing):
    data, done, scene = breathing
    trainer = make(data, *SETTINGS)
    trainer.restore(checkpoint.load(done.folder))
    for view, drawn in list(zip(trainer.dataset.train, trainer.views, strict=True))[::5]:
        with torch.no_grad():
            expected = trainer.render(drawn.camera, drawn.t).numpy().clip(0, 1)
        shown = scene_renderer.render_frame(scene, scene_player.Player(scene).frame(view.t), view.camera).color.clip(
            0, 1
        )
        assert (
            -10 * np.log10(np.mean((shown - expected) ** 2)) > 45
        )  # the noise of a track that does not turn is left out
    later = scene_player.Player(scene).frame(scene.t_max + 0.3)
    rows = scene.gaussians.motion_ids == BALL
    gaps = [
        np.linalg.norm(np.diff(m[rows].astype(np.float64), axis=0), axis=1)
        for m in (scene.gaussians.means, later.means)
    ]
    np.testing.assert_allclose(gaps[1], gaps[0], atol=1e-5)
    assert np.array_equal(later.log_scales, scene.gaussians.log_scales)


@pytest.mark.slow
def test_a_scene_may_be_baked_without_residuals(breathing, tmp_path):
    _, done, scene = breathing
    plain = bake.run_bake(done.folder, tmp_path / "plain.r5dgs", None, ["needs.residuals=off"])
    assert plain.residuals is None and plain.groups[BALL].rigid_max == 0
    assert np.array_equal(plain.gaussians.means, scene.gaussians.means)
    row = next(row for row in plain.needs if row["name"] == "residuals")
    assert row["decision"] == "off" and row["reason"].startswith("set off by the user")


FORCED = ("needs.residuals=on", "train.iterations=100", "residual.trial_steps=20")  # tried after 40 steps, and kept
BESIDE = {
    "alone": (),
    "detached": ("identity.training='detached'", "identity.iterations=80", *FORCED),
    "joint": ("identity.training='joint'", "identity.iterations=80", *FORCED),
    "mcmc": ("densify.strategy='mcmc'", "densify_mcmc.start=10", "densify_mcmc.every=10", *FORCED),
}


@pytest.fixture(scope="module", params=BESIDE)
def states(breathing, request):
    """Settings, and states of a run with them: just before residuals are tried, and some steps after."""
    settings = (*SETTINGS, *BESIDE[request.param])
    trainer, found = make(breathing[0], *settings), []
    decision = run.decision_step(trainer)
    for k in (decision - 1, decision + 9, decision + 20):
        found.append(advance(trainer, k).state())
    return settings, found


@pytest.mark.slow
@pytest.mark.parametrize("k", [0, 1])
def test_a_run_with_residuals_resumes_to_the_same_bits(breathing, states, tmp_path, k):
    settings, found = states
    checkpoint.save(tmp_path, found[k])
    trainer = make(breathing[0], *settings)
    trainer.restore(checkpoint.load(tmp_path))
    assert (trainer.motion.residuals is None) == (k == 0)
    last = advance(trainer, found[-1].iteration).state()
    assert trainer.motion.residuals.bodies == ([BRICK, BALL] if "needs.residuals=on" in settings else [BALL])
    assert_same_tensors(last.tensors, found[-1].tensors)
    assert (last.queue, last.running_loss) == (found[-1].queue, found[-1].running_loss)


def test_the_user_can_enable_residuals_for_every_object(tiny):
    trainer = advance(make(tiny, "train.iterations=60", "needs.residuals=on"), 30)
    assert trainer.motion.residuals.bodies == [BRICK, BALL]
    assert "residual" in {group["name"] for group in trainer.optimizer.param_groups}
    assert trainer.state().tensors["residual.values"].any()
