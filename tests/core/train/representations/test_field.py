"""The representation `field`: its motion, its fits, its training and its scene."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from r5dgs_core.bake import bake
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import ConfigError
from r5dgs_core.model.trd import MotionState
from r5dgs_core.motion import rotations
from r5dgs_core.playback import modes, residuals, scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import validation
from r5dgs_core.train import checkpoint, run
from r5dgs_core.train.representations import field, field_fitting
from r5dgs_core.train.representations.field_motion import Clock
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

FIELD = (
    "train.representation='field'",
    "field.place_steps=60",
    "field.trd_steps=20",
    "field.width=64",
    "train.iterations=120",
)


# Motion is hardly fitted before the first image: for properties that do not depend on the quality of the fit.
UNFITTED = ("field.place_steps=3", "field.trd_steps=3")


def make(data, *overrides) -> Trainer:
    return Trainer(datasets.read(data.root), tiny_datasets.settings(*FIELD, *UNFITTED, *overrides))


def mean_loss(trainer: Trainer) -> float:
    with torch.no_grad():
        errors = [
            (trainer.render(view.camera, view.t) - torch.from_numpy(view.image) / 255).abs().mean()
            for view in trainer.views
        ]
    return float(torch.stack(errors).mean())


@pytest.fixture(scope="module")
def made(tiny, tmp_path_factory):
    """A finished run of the field."""
    folder = tmp_path_factory.mktemp("runs") / "field"
    return run.train(tiny.root, folder, tiny_datasets.settings(*FIELD))


@pytest.fixture(scope="module")
def scene(made, tiny):
    return bake.bake(tiny_datasets.as_trained(made), datasets.read(tiny.root))


def test_times_are_normalised_to_the_unit_interval_unless_they_are_in_it():
    assert Clock.of(np.linspace(0, 0.75, 5))(0.3) == 0.3
    seconds = Clock.of(np.array([12.0, 15.0, 20.0]))
    assert seconds(12.0) == 0 and seconds(20.0) == 1


@pytest.mark.slow
def test_training_brings_the_images_closer(made):
    trainer = Trainer(datasets.read(made.dataset_root), made.config)
    before = mean_loss(trainer)
    trainer.restore(checkpoint.load(made.folder))
    assert mean_loss(trainer) < 0.8 * before


def test_gaussians_without_object_stay_still_to_the_bit(tiny):
    trainer = make(tiny)
    for _ in range(5):
        trainer.step()
    pinned = trainer.gaussians.motion_ids == 0
    camera = trainer.views[0].camera
    with torch.no_grad():
        for t in (0.0, 0.31, 1.0):
            splats = trainer.splats(camera, t)
            assert torch.equal(splats.means[pinned], trainer.gaussians.means[pinned])
    everything = make(tiny, "field.movers='all'")
    assert len(everything.motion.movers(everything.gaussians)) == len(everything.gaussians)


@pytest.mark.slow
def test_positions_from_masks_are_learned_before_the_first_image(tiny):
    trainer = make(tiny, "field.place_steps=120")
    motion = trainer.motion
    motion.begin(trainer.gaussians, trainer.generator)
    rows = (trainer.gaussians.motion_ids == tiny_datasets.BALL).nonzero()[:, 0]
    means = trainer.gaussians.means.detach()[rows]
    with torch.no_grad():
        moved = (motion.motion.at(means, 0.6).offsets - motion.motion.at(means, 0.15).offsets).mean(0)
    scale = trainer.normalization.scale
    expected = (tiny.center(tiny_datasets.BALL, 0.6) - tiny.center(tiny_datasets.BALL, 0.15)) / scale
    np.testing.assert_allclose(moved.numpy(), expected, atol=0.12)


def test_only_the_true_twist_also_moves_the_other_gaussians_of_a_body():
    """Velocities of a spinning body can be put into translations that depend on the place; the cross loss sees that."""
    draw = torch.Generator().manual_seed(0)
    motion = field._motion_of(np.linspace(0, 0.75, 6), tiny_datasets.settings(*FIELD))
    spin, span = torch.tensor([0.0, 0.0, 1.5]), 0.02
    begin = torch.randn(200, 3, generator=draw) * 0.3 + torch.tensor([1.0, 0.5, 0.2])
    goal = rotations.rotate(rotations.rotvecs_to_quats(spin * span), begin)
    nothing = torch.zeros_like(begin)
    true = MotionState(nothing, spin.expand_as(begin), nothing, nothing)
    gauge = MotionState((goal - begin) / span, nothing, nothing, nothing)
    groups = torch.arange(200) % 2
    for state in (true, gauge):
        own, _ = motion.carry(begin, state, span, motion.step)
        torch.testing.assert_close(own, goal, atol=1e-4, rtol=0)
    crossed = [
        float(field_fitting.cross_twist(motion, begin, goal, state, span, groups, draw)) for state in (true, gauge)
    ]
    assert crossed[0] < 1e-8 and crossed[1] > 1e-5


@pytest.mark.default_cases("overrides1")
@pytest.mark.parametrize("overrides", [(), ("field.tracks_share=0.3", "field.distill_steps=20", "train.iterations=40")])
def test_a_resumed_field_ends_with_the_same_numbers(tiny, tmp_path, overrides):
    extra = ("field.variant='r5dgs_extra'", "identity.training='joint'", "losses.rigid_start=0.1", *overrides)
    reference = make(tiny, *extra)
    states = {}
    for k in range(30):
        if k in (7, 16):
            states[k] = reference.state()
        reference.step()
    expected = reference.state()
    for k, state in states.items():
        checkpoint.save(tmp_path, state)
        trainer = make(tiny, *extra)
        trainer.restore(checkpoint.load(tmp_path))
        while trainer.iteration < 30:
            trainer.step()
        for name, tensor in trainer.state().tensors.items():
            assert torch.equal(tensor, expected.tensors[name]), (k, name)


@pytest.mark.slow
def test_a_field_that_starts_from_tracks_has_their_motion(tiny):
    trainer = make(
        tiny, "field.tracks_share=0.98", "field.distill_steps=200", "train.iterations=61", "densify.start=1000"
    )
    while trainer.iteration < 60:
        trainer.step()
    tracks, view = trainer.motion.tracks, trainer.views[3]
    before = trainer.render(view.camera, view.t).detach()
    trainer.step()
    assert trainer.motion.name == "field"
    rows = (trainer.gaussians.motion_ids == tiny_datasets.BRICK).nonzero()[:, 0]
    means = trainer.gaussians.means.detach()[rows]
    home, there = tracks.poses(float(tracks.times[trainer.first_time])), tracks.poses(0.6)
    with torch.no_grad():
        moved = (means + trainer.motion.motion.at(means, 0.6).offsets).mean(0)
        center = tracks.group_centers()[tiny_datasets.BRICK]
        g = tiny_datasets.BRICK
        turn = rotations.multiply(there.quats[g], rotations.conjugate(home.quats[g]))
        goal = rotations.rotate(turn, means - center - home.displacements[g]).mean(0) + center + there.displacements[g]
    torch.testing.assert_close(moved, goal, atol=0.05, rtol=0)
    after = trainer.render(view.camera, view.t).detach()
    assert float((after - before).abs().mean()) < 0.03


@pytest.mark.slow
def test_the_baked_scene_is_valid_and_renders_like_the_trained_state(made, scene):
    validation.check(scene, "field")
    trainer = Trainer(datasets.read(made.dataset_root), made.config)
    trainer.restore(checkpoint.load(made.folder))
    assert scene.t_max == pytest.approx(0.7)
    assert {mode.partition("/")[0] for mode in scene_player.modes(scene)} == set(modes.MODES)
    assert [g.role for g in scene.groups][:3] == ["pinned", "body", "body"] and scene.residuals is not None
    pairs = zip(trainer.dataset.train, trainer.views, strict=True)
    for view, trained_view in [pair for pair in pairs if pair[0].t < scene.t_max][::5]:
        with torch.no_grad():
            expected = trainer.render(trained_view.camera, trained_view.t).numpy()
        shown = scene_renderer.render_frame(scene, scene_player.Player(scene).frame(view.t), view.camera).color
        assert np.abs(shown.clip(0, 1) - expected.clip(0, 1)).mean() < 2e-3


@pytest.mark.slow
def test_mode_standard_follows_the_trained_dynamics(made, scene):
    trainer = Trainer(datasets.read(made.dataset_root), made.config)
    trainer.restore(checkpoint.load(made.folder))
    for t in (0.75, 0.9):
        camera = trainer.views[0].camera
        with torch.no_grad():
            splats = trainer.splats(camera, t)
        world = np.sort(trainer.normalization.points_to_world(splats.means.numpy()), axis=0)
        played = np.sort(scene_player.Player(scene, "standard").frame(t).means, axis=0)
        np.testing.assert_allclose(played, world, atol=2e-3)


def test_without_masks_the_networks_move_everything_at_first(tmp_path):
    data = tiny_datasets.make_dataset(tmp_path, masks=False)
    trainer = make(data, "train.iterations=30")
    before = mean_loss(trainer)
    trainer.step()
    assert len(trainer.motion.movers(trainer.gaussians)) == len(trainer.gaussians)
    while not trainer.done:
        trainer.step()
    assert mean_loss(trainer) < before


PAPER = (
    "field.variant='r5dgs_extra'",
    "identity.training='joint'",
    "identity.spatial=2.0",
    "identity.majority=0.5",
    "losses.rigid_start=0",
    "train.iterations=100",
)


def six_steps(data, *overrides):
    trainer = make(data, *PAPER, *overrides)
    for _ in range(6):
        trainer.step()
    return trainer.state().tensors


@pytest.fixture(scope="module")
def with_all(tiny):
    """Tensors of a run with all losses of the paper."""
    return six_steps(tiny)


@pytest.mark.parametrize(
    ("off", "still"),
    [("losses.rigid=0", "rigid"), ("identity.spatial=0.0", "spatial"), ("identity.majority=0.0", "majority")],
)
def test_each_loss_of_the_paper_changes_the_run(tiny, with_all, off, still):
    a, b = with_all, six_steps(tiny, off)
    geometry = ("gaussians.means", "field.layers.0.weight")
    semantics = ("gaussians.identities", "identity.classifier.weight")
    changed = geometry if still == "rigid" else semantics
    assert all(not torch.equal(a[name], b[name]) for name in changed)


def test_the_form_of_the_rigidity_loss_changes_the_run_and_is_absolute_by_default(tiny):
    extra = ("field.variant='r5dgs_extra'", "losses.rigid_start=0", "train.iterations=50")
    default, absolute, squared = (
        make(tiny, *extra, *form) for form in ((), ("losses.rigid_form=absolute",), ("losses.rigid_form=squared",))
    )
    for _ in range(4):
        for trainer in (default, absolute, squared):
            trainer.step()
    default, absolute, squared = (t.state().tensors["field.layers.0.weight"] for t in (default, absolute, squared))
    assert torch.equal(default, absolute) and not torch.equal(absolute, squared)


@pytest.mark.parametrize("size", ["complex", "light", "small"])
def test_the_width_replaces_that_of_all_hidden_layers_at_the_same_depth(size):
    times = np.linspace(0, 0.75, 6)
    usual = field._motion_of(times, tiny_datasets.settings(*FIELD, f"field.size='{size}'"))
    other = field._motion_of(times, tiny_datasets.settings(*FIELD, f"field.size='{size}'", "field.width=48"))
    for ours, theirs in ((other.field, usual.field), (other.trd, usual.trd)):
        assert len(ours.layers) == len(theirs.layers)
        assert {layer.out_features for layer in ours.layers} == {48}


def test_variants_differ_by_one_key(tiny):
    plain, extra = (
        make(tiny, f"field.variant='{name}'", "losses.rigid_start=0", "train.iterations=50")
        for name in ("r5dgs", "r5dgs_extra")
    )
    for _ in range(4):
        plain.step()
        extra.step()
    assert not torch.equal(
        plain.state().tensors["field.layers.0.weight"], extra.state().tensors["field.layers.0.weight"]
    )


def test_gradients_of_the_twist_loss_are_right_in_double_precision():
    draw = torch.Generator().manual_seed(0)
    motion = field._motion_of(np.linspace(0, 0.75, 6), tiny_datasets.settings(*FIELD))
    begin, goal, *state = torch.randn(6, 6, 3, generator=draw, dtype=torch.float64).unbind(0)
    state = [x.requires_grad_(True) for x in state]
    groups = torch.tensor([1, 1, 1, 2, 2, 2])

    def loss(*parts: torch.Tensor) -> torch.Tensor:
        same = torch.Generator().manual_seed(1)
        return field_fitting.cross_twist(motion, begin, goal, MotionState(*parts), 0.2, groups, same)

    assert torch.autograd.gradcheck(loss, state)


def test_needs_tracks_off_disables_all_motion(tiny):
    trainer = make(tiny, "needs.tracks=off", "train.iterations=8")
    while not trainer.done:
        trainer.step()
    with torch.no_grad():
        early, late = (trainer.splats(trainer.views[0].camera, t).means for t in (0.0, 0.9))
    assert torch.equal(early, late) and torch.equal(early, trainer.gaussians.means)


def test_the_paper_trains_the_canonical_state_first(tiny):
    trainer = make(tiny, "field.warm_up=6", "train.iterations=20")
    start = {n: p.detach().clone() for n, p in trainer.motion.params.items()}
    for _ in range(6):
        trainer.step()
    assert all(torch.equal(start[n], p) for n, p in trainer.motion.params.items() if n != "light")
    state = trainer.state()
    other = make(tiny, "field.warm_up=6", "train.iterations=20")
    other.restore(state)
    for _ in range(2):
        trainer.step()
        other.step()
    assert any(not torch.equal(start[n], p) for n, p in trainer.motion.params.items())
    assert all(torch.equal(p, other.motion.params[n]) for n, p in trainer.motion.params.items())


@pytest.mark.parametrize("horizon", [-0.1, 0.9])
def test_a_horizon_outside_the_observed_times_is_refused(tiny, horizon):
    settings = config.from_dict({"train": {"representation": "field"}})
    with pytest.raises(ConfigError, match="field.horizon"):
        field._motion_of(
            np.linspace(0, 0.75, 6),
            dataclasses.replace(settings, field=dataclasses.replace(settings.field, horizon=horizon)),
        )


@pytest.mark.slow
def test_harmonics_rotate_with_their_moving_gaussians(tiny, tmp_path):
    """The scene plays colours that depend on the view as the trainer draws them, also of bodies that turned."""
    settings = tiny_datasets.settings(
        *FIELD,
        "field.trd_steps=3",
        "train.sh_degree=2",
        "train.shading=false",
        "train.iterations=6",
        "identity.iterations=0",
    )
    made = run.train(tiny.root, tmp_path / "run", settings)
    state = checkpoint.load(made.folder)
    rest = state.tensors["gaussians.sh_rest"]
    rest += 0.2 * torch.randn(rest.shape, generator=torch.Generator().manual_seed(1))
    checkpoint.save(made.folder, state)
    scene = bake.bake(tiny_datasets.as_trained(made), datasets.read(tiny.root))
    trainer = Trainer(datasets.read(tiny.root), made.config)
    trainer.restore(checkpoint.load(made.folder))
    view = trainer.views[0]
    camera = trainer.dataset.train[0].camera
    with torch.no_grad():
        expected = trainer.render(view.camera, scene.t_max).numpy()
    shown = scene_renderer.render_frame(scene, scene_player.Player(scene).frame(scene.t_max), camera).color
    assert np.abs(shown.clip(0, 1) - expected.clip(0, 1)).mean() < 2e-5


def test_at_a_single_time_a_field_is_a_still_scene(tiny):
    known = datasets.read(tiny.root)
    once = dataclasses.replace(known, train=tuple(view for view in known.train if view.t == 0))
    trainer = Trainer(once, tiny_datasets.settings(*FIELD, *UNFITTED, "train.iterations=10"))
    while not trainer.done:
        trainer.step()
    with torch.no_grad():
        early, late = (trainer.splats(trainer.views[0].camera, t).means for t in (-1.0, 50.0))
    assert torch.equal(early, late) and torch.isfinite(late).all()


@pytest.mark.slow
def test_disabled_motion_does_not_return_as_residuals(made, scene, tiny):
    def travel(scene) -> float:
        mine = scene.gaussians.object_ids == tiny_datasets.BRICK
        early, late = (scene_player.Player(scene).frame(t).means[mine].mean(0) for t in (0.0, scene.t_max))
        return float(np.linalg.norm(late - early))

    changed = dataclasses.replace(made, config=made.config.override(("needs.tracks=off",)))
    assert travel(scene) > 0.3
    assert travel(bake.bake(changed, datasets.read(tiny.root))) < 1e-6


@pytest.mark.slow
def test_baking_a_field_regroups_gaussians_by_motion_and_stores_their_number(made, scene, tiny):
    """A third of the brick was created for the ball; only motion shows where these Gaussians belong."""
    data, state = datasets.read(tiny.root), checkpoint.load(made.folder)
    ids = state.tensors["gaussians.motion_ids"]
    wrong = (ids == tiny_datasets.BRICK).nonzero()[::3, 0]
    before = ids.clone()
    ids[wrong] = tiny_datasets.BALL
    motion = field.FieldRepresentation.observed_motion(
        state.tensors,
        state.tensors["object_ids"].numpy(),
        state.observed.numpy(),
        state.tensors["labels"].numpy(),
        made.config,
    )
    assert motion.motion_ids is not None and motion.moves is not None
    right = motion.motion_ids[wrong.numpy()] == tiny_datasets.BRICK
    assert right.mean() > 0.6 and motion.moves.to_bodies >= right.sum()
    state.tensors["labels"][wrong[:9]] = 0  # halo: the masks call it background
    left = field.FieldRepresentation.observed_motion(
        state.tensors,
        state.tensors["object_ids"].numpy(),
        state.observed.numpy(),
        state.tensors["labels"].numpy(),
        made.config.override(("needs.regrouping=off",)),
    )
    assert left.moves is None and left.motion_ids is not None
    np.testing.assert_array_equal(left.motion_ids[wrong.numpy()], tiny_datasets.BALL)
    ids[:] = before
    counts = scene.provenance["regrouping"]
    assert counts["unexplained"] == len(residuals.unexplained(scene)) and counts["moving"] > 100
    ungrouped = dataclasses.replace(made, config=made.config.override(("needs.regrouping=off",)))
    kept = bake.bake(tiny_datasets.as_trained(ungrouped), data)
    assert "set off by the user" in next(row["reason"] for row in kept.needs if row["name"] == "regrouping")
    assert "regrouping" not in kept.provenance
