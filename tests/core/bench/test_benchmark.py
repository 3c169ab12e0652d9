"""A benchmark trains and measures only missing runs, and continues after failures."""

import contextlib
import dataclasses
import json
import shutil
import signal

import numpy as np
import pytest
import torch

from r5dgs_core.bake import bake
from r5dgs_core.bench import benchmark, cases, playback_speed, process, variants
from r5dgs_core.cli import exit_status, main
from r5dgs_core.config import config as configs
from r5dgs_core.config import presets
from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import CheckpointError, ConfigError, DatasetError, Interrupted, TrainingError
from r5dgs_core.evaluation import evaluate
from r5dgs_core.playback import modes, scene_player
from r5dgs_core.render import machine
from r5dgs_core.scene import scene_file
from r5dgs_core.train import checkpoint, run_folder
from tests.support import lpips_weights, tiny_datasets

pytestmark = pytest.mark.heavy

OVERRIDES = (*tiny_datasets.SETTINGS, "train.iterations=20", "train.log_every=1", "identity.iterations=5")


def plan_for(tiny, out, **changes):
    return cases.BenchmarkRequest(
        **{"scenes": (tiny.root,), "out": out, "variants": ("tracks",), "overrides": OVERRIDES, **changes}
    )


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def made(tiny, tmp_path_factory):
    """A finished benchmark: its plan, its case and the result."""
    plan = plan_for(tiny, tmp_path_factory.mktemp("bench"))
    (case,) = cases.make(plan)
    return plan, case, benchmark.run_bench(plan, progress_kind="none")


@pytest.fixture(scope="module")
def resumed(tiny, tmp_path_factory):
    """A benchmark that was stopped at its first step and resumed: its case, the records in between, the result."""
    plan = plan_for(tiny, tmp_path_factory.mktemp("stopped"))
    (case,) = cases.make(plan)

    @contextlib.contextmanager
    def stopping(kind):
        yield lambda event: signal.raise_signal(signal.SIGTERM) if event["event"] == "step" else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "make_progress", stopping)
        with pytest.raises(Interrupted, match="same command"):
            benchmark.run_bench(plan)
    between = cases.read_record(case), checkpoint.load(case.run)
    return case, between, benchmark.run_bench(plan, progress_kind="none")


@pytest.mark.slow
def test_a_stopped_benchmark_keeps_the_progress_of_training(resumed):
    _, (record, state), _ = resumed
    assert not state.finished and state.iteration > 0
    assert [sitting["status"] for sitting in record["sittings"]] == [process.STOPPED]
    assert "measured" not in record


@pytest.mark.slow
def test_the_cost_of_a_case_adds_up_over_its_sessions(resumed):
    case, (between, _), result = resumed
    first, second = cases.read_record(case)["sittings"]
    assert first == between["sittings"][0] and second["status"] == 0
    (found,) = result["results"]
    assert found["train"]["cpu_seconds"] == pytest.approx(first["cpu_seconds"] + second["cpu_seconds"], abs=2e-3)
    assert found["train"]["peak_mb"] == max(first["peak_mb"], second["peak_mb"]) > 50


@pytest.mark.slow
def test_a_record_holds_the_results_of_evaluation_and_playback(made, tiny):
    plan, case, result = made
    (found,) = result["results"]
    assert (found["scene"], found["representation"], found["variant"], found["mode"], found["seed"]) == (
        tiny.root.name,
        "tracks",
        "tracks",
        "rigid",
        0,
    )
    assert set(found["splits"]["test"]) == set(evaluate.METRICS)
    assert found["splits"]["test"]["images"] == 4 and found["splits"]["val"]["images"] == 2
    assert found["playback"]["frames"] >= playback_speed.MIN_FRAMES
    assert found["playback"]["fps"] == pytest.approx(1e3 / found["playback"]["ms_frame"])
    assert found["gaussians"] == len(scene_file.read(case.beside(".r5dgs")).gaussians.means)
    assert main.main(["evaluate", str(case.run), "--progress", "none"]) == 0
    alone = json.loads((case.run / run_folder.EVALUATION_FILE).read_text())
    assert alone["splits"]["test"]["rigid"]["psnr"] == pytest.approx(found["splits"]["test"]["psnr"], abs=1e-6)
    assert json.loads((plan.out / benchmark.RESULT_FILE).read_text()) == result


