"""The command line: from images to a table, exit statuses, and one line on stderr per error."""

import argparse
import contextlib
import dataclasses
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import r5dgs_core
from r5dgs_core import __version__, atomic_files, errors, progress
from r5dgs_core.bench import variants
from r5dgs_core.cli import inputs, main, parser, registry
from r5dgs_core.cli.commands import demo, info
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.config import presets
from r5dgs_core.data import dataset as datasets
from r5dgs_core.evaluation import evaluate, scene_summary
from r5dgs_core.motion.history import Band, History
from r5dgs_core.playback import modes
from r5dgs_core.raster import thread_pool
from r5dgs_core.scene import scene_file
from r5dgs_core.time_left import TimedProgress
from r5dgs_core.train import checkpoint, run_folder
from tests.support import lpips_weights, pages, tiny_datasets
from tests.support.command_line import complaint

pytestmark = pytest.mark.heavy

OPTIONS = [
    text
    for override in (*tiny_datasets.SETTINGS, "train.iterations=20", "identity.iterations=5")
    for text in ("--set", override)
]


def sub_parsers():
    """The parser of each sub-command, by name."""
    (found,) = [a.choices for a in parser.parser()._actions if isinstance(a, argparse._SubParsersAction)]
    return found


@pytest.fixture(scope="module")
def made(tiny, tmp_path_factory):
    """A folder with a run and a scene, made by the commands, and their output."""
    folder = tmp_path_factory.mktemp("made")
    run, scene = folder / "run", folder / "tiny.r5dgs"
    assert main.main(["train", str(tiny.root), "--out", str(run), "--progress", "none", *OPTIONS]) == 0
    assert main.main(["bake", str(run), "--out", str(scene)]) == 0
    return run, scene


def test_train_and_bake_leave_their_files(made):
    run, scene = made
    assert {p.name for p in run.iterdir()} >= {"run.json", "checkpoint.pt", "log.jsonl"}
    assert scene.is_file()
    assert not list(scene.parent.rglob("*.tmp")) and not list(scene.parent.rglob("*.part"))


@pytest.mark.parametrize("target", ["run", "scene"])
def test_evaluate_measures_a_run_and_a_scene(made, tiny, capsys, target):
    run, scene = made
    if target == "run":
        arguments, path = [str(run)], run / "evaluation.json"
    else:
        arguments, path = [str(scene), "--data", str(tiny.root)], scene.with_suffix(".evaluation.json")
    assert main.main(["evaluate", *arguments]) == 0
    result = json.loads(path.read_text())
    assert result["splits"]["val"]["rigid"]["images"] == 2 and result["splits"]["test"]["rigid"]["images"] == 4
    assert 5 < result["splits"]["val"]["rigid"]["psnr"] < 60
    assert [row["name"] for row in result["objects"]] == ["brick", "ball"]
    assert all(row["position_error"] is not None for row in result["objects"])
    assert result["train"]["iterations"] == 20
    assert str(path) in capsys.readouterr().out.replace("\n", "")


def test_evaluate_computes_lpips_with_given_weights(made, tmp_path, capsys):
    weights = tmp_path / "alex.pth"
    torch.save(lpips_weights.tensors("alex"), weights)
    given = ["evaluate", str(made[0]), "--json", str(tmp_path / "e.json")]
    assert main.main([*given, "--lpips", str(weights)]) == 0
    found = json.loads((tmp_path / "e.json").read_text())
    assert 0 < found["splits"]["test"]["rigid"]["lpips"] < 5 and found["lpips_network"] == "alex"
    assert "LPIPS" in capsys.readouterr().out
    assert "--lpips no.pth: expected a file" in complaint(capsys, *given, "--lpips", "no.pth")


def test_evaluate_writes_to_the_given_path(made, tmp_path, capsys):
    assert main.main(["evaluate", str(made[0]), "--json", str(tmp_path / "e.json")]) == 0
    assert set(json.loads((tmp_path / "e.json").read_text())) == {"scene", "splits", "objects", "horizon", "train"}


