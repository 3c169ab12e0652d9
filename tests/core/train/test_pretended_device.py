"""On a device, a run gives the results of the CPU bit for bit, and hardly ever waits for the device."""

import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.train import finish, losses, step_graphs
from r5dgs_core.train.trainer import Trainer
from tests.support import pretended_device, tiny_datasets

pytestmark = pytest.mark.heavy

STEPS, ROUND = 8, 6  # steps of a run, and the one after which it densifies
COMMON = ("train.iterations=60", "densify.start=6", "densify.every=6")
FIELD = ("train.representation=field", "field.place_steps=2", "field.trd_steps=2", "field.trd_every=0")
RUNS = {
    "still": ("needs.tracks=off",),
    "tracks": (),
    "tracks, harmonics": ("train.sh_degree=1",),
    "tracks, identities with the colours": ("identity.training=joint",),
    "tracks, 3DGS": ("densify.strategy=default", "densify_default.start=0", "densify_default.every=6"),
    "tracks, MCMC": ("densify.strategy=mcmc", "densify_mcmc.start=0", "densify_mcmc.every=6"),
    "field": FIELD,
    "field of all": (*FIELD, "field.movers=all", "train.sh_degree=1"),
}


def run(data, overrides, device):
    """Train on a device; return the trainer, the waits of each step, and the state at the end."""
    trainer = Trainer(datasets.read(data.root), tiny_datasets.settings(*COMMON, *overrides))
    trainer._begin_on(torch.device(device))
    trainer.motion.begin(trainer.gaussians, trainer.generator)
    trainer.iteration = 1
    chosen = (0, len(trainer.views) // 2, len(trainer.views) - 1)
    trainer.curriculum.draw = lambda iteration, generator: chosen[iteration % 3]
    with torch.no_grad():
        for k in chosen:  # fills the caches
            view = trainer.views[k]
            losses.photometric(trainer.render(view.camera, view.t), trainer.targets.of(k), 0.2)
    waits = []
    for _ in range(STEPS):
        with pretended_device.record() as found:
            trainer.step()
        waits.append(found)
    return trainer, waits


@pytest.mark.default_cases("tracks")
@pytest.mark.parametrize("name", RUNS)
def test_a_run_on_a_device_is_that_of_the_cpu_and_does_not_wait(tiny, name):
    with pretended_device.twins():
        plain, _ = run(tiny, RUNS[name], "cpu")
    with pretended_device.mode():
        there, waits = run(tiny, RUNS[name], pretended_device.DEVICE)
        state = there.state()
    assert len(plain.gaussians) != 1000 or "still" in name
    for key, expected in plain.state().tensors.items():
        assert torch.equal(state.tensors[key], expected), key
    assert there.running_loss == plain.running_loss
    again = 1 if name == "field" else 0  # it looks up the moved Gaussians after they have changed
    for step, found in enumerate(waits, start=2):
        assert found.total() <= {ROUND: 3, ROUND + 1: again}.get(step, 0), (step, found)


@pytest.mark.slow
def test_labels_and_identities_of_the_end_are_those_of_the_cpu(tiny):
    settings = ("identity.iterations=6", "train.log_every=6")
    with pretended_device.twins():
        plain, _ = run(tiny, settings, "cpu")
        expected = finish.final_tensors(plain, lambda event: None)
    with pretended_device.mode():
        there, _ = run(tiny, settings, pretended_device.DEVICE)
        with pretended_device.record() as waits:
            found = finish.final_tensors(there, lambda event: None)
    assert {"labels", "identities", "classifier.weight"} <= set(expected) and set(found) == set(expected)
    for key, value in expected.items():
        assert torch.equal(found[key], value), key
    assert not [place for place, count in waits.items() if "identity" in place and count >= 6]  # not in each step


GRAPHS = {
    "tracks": (("densify.start=12", "curriculum.first=0", "curriculum.grow=0"), 2, ()),  # with roughness and without
    "field": (  # paths through the TRD and others
        (*FIELD, "densify.start=12", "field.trd_share=0.5"),
        2,
        ("field.layers.1.weight", "trd.layers.1.weight"),
    ),
}


@pytest.mark.slow
@pytest.mark.default_cases("tracks")
@pytest.mark.parametrize("name", GRAPHS)
def test_steps_as_graphs_are_the_same_steps(tiny, name, monkeypatch):
    settings, kinds, weights = GRAPHS[name]
    monkeypatch.setattr(step_graphs, "BEFORE", 2)
    taken = []
    step = step_graphs.StepGraphs.step
    monkeypatch.setattr(step_graphs.StepGraphs, "step", lambda *given: taken.append(1) or step(*given))
    states = []
    for graphs in ("true", "false"):
        with pretended_device.mode():
            trainer, waits = run(tiny, (*settings, f"train.graphs={graphs}"), pretended_device.DEVICE)
            states.append(trainer.state())
        if graphs == "true":
            assert len(taken) >= 4 and len(trainer._graphs._graphs) == kinds
            assert waits[-1].total() == 0, waits[-1]
    assert len(taken) < STEPS
    assert states[0].running_loss == pytest.approx(states[1].running_loss, rel=1e-6)
    for key in ("gaussians.means", "gaussians.sh", *weights):
        # Rates are float32 in a graph. Rotations of round Gaussians amplify rounding.
        torch.testing.assert_close(states[0].tensors[key], states[1].tensors[key], atol=5e-6, rtol=1e-5)