@pytest.mark.slow
def test_runs_with_other_masks_than_those_of_the_data_set_are_measured_and_kept(tiny, tmp_path):
    plan = plan_for(tiny, tmp_path, overrides=(*OVERRIDES, "data.masks=none", "discovery.iterations=0"))
    for _ in range(2):
        (found,) = benchmark.run_bench(plan, progress_kind="none")["results"]
        assert found["splits"]["val"]["images"] == 2


@pytest.mark.slow
def test_finished_runs_are_neither_trained_nor_measured_again(made, monkeypatch):
    plan, case, result = made
    before = contents(case.run)
    monkeypatch.setattr(process, "run", None)
    monkeypatch.setattr(playback_speed, "measure", None)
    assert benchmark.run_bench(plan, progress_kind="none")["results"] == result["results"]
    assert contents(case.run) == before


@pytest.mark.slow
def test_remeasure_keeps_the_run_and_measures_it_again(made, tmp_path, monkeypatch):
    plan, case, result = made
    torch.save(lpips_weights.tensors("alex"), tmp_path / "alex.pth")
    plan = dataclasses.replace(plan, lpips=(tmp_path / "alex.pth",))
    monkeypatch.setattr(process, "run", None)
    monkeypatch.setattr(
        playback_speed, "measure", lambda *_: {"rigid": {**result["results"][0]["playback"], "fps": 123.0}}
    )
    again = benchmark.run_bench(plan, remeasure=True, progress_kind="none")
    assert again["results"][0]["playback"]["fps"] == 123.0
    (one,), (other,) = again["results"], result["results"]
    assert one["train"] == other["train"]
    assert one["splits"]["test"]["lpips"] > 0 and other["splits"]["test"]["lpips"] is None
    assert all(one["splits"][split]["psnr"] == other["splits"][split]["psnr"] for split in ("val", "test"))


@pytest.mark.slow
def test_a_run_is_measured_in_every_mode_that_its_scene_has(made, tiny, tmp_path, monkeypatch):
    plan, _, _ = made
    shutil.copytree(plan.out, tmp_path / "out")
    plan = plan_for(tiny, tmp_path / "out", modes=("rigid",))
    plain, before = bake.bake, benchmark.run_bench(plan, remeasure=True, progress_kind="none")["results"]

    def with_dynamics(run, dataset):
        scene = plain(run, dataset)
        still = np.zeros((len(scene.gaussians.means), 12), np.float32)
        return scene.with_arrays(dynamics=still, canonical_means=scene.gaussians.means)

    monkeypatch.setattr(bake, "bake", with_dynamics)
    result = benchmark.run_bench(plan_for(tiny, plan.out), progress_kind="none")["results"]
    assert [record["mode"] for record in result] == list(modes.MODES)
    assert result[0] == before[0], "what was measured before stays"
    # Motion past t_max stops in the modes that read the dynamics, which are none; up to t_max all modes are the same.
    rigid, hybrid, standard, literal = (record["splits"] for record in result)
    assert hybrid["test"]["psnr"] == rigid["test"]["psnr"], "there is nothing that no group's motion explains"
    assert standard["val"]["psnr"] == literal["val"]["psnr"] == pytest.approx(rigid["val"]["psnr"])
    assert standard["test"]["psnr"] == literal["test"]["psnr"] != pytest.approx(rigid["test"]["psnr"])