def test_info_prints_the_same_values_as_text_and_json(made, capsys):
    assert main.main(["info", str(made[1]), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [o["name"] for o in found["objects"]] == ["background", "brick", "ball"]
    assert main.main(["info", str(made[1])]) == 0
    text = capsys.readouterr().out
    assert f"{found['gaussians']} Gaussians, 2 objects" in text
    start, end = found["times"]
    frames = round((end - start) * found["frames_per_unit"]) + 1
    assert f"duration   {frames} frames: scene time {start:g} to {end:g}" in text
    assert f"{found['frames_per_unit']:g} per unit" in text and f"{found['extent']:.3g} world units" in text
    assert "quality" in text and "regrouping" not in text
    assert main.main(["info", str(made[1]), "--needs"]) == 0
    assert capsys.readouterr().out.startswith(text) and all(need["name"] for need in found["needs"])


def test_a_summary_names_what_moves_and_how(scene):
    text = scene_summary.summary(scene)
    resting = {item.name for item in scene.objects if scene_summary.observed_motion(scene, item.id) is None}
    assert "background" in resting and len(resting) < len(scene.objects)
    for item in scene.objects:
        assert (f"\n  {item.name}: " in text) == (item.name not in resting)
    shown = [item for item in scene.objects if item.id > 0]
    assert f"moving     {len(scene.objects) - len(resting)} of {len(shown)} objects" in text


def test_a_summary_has_the_half_width_of_a_known_band(scene):
    assert "±" not in scene_summary.summary(scene)
    band = Band((scene.t_max, 2 * scene.t_max), (0.1, 0.1), (0.1, 0.1))
    groups = tuple(dataclasses.replace(g, history=History(band=band)) if g.id == 1 else g for g in scene.groups)
    assert "; ± 0.1 world units (" in scene_summary.summary(dataclasses.replace(scene, groups=groups))


@pytest.mark.parametrize("odd", ["x", {}, {"checkpoint_psnr": 1.0, "baked_psnr": "x"}])
def test_a_summary_leaves_out_what_provenance_does_not_have(scene, odd):
    odd_scene = dataclasses.replace(scene, provenance={"training_views": odd})
    assert scene_summary.summary(odd_scene) == scene_summary.summary(scene)


def test_bake_prints_the_summary_and_the_needs_on_demand(made, tmp_path, capsys):
    scene = tmp_path / "again.r5dgs"
    for extra, shown in (([], False), (["--needs"], True)):
        assert main.main(["bake", str(made[0]), "--out", str(scene), "--progress", "none", *extra]) == 0
        text = capsys.readouterr().out
        assert text.startswith(f"written: {scene}\nscene ") and ("needs of the scene" in text) == shown
        assert re.search(r"^baking +checkpoint \d+\.\d\d dB, scene \d+\.\d\d dB on the training views$", text, re.M)


def test_missing_things_are_one_line(tmp_path, tiny, made, capsys):
    nowhere = tmp_path / "nowhere"
    assert str(nowhere) in complaint(capsys, "train", nowhere, "--out", tmp_path / "run")
    assert "not a run folder" in complaint(capsys, "bake", nowhere, "--out", tmp_path / "x.r5dgs")
    assert str(nowhere) in complaint(capsys, "info", nowhere)
    assert str(nowhere) in complaint(capsys, "evaluate", nowhere, "--data", tiny.root)
    assert "--data DIR" in complaint(capsys, "evaluate", made[1], status=ExitStatus.USAGE)
    assert not (tmp_path / "run").exists() and not (tmp_path / "x.r5dgs").exists()


def test_a_folder_of_another_program_does_not_change(tmp_path, tiny, capsys):
    (tmp_path / "letter.txt").write_text("mine")
    line = complaint(capsys, "train", tiny.root, "--out", tmp_path, *OPTIONS)
    assert "is not a run folder" in line and [p.name for p in tmp_path.iterdir()] == ["letter.txt"]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("losses.sim=1", "did you mean 'ssim'?"),
        ("train.iterations=many", "train.iterations: expected int, got 'many'"),
        ("nonsense", "expected SECTION.KEY=VALUE"),
    ],
)
def test_a_wrong_override_is_named_before_anything_is_made(tmp_path, tiny, capsys, override, words):
    given = ("train", tiny.root, "--out", tmp_path / "run", "--set", override)
    assert words in complaint(capsys, *given, status=ExitStatus.USAGE)
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_keeps_its_own_configuration(made, tiny, capsys):
    line = complaint(capsys, "train", tiny.root, "--out", made[0], "--resume", "--seed", "1", status=ExitStatus.USAGE)
    assert "--resume" in line
    assert main.main(["train", str(tiny.root), "--out", str(made[0]), "--resume", "--progress", "none"]) == 0


def test_train_can_write_the_scene_file_too(made, tiny, tmp_path, capsys):
    scene, given = tmp_path / "tiny.r5dgs", ("train", tiny.root, "--out", made[0], "--resume")
    assert main.main([*map(str, given), "--scene", str(scene), "--progress", "none"]) == 0
    assert f"written: {scene}" in capsys.readouterr().out
    assert scene.read_bytes() == made[1].read_bytes()
    line = complaint(capsys, *given, "--scene", tmp_path / "tiny.zip", status=ExitStatus.USAGE)
    assert "expected a name that ends in .r5dgs" in line


def test_train_accepts_a_scene_file_in_the_run_folder_that_it_makes(tmp_path, capsys):
    run, data = tmp_path / "run", tmp_path / "no_data"
    line = complaint(capsys, "train", data, "--out", run, "--scene", run / "scene.r5dgs")
    assert str(data) in line and "create it first" not in line
    line = complaint(capsys, "train", data, "--out", run, "--scene", tmp_path / "other" / "scene.r5dgs")
    assert "create it first" in line


def test_a_cap_and_a_preset_reach_the_run(tiny, tmp_path, capsys):
    run, given = tmp_path / "run", ["train", str(tiny.root), "--progress", "none", *OPTIONS]
    assert main.main([*given, "--out", str(run), "--max-gaussians", "120", "--preset", "fast"]) == 0
    kept = checkpoint.load(run)
    assert len(kept.tensors["gaussians.means"]) <= 120 and kept.iteration == 20  # --set wins over the preset
    assert run_folder.open_run(run).config.densify.max_gaussians == 120
    fresh = ("train", tiny.root, "--out", tmp_path / "no")
    line = complaint(capsys, *fresh, "--max-gaussians", "many", status=ExitStatus.USAGE)
    assert "--max-gaussians: expected an integer of at least 0, got 'many'" in line
    assert "--preset slow: unknown preset" in complaint(capsys, *fresh, "--preset", "slow", status=ExitStatus.USAGE)


@pytest.mark.slow
def test_a_need_can_be_overridden_when_baking(made, tmp_path, capsys):
    bare = tmp_path / "bare.r5dgs"
    assert main.main(["bake", str(made[0]), "--out", str(bare), "--set", "needs.classifier=off"]) == 0
    assert (
        scene_file.read(bare).gaussians.identities is None and scene_file.read(made[1]).gaussians.identities is not None
    )
    wrong = ("bake", made[0], "--out", bare, "--set", "train.seed=1")
    assert "bake accepts only needs" in complaint(capsys, *wrong, status=ExitStatus.USAGE)


def test_an_unknown_mode_is_an_error_that_names_the_known_ones(made, capsys):
    line = complaint(capsys, "evaluate", made[0], "--mode", "wobbly", status=ExitStatus.USAGE)
    assert "expected one of rigid, rigid/representative" in line


def test_a_target_folder_that_does_not_exist_is_an_error_for_bake(made, tmp_path, capsys):
    assert "folder" in complaint(capsys, "bake", made[0], "--out", tmp_path / "deep" / "x.r5dgs")


def test_wrong_usage_is_status_2(capsys):
    for arguments in ([], ["fly"], ["train"]):
        with pytest.raises(SystemExit) as stop:
            main.main(arguments)
        assert stop.value.code == 2
    assert "usage: r5dgs" in capsys.readouterr().err


def test_help_of_bench_names_every_variant(capsys):
    with pytest.raises(SystemExit):
        main.main(["bench", "--help"])
    shown = capsys.readouterr().out.replace("\n", " ")
    assert all(f"{name}," in shown or f"{name} " in shown for name in variants.VARIANTS)
    assert f"(default: {' '.join(variants.DEFAULT_VARIANTS)})" in " ".join(shown.split())


def test_the_registry_lists_every_module_of_the_commands():
    modules = {path.stem for path in (Path(registry.__file__).parent / "commands").glob("*.py")} - {"__init__"}
    assert sorted(registry.MODULES) == sorted(modules) and len(sub_parsers()) == len(modules)