@pytest.mark.slow
def test_a_case_that_fails_is_reported_and_the_others_continue(made, tiny, capsys):
    plan, case, _ = made
    blocked = case.run.with_name("tracks_seed1")
    blocked.write_text("mine")
    arguments = ["bench", str(tiny.root), "--out", str(plan.out), "--variants", "tracks", "--seeds", "1", "0"]
    options = [text for override in OVERRIDES for text in ("--set", override)]
    try:
        assert main.main([*arguments, *options]) == 3
        printed = capsys.readouterr()
        assert len(printed.err.splitlines()) == 1 and "1 of 2 runs failed" in printed.err
        result = json.loads((plan.out / benchmark.RESULT_FILE).read_text())
        assert [record["seed"] for record in result["results"]] == [0]
        assert [(f["variant"], f["seed"]) for f in result["failures"]] == [("tracks", 1)]
        assert "is not a run folder" in result["failures"][0]["error"]
        assert result["failures"][0]["error"] in (plan.out / benchmark.TABLES_FILE).read_text()
        assert f"{result['results'][0]['splits']['test']['psnr']:.2f}" in printed.out
        assert blocked.read_text() == "mine"
    finally:
        blocked.unlink()


@pytest.mark.slow
def test_a_fault_in_one_case_does_not_affect_the_others(tiny, tmp_path, monkeypatch, made):
    _, _, result = made

    def run_case(plan, case, remeasure, progress):
        if case.seed == 0:
            raise ZeroDivisionError("by design")
        return result["results"]

    monkeypatch.setattr(benchmark, "run_case", run_case)
    with pytest.raises(TrainingError, match="1 of 2 runs failed.*ZeroDivisionError: by design"):
        benchmark.run_bench(plan_for(tiny, tmp_path, seeds=(0, 1)), progress_kind="none")
    assert len(json.loads((tmp_path / benchmark.RESULT_FILE).read_text())["results"]) == 1


@pytest.mark.slow
def test_a_record_stores_the_machines_of_training_and_measurement(made):
    _, case, result = made
    (found,) = result["results"]
    assert found["machine"] == benchmark.machine() and found["machine"]["cores"] >= 1
    assert found["trained_on"]["torch_threads"] == 1 and found["trained_on"]["versions"] == machine.versions()
    assert {**machine.describe(), **found["trained_on"]} == found["trained_on"]
    assert cases.read_record(case)["measured"]["modes"]["rigid"]["machine"] == found["machine"]


@pytest.mark.slow
def test_results_measured_elsewhere_keep_their_machine(made, monkeypatch):
    plan, _, result = made
    monkeypatch.setattr(benchmark, "machine", lambda: {"processor": "another"})
    (found,) = benchmark.run_bench(plan, progress_kind="none")["results"]
    assert found["machine"] == result["results"][0]["machine"]


@pytest.mark.slow
def test_a_finished_run_of_other_data_is_refused_before_anything_is_done(made, tiny, tmp_path):
    plan, _, _ = made
    root = tmp_path / tiny.root.name
    shutil.copytree(tiny.root, root)
    assert len(cases.make(plan_for(tiny, plan.out, scenes=(root,)))) == 1, "the same data in another place"
    path = root / "transforms_val.json"
    path.write_text(path.read_text() + " ")
    with pytest.raises(CheckpointError, match=r"tracks_seed0: was trained on other data.*restore the data.*--out"):
        cases.make(plan_for(tiny, plan.out, scenes=(root,)))


@pytest.mark.slow
def test_a_run_started_with_other_settings_is_refused_before_anything_is_done(made, tiny):
    plan, case, _ = made
    before = contents(plan.out)
    with pytest.raises(ConfigError, match="train.iterations = 20, expected 30"):
        cases.make(plan_for(tiny, plan.out, overrides=(*OVERRIDES, "train.iterations=30")))
    assert contents(plan.out) == before and case.run.is_dir()


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({"variants": ("6dgs",)}, ConfigError, "--variants 6dgs"),
        ({"modes": ("wobbly",)}, ConfigError, "--modes wobbly"),
        ({"seeds": (-1,)}, ConfigError, "train.seed"),
        ({"overrides": ("losses.sim=1",)}, ConfigError, "did you mean 'ssim'"),
        ({"preset": "nonsense"}, ConfigError, "--preset nonsense"),
    ],
)
def test_an_impossible_plan_is_refused_at_once(tiny, tmp_path, changes, kind, words):
    with pytest.raises(kind, match=words):
        cases.make(plan_for(tiny, tmp_path / "out", **changes))
    assert not (tmp_path / "out").exists()