def test_the_developers_page_adds_a_command(made, monkeypatch, capsys):
    pages.load("Command", "r5dgs_core.cli.commands.duration", monkeypatch)
    monkeypatch.setattr(registry, "MODULES", (*registry.MODULES, "duration"))
    assert main.main(["duration", str(made[1])]) == 0
    scene = scene_file.read(made[1])
    assert capsys.readouterr().out == f"{scene.t_max * scene.frames_per_unit:g} frames\n"
    assert "nowhere" in complaint(capsys, "duration", "nowhere")
    assert "print the duration of a scene" in parser.parser().format_help()


def test_the_bundled_data_is_found_and_is_small():
    found = demo.bundled_data()
    dataset = datasets.read(found)
    assert dataset.train and dataset.val and dataset.test and dataset.ground_truth is not None
    assert dataset.object_names
    assert sum(p.stat().st_size for p in found.rglob("*") if p.is_file()) < 4e6


def test_missing_bundled_data_raises(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(demo, "DATASET", "nothing")
    assert "install r5dgs again" in complaint(capsys, "demo", "--out", tmp_path / "demo")


def test_a_second_run_does_not_replace_the_first(made, tiny, capsys):
    before = (made[0] / "checkpoint.pt").read_bytes()
    line = complaint(capsys, "train", tiny.root, "--out", made[0], *OPTIONS)
    assert f"{made[0]}: holds a run at step 20; add --resume to continue, or --overwrite to start again" in line
    assert (made[0] / "checkpoint.pt").read_bytes() == before


def test_resume_and_overwrite_exclude_each_other(made, tiny, capsys):
    with pytest.raises(SystemExit) as stop:
        main.main(["train", str(tiny.root), "--out", str(made[0]), "--resume", "--overwrite"])
    assert stop.value.code == 2 and "not allowed with" in capsys.readouterr().err


def test_paths_of_the_wrong_kind_are_errors_of_one_line(made, tiny, tmp_path, capsys):
    file = tmp_path / "letter.txt"
    file.write_text("mine")
    assert f"{file}: not a run folder" in complaint(capsys, "bake", file, "--out", tmp_path / "x.r5dgs")
    assert f"{file / 'run'}: cannot be created" in complaint(
        capsys, "train", tiny.root, "--out", file / "run", *OPTIONS
    )
    assert f"{file}: exists and is not a run" in complaint(capsys, "train", tiny.root, "--out", file, *OPTIONS)
    assert f"{tmp_path}: cannot be read" in complaint(
        capsys, "train", tiny.root, "--out", tmp_path / "r", "--config", tmp_path
    )
    assert file.read_text() == "mine" and [p.name for p in tmp_path.iterdir()] == ["letter.txt"]


@pytest.mark.parametrize("place", ["missing/deep/x.json", "."])
def test_an_evaluation_that_could_not_be_written_is_refused_before_the_work(made, tmp_path, capsys, monkeypatch, place):
    monkeypatch.setattr(evaluate, "evaluate", None)  # a call would raise TypeError
    assert "--json" in complaint(capsys, "evaluate", made[0], "--json", tmp_path / place)


@pytest.mark.slow
def test_the_table_is_shown_even_if_the_file_cannot_be_written(made, tmp_path, capsys, monkeypatch):
    def full_disk(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic_files, "write", full_disk)
    assert main.main(["evaluate", str(made[0])]) == ExitStatus.ERROR
    shown = capsys.readouterr()
    assert "PSNR" in shown.out and "No space left" in shown.err and str(made[0] / "evaluation.json") in shown.err


def test_baking_with_other_data_raises_and_evaluating_on_it_warns(made, tmp_path, capsys, caplog):
    other = tiny_datasets.make_dataset(tmp_path / "other", views=3)
    line = complaint(capsys, "bake", made[0], "--out", tmp_path / "x.r5dgs", "--data", other.root)
    assert f"{other.root}: is not the data that {made[0]} was trained on" in line
    assert not (tmp_path / "x.r5dgs").exists()
    for target in made:
        caplog.clear()
        assert main.main(["evaluate", str(target), "--data", str(other.root), "--json", str(tmp_path / "e.json")]) == 0
        assert [r.getMessage() for r in caplog.records if r.name == inputs.__name__] == [
            f"{other.root}: differs from the data that {target} was trained on; it is used anyway"
        ]


@pytest.mark.slow
def test_evaluate_counts_its_images(made, tmp_path, capsys):
    assert main.main(["evaluate", str(made[0]), "--json", str(tmp_path / "e.json"), "--progress", "json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    first, *counted = events
    assert first == {"event": "prepare", "text": "the scene"}
    assert [(e["event"], e["done"], e["total"]) for e in counted] == [("evaluate", k, 6) for k in range(1, 7)]
    assert all(e["seconds_left"] >= 0 for e in counted[1:]) and counted[-1]["seconds_left"] == 0


@pytest.fixture
def small_demo(tiny, monkeypatch):
    """Make the demo run on the tiny data set. Returns its arguments without --out."""
    monkeypatch.setattr(demo, "DATASET", tiny.root.name)
    monkeypatch.setattr(demo, "bundled_data", lambda: tiny.root)
    return ["demo", *OPTIONS, "--progress", "json"]


def test_the_demo_does_not_replace_other_runs(small_demo, made, capsys, monkeypatch):
    monkeypatch.setattr(demo, "DATASET", "another data set")
    line = complaint(capsys, *small_demo, "--out", made[0])
    assert "add --resume to continue, or --overwrite" in line


@pytest.mark.slow
def test_the_demo_may_be_run_twice(small_demo, tmp_path, capsys):
    out = tmp_path / "my demo"
    for _ in range(2):
        assert main.main([*small_demo, "--out", str(out), "--set", "train.seed=3"]) == 0
        events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        kinds = list(dict.fromkeys(event["event"] for event in events))
        assert kinds == [
            *("start", "prepare", "trial", "step", "identity", "trained", "bake", "evaluate", "sheet", "written"),
        ]
        counted = [event for event in events if "done" in event or "loss" in event]
        assert all(event["seconds_left"] >= 0 for event in counted[1:]), "one estimate over all phases"
        assert all(event["seconds_left"] > 0 for event in counted[1:] if event["event"] in ("step", "identity"))
        assert counted[-1]["event"] == "evaluate" and counted[-1]["seconds_left"] < 5
        assert all((out / name).stat().st_size > 0 for name in ("demo.r5dgs", "evaluation.json", "contact_sheet.png"))
    line = complaint(capsys, *small_demo, "--out", out, "--resume", status=ExitStatus.USAGE)
    assert "leave out --preset, --config, --set, --iterations" in line


@pytest.mark.slow
@pytest.mark.parametrize("moment", [{"event": "step", "iteration": 10}, {"event": "evaluate", "done": 1}])
def test_a_stopped_demo_prints_the_command_that_continues_it(small_demo, tmp_path, capsys, monkeypatch, moment):
    out = tmp_path / "my demo"

    @contextlib.contextmanager
    def stopping(kind):
        yield TimedProgress(
            lambda event: signal.raise_signal(signal.SIGINT) if moment.items() <= event.items() else None
        )

    with monkeypatch.context() as patch:
        patch.setattr(progress, "make", stopping)
        assert main.main([*small_demo, "--out", str(out)]) == 130
    command = shlex.split(capsys.readouterr().err.split("continue with: ")[1])
    assert command == ["r5dgs", "demo", "--out", str(out), "--resume"]
    assert main.main([*command[1:], "--progress", "none"]) == 0
    assert (out / "contact_sheet.png").exists()


def test_bake_refuses_folders_and_other_suffixes(made, tmp_path, capsys):
    assert "is a folder" in complaint(capsys, "bake", made[0], "--out", tmp_path)
    wrong = ("bake", made[0], "--out", tmp_path / "scene.zip")
    assert ".r5dgs" in complaint(capsys, *wrong, status=ExitStatus.USAGE)


def test_a_moved_data_set_raises_with_the_option_for_its_path(made, tmp_path, capsys):
    shutil.copytree(made[0], tmp_path / "run")
    path = tmp_path / "run" / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "dataset": str(tmp_path / "gone")}))
    assert "--data" in complaint(capsys, "bake", path.parent, "--out", tmp_path / "x.r5dgs")
    assert "--data" in complaint(capsys, "evaluate", path.parent)


def test_a_closed_output_pipe_causes_no_traceback(made):
    command = f"{shlex.quote(sys.executable)} -m r5dgs_core.cli info {shlex.quote(str(made[1]))} | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=Path(main.__file__).parents[2])
    assert "Traceback" not in done.stderr


def test_the_help_of_train_names_every_preset(capsys):
    with pytest.raises(SystemExit):
        parser.parser().parse_args(["train", "--help"])
    text = capsys.readouterr().out
    assert all(f"{name} " in text or f"{name}\n" in text for name in presets.PRESETS)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--stability", "--out", "x"], "report --stability: takes no scene"),
        (["scene.r5dgs", "--stability"], "report --stability: takes no scene"),
        (["scene.r5dgs", "--out", "x", "--json", "x.json"], "report --json: applies to --stability only"),
        (["scene.r5dgs"], "report: expected RUN|SCENE and --out DIR"),
    ],
)
def test_report_rejects_unused_options(given, said, capsys):
    assert said in complaint(capsys, "report", *given, status=ExitStatus.USAGE)


@pytest.mark.parametrize("name", sub_parsers())
def test_every_help_has_a_description_an_example_and_a_page_that_exists(name, capsys):
    with pytest.raises(SystemExit) as stop:
        main.main([name, "--help"])
    shown = capsys.readouterr().out
    assert stop.value.code == 0 and len(sub_parsers()[name].description) > 30
    assert f"example:\n  r5dgs {name}" in shown
    page = shown.rpartition("read more: ")[2].strip()
    assert (Path(main.__file__).parents[2] / page).is_file()
    if re.search(r"--modes? MODE", shown):
        flat = "".join(shown.split())
        assert all(mode in flat for mode in modes.every())