def test_scenes_are_checked_before_anything_is_trained(tiny, tmp_path):
    with pytest.raises(DatasetError, match="nowhere"):
        cases.make(plan_for(tiny, tmp_path, scenes=(tiny.root, tmp_path / "nowhere")))
    with pytest.raises(ConfigError, match="are both called"):
        cases.make(plan_for(tiny, tmp_path, scenes=(tiny.root, tiny.root)))


def test_cases_run_seed_by_seed_and_their_variants_override_the_users_settings(tiny, tmp_path):
    overrides = ("train.representation=tracks", "train.seed=7", "train.probe_every=9")
    made = cases.make(plan_for(tiny, tmp_path, variants=("r5dgs", "tracks"), seeds=(0, 1), overrides=overrides))
    assert [(case.seed, case.variant) for case in made] == [(0, "r5dgs"), (0, "tracks"), (1, "r5dgs"), (1, "tracks")]
    settings = configs.load(None, made[2].overrides)
    assert (settings.train.representation, settings.field.variant, settings.train.seed) == ("field", "r5dgs", 1)
    assert settings.train.probe_every == 9
    assert len({case.run for case in made}) == 4


@pytest.mark.parametrize("preset", [None, *presets.PRESETS])
def test_every_preset_can_be_benchmarked_and_the_method_is_the_same_in_all(tiny, tmp_path, preset):
    made = cases.make(cases.BenchmarkRequest((tiny.root,), tmp_path, preset=preset))
    found = {case.variant: configs.load(None, case.overrides, preset) for case in made}
    assert tuple(found) == variants.DEFAULT_VARIANTS
    for name in ("r5dgs", "r5dgs_extra"):
        identity = found[name].identity
        assert identity.training == "joint"
        scale = 1.0 if preset == "paper" else 0.05
        assert (identity.weight, identity.spatial) == (scale, 2 * scale), name
    assert found["r5dgs_extra"].identity.majority == 0.5 * scale
    assert found["r5dgs_extra"].losses.rigid_form == "squared"
    for name in ("from_tracks", "tracks"):
        config = found[name]
        assert (config.init.placement, config.curriculum.start, config.curriculum.stages) == ("scene", "best", 0)
        assert config.train.shading and config.train.shadows
    assert (found["from_tracks"].field.movers, found["from_tracks"].field.tracks_share) == ("labelled", 0.4)
    plain = found["tracks"]
    assert (plain.densify.strategy, plain.identity.training, plain.identity.rate) == ("share", "after", 0.01)
    assert plain.rates == configs.Config().rates
    assert plain.train.iterations == configs.load(None, (), preset).train.iterations


def test_user_overrides_replace_the_exceptions_of_a_preset_for_tracks(tiny, tmp_path):
    overrides = ("train.shading=false", "identity.training=off", "identity.weight=0.3")
    made = cases.make(cases.BenchmarkRequest((tiny.root,), tmp_path, preset="paper", overrides=overrides))
    found = {case.variant: configs.load(None, case.overrides, "paper") for case in made}
    assert not found["tracks"].train.shading and found["tracks"].identity.training == "off"
    assert found["r5dgs"].identity.training == "joint" and found["r5dgs"].identity.weight == 0.3


def test_the_user_can_benchmark_the_absolute_form_of_the_rigidity_loss(tiny, tmp_path):
    plan = cases.BenchmarkRequest((tiny.root,), tmp_path, ("r5dgs_extra",), overrides=("losses.rigid_form=absolute",))
    (case,) = cases.make(plan)
    assert configs.load(None, case.overrides, None).losses.rigid_form == "absolute"


@pytest.mark.parametrize("name", ["5dgs", "r5dgs", "r5dgs_extra"])
def test_the_method_does_not_depend_on_the_users_settings(name):
    given = variants.settings(name, None)
    assert {"train.representation", "field.variant", "identity.training", "identity.weight"} <= set(given)
    weights = {"identity.weight", "identity.spatial", "identity.majority"}  # the preset `paper` has these sections, too
    assert set(given) - set(variants.settings(name, "paper")) == weights & set(given)