@pytest.mark.parametrize("name", sub_parsers())
def test_the_example_of_every_help_can_be_parsed(name):
    lines = sub_parsers()[name].epilog.partition("example:\n")[2].partition("\n\n")[0].splitlines()
    for line in lines:
        program, *arguments = shlex.split(line)
        assert program == "r5dgs" and parser.parser().parse_args(arguments).command == name


NOWHERE = [  # a path that does not exist, or arguments that cannot be meant, for every command that can be given some
    ["train", "nowhere", "--out", "run"],
    ["train", "nowhere", "--out", "run", "--iterations", "0"],
    ["train", "nowhere", "--out", "run", "--set", "losses.sim=1"],
    ["train", ".", "--out", "run", "--threads", "2"],
    ["demo", "--preset", "slow"],
    ["demo", "--config", "nowhere.toml"],
    ["prepare", "nowhere", "--out", "data"],
    ["prepare", "nowhere", "--out", "data", "--start", "2", "--end", "1"],
    ["masks", "nowhere"],
    ["masks", "nowhere", "--backend", "sam3"],
    ["associate", "nowhere"],
    ["bake", "nowhere", "--out", "x.r5dgs"],
    ["bake", ".", "--out", "x.r5dgs"],
    ["bake", ".", "--out", "x.zip"],
    ["import", "nowhere", "--out", "x.r5dgs"],
    ["import", "nowhere", "--out", "x.r5dgs", "--world", "maya"],
    ["check", "nowhere"],
    ["prepare", ".", "--out", "data", "--calibration", "nowhere"],
    ["prepare", ".", "--out", "data", "--offset", "cam0"],
    ["prepare", ".", "--out", "data", "--offset", "cam0=1", "--offset", "cam0=2"],
    ["prepare", ".", "--out", "data", "--rate", "1e-300"],
    ["prepare", ".", "--out", "data", "--start", "3", "--end", "2"],
    ["export", "nowhere", "--to", "ply", "--out", "out.ply"],
    ["extrapolate", "nowhere", "--out", "x.r5dgs"],
    ["extrapolate", "nowhere", "--out", "x.r5dgs", "--push", "mug", "up"],
    ["objects", "nowhere", "--futures", "0"],
    ["evaluate", "nowhere"],
    ["evaluate", "nowhere", "--mode", "wobbly"],
    ["evaluate", "nowhere", "--threads", "0"],
    ["report", "nowhere", "--out", "report"],
    ["report", "nowhere", "--out", "report", "--tasks", "poise"],
    ["report", "nowhere", "--out", "report", "--splits", "tset"],
    ["report", "nowhere", "--out", "report", "--repeats", "0"],
    ["report", "--stability", "--json", "nowhere/rows.json"],
    ["report"],
    ["batch", "nowhere.toml", "--out", "runs"],
    ["batch", "nowhere.toml", "--out", "runs", "--jobs", "0"],
    ["bench", "nowhere", "--out", "tables"],
    ["bench", "nowhere", "--out", "tables", "--variants", "best"],
    ["render", "nowhere", "--out", "film.mp4"],
    ["render", "nowhere", "--out", "film.avi"],
    ["view", "nowhere"],
    ["view", "nowhere", "--port", "70000"],
    ["info", "nowhere"],
    ["objects", "nowhere"],
    ["objects", "nowhere", "--legend", "legend.jpg"],
    ["lookup", "nowhere", "--encoder", "text"],
    ["query", "nowhere", "mug"],
    ["query", "nowhere", "mug", "--threshold", "2"],
    ["name", "nowhere", "1", "mug"],
    ["name", "nowhere", "1"],
    ["check", "nowhere"],
    ["export", "nowhere", "--to", "ply", "--out", "out.ply"],
    ["config", "nowhere"],
    ["config", "--user", "get"],
    ["warm-up", "now"],
    ["train", "--help"],
    ["--help"],
    ["--version"],
    ["fly"],
]