def test_a_session_without_known_cost_makes_the_sum_unknown():
    known = {"cpu_seconds": 2.0, "wall_seconds": 3.0, "peak_mb": 100.0, "peak_gpu_mb": None}
    more = {**known, "peak_mb": 150.0}
    assert cases.cost([known, more]) == {
        "cpu_seconds": 4.0,
        "wall_seconds": 6.0,
        "peak_mb": 150.0,
        "peak_gpu_mb": None,
    }
    assert cases.cost([known, {"status": None}])["cpu_seconds"] is None
    assert set(cases.cost([]).values()) == {None}


def test_a_damaged_record_raises_with_the_file_to_remove(tiny, tmp_path):
    (case,) = cases.make(plan_for(tiny, tmp_path))
    case.run.parent.mkdir()
    for text in ("{", "[]", '{"sittings": 3}'):
        case.beside(".json").write_text(text)
        with pytest.raises(CheckpointError, match="tracks_seed0.json.*remove it"):
            cases.read_record(case)


def test_a_process_reports_its_own_memory_and_error(tmp_path):
    ballast = np.ones(2**26)  # half a GiB in this process, which must not count in the other
    log_path, ended = tmp_path / "log", []
    log_path.write_text("an earlier complaint\n")
    sitting = process.run(["evaluate", str(tmp_path / "gone.r5dgs")], log_path, lambda event: None, ended.append)
    assert ended == [sitting] and sitting.status == exit_status.ExitStatus.ERROR
    assert "gone.r5dgs" in process.reason(sitting) and not process.reason(sitting).startswith("r5dgs:")
    assert sitting.cpu_seconds is not None and sitting.cpu_seconds > 0
    assert sitting.peak_mb is not None and 10 < sitting.peak_mb < ballast.nbytes / 2**20
    assert log_path.read_text().startswith("an earlier complaint\nr5dgs: ")


@pytest.mark.parametrize(
    ("status", "complaint", "words"), [(-9, "", "SIGKILL"), (-11, "", "SIGSEGV"), (3, "", "status 3"), (1, "no", "no")]
)
def test_the_end_of_a_process_is_described(status, complaint, words):
    assert words in process.reason(process.EndedProcess(status, complaint, 1.0, 1.0, None, None))


def test_playing_draws_each_camera_in_the_order_of_time(baked, tiny, monkeypatch):
    drawn, frame = [], scene_player.Player.frame

    def watch(player, t, origin=None):
        drawn.append(t)
        return frame(player, t, origin)

    monkeypatch.setattr(scene_player.Player, "frame", watch)
    views = datasets.read(tiny.root).test
    found = playback_speed.measure(baked, views[::-1], ["rigid"])["rigid"]
    round_ = drawn[: len(views)]
    assert sorted(round_) == sorted(view.t for view in views) and round_ == [*tiny_datasets.LATER] * 2
    assert drawn == round_ * (len(drawn) // len(round_)) and found["frames"] == len(drawn) - len(views)
    assert found["ms_frame_low"] <= found["ms_frame"] <= found["ms_frame_high"]
    assert playback_speed.measure(baked, [], ["rigid"]) == {"rigid": {**dict.fromkeys(found), "frames": 0}}


def test_modes_alternate_in_each_round(baked, tiny, monkeypatch):
    still = baked.with_arrays(dynamics=np.zeros((len(baked.gaussians.means), 12), np.float32))
    drawn, frame = [], scene_player.Player.frame

    def watch(player, t, origin=None):
        drawn.append(player.mode)
        return frame(player, t, origin)

    monkeypatch.setattr(scene_player.Player, "frame", watch)
    views = datasets.read(tiny.root).test
    found = playback_speed.measure(still, views, ["rigid", "standard"])
    turn = ["rigid"] * len(views) + ["standard"] * len(views)
    assert drawn and drawn == turn * (len(drawn) // len(turn))
    assert found["rigid"]["frames"] == found["standard"]["frames"] >= playback_speed.MIN_FRAMES