def test_wrong_arguments_and_paths_are_reported_before_any_large_import(tmp_path):
    code = """
import json, os, sys
from r5dgs_core.cli import main as cli
for arguments in json.loads(sys.argv[1]):
    try:
        status = cli.main(arguments)
    except SystemExit as stop:
        status = stop.code
    heavy = sorted({"torch", "numba", "scipy", "matplotlib", "numpy", "rich"} & set(sys.modules))
    print(json.dumps([arguments, status, heavy, os.listdir()]), file=sys.__stdout__)
"""
    settings = {**os.environ, "PYTHONPATH": str(Path(main.__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(NOWHERE)], capture_output=True, text=True, cwd=tmp_path, env=settings
    )
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[[")]
    assert [row[0] for row in rows] == NOWHERE, done.stderr
    for arguments, status, heavy, made in rows:
        shown = {"--help", "--version"} & set(arguments)
        assert status == 0 if shown else status in (ExitStatus.USAGE, ExitStatus.ERROR), (arguments, status)
        assert heavy == [] and made == [], arguments
    assert {row[0][0] for row in rows} >= set(sub_parsers())
    assert "Traceback" not in done.stderr and f"r5dgs {__version__}" in done.stdout


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (errors.UsageError("x"), 2),
        (errors.ConfigError("x"), 3),
        (errors.SceneFileError("x"), 3),
        (errors.Interrupted("x"), 130),
        (KeyboardInterrupt(), 130),
        (PermissionError(13, "Permission denied", "x"), 3),
        (OSError(28, "No space left on device"), 3),
        (ZeroDivisionError("x"), 70),
    ],
)
def test_every_kind_of_error_has_its_status(monkeypatch, capsys, error, status):
    def fail(args):
        raise error

    monkeypatch.setattr(info, "run", fail)
    assert main.main(["info", "x.r5dgs"]) == status
    shown = capsys.readouterr().err
    assert ("Traceback" in shown) == (status == 70) and ("usage: r5dgs info" in shown) == (status == 2)


def test_a_missing_calibration_is_named_as_one(tmp_path, capsys):
    given = ("prepare", tmp_path, "--out", tmp_path / "data", "--calibration", tmp_path / "no.toml")
    assert f"--calibration {tmp_path / 'no.toml'}: expected a file or folder" in complaint(capsys, *given)


def test_a_query_that_finds_nothing_is_status_1(made, capsys):
    assert main.main(["query", str(made[1]), "brick"]) == 0
    assert main.main(["query", str(made[1]), "elephant"]) == 1
    assert main.main(["query", str(made[1]), "elephant", "--json"]) == 1
    assert "nothing" in capsys.readouterr().out


def test_steps_and_seed_reach_the_run_and_threads_leave_its_bits(tiny, tmp_path):
    states, before = [], thread_pool.threads()
    try:
        for threads in (1, 2):
            folder = tmp_path / str(threads)
            given = ["--iterations", "4", "--seed", "7", "--threads", str(threads), "--progress", "none"]
            assert main.main(["train", str(tiny.root), "--out", str(folder), *OPTIONS, *given]) == 0
            assert thread_pool.threads() == threads
            states.append(checkpoint.load(folder))
    finally:
        thread_pool.set_threads(before)
    settled = run_folder.open_run(folder).config.train
    assert (settled.iterations, settled.seed, states[0].iteration) == (4, 7, 4)
    assert all((states[0].tensors[name] == tensor).all() for name, tensor in states[1].tensors.items())


def test_the_module_runs_as_a_program():
    command = [sys.executable, "-m", "r5dgs_core.cli.main", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert r5dgs_core.__version__ in done.stdout
