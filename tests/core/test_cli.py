"""The command line: the way from images to a table, and one line on stderr for what the user can mend."""

import contextlib
import json
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from r5dgs_core import __version__, cli, commands, demo, progress
from r5dgs_core.bench import variants
from r5dgs_core.data import dataset as datasets
from r5dgs_core.report import evaluate
from r5dgs_core.scene import files, scene_file
from r5dgs_core.train import checkpoint, presets
from tests import datasets as tiny_datasets

OPTIONS = [
    text
    for override in (*tiny_datasets.SETTINGS, "train.iterations=20", "identity.iterations=5")
    for text in ("--set", override)
]


def complaint(capsys, *arguments):
    """The one line that a failing command prints."""
    assert cli.main([str(a) for a in arguments]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("r5dgs: ")
    return lines[0]


@pytest.fixture(scope="module")
def made(tiny, tmp_path_factory):
    """A folder with a run and a scene, made by the commands, and what they printed."""
    folder = tmp_path_factory.mktemp("made")
    run, scene = folder / "run", folder / "tiny.r5dgs"
    assert cli.main(["train", str(tiny.root), "--out", str(run), "--progress", "none", *OPTIONS]) == 0
    assert cli.main(["bake", str(run), "--out", str(scene)]) == 0
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
    assert cli.main(["evaluate", *arguments]) == 0
    result = json.loads(path.read_text())
    assert result["splits"]["val"]["rigid"]["images"] == 2 and result["splits"]["test"]["rigid"]["images"] == 4
    assert 5 < result["splits"]["val"]["rigid"]["psnr"] < 60
    assert [row["name"] for row in result["objects"]] == ["brick", "ball"]
    assert all(row["position_error"] is not None for row in result["objects"])
    assert result["train"]["iterations"] == 20
    assert str(path) in capsys.readouterr().out.replace("\n", "")


def test_evaluate_writes_where_it_is_told(made, tmp_path, capsys):
    assert cli.main(["evaluate", str(made[0]), "--json", str(tmp_path / "e.json")]) == 0
    assert set(json.loads((tmp_path / "e.json").read_text())) == {"scene", "splits", "objects", "train"}


def test_info_tells_the_same_to_people_and_programs(made, capsys):
    assert cli.main(["info", str(made[1]), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [o["name"] for o in found["objects"]] == ["background", "brick", "ball"]
    assert cli.main(["info", str(made[1])]) == 0
    text = capsys.readouterr().out
    assert "brick" in text and str(found["gaussians"]) in text


def test_missing_things_are_one_line(tmp_path, tiny, made, capsys):
    nowhere = tmp_path / "nowhere"
    assert str(nowhere) in complaint(capsys, "train", nowhere, "--out", tmp_path / "run")
    assert "not a run folder" in complaint(capsys, "bake", nowhere, "--out", tmp_path / "x.r5dgs")
    assert str(nowhere) in complaint(capsys, "info", nowhere)
    assert str(nowhere) in complaint(capsys, "evaluate", nowhere, "--data", tiny.root)
    assert "--data DIR" in complaint(capsys, "evaluate", made[1])
    assert not (tmp_path / "run").exists() and not (tmp_path / "x.r5dgs").exists()


def test_a_folder_that_is_not_ours_is_left_alone(tmp_path, tiny, capsys):
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
    assert words in complaint(capsys, "train", tiny.root, "--out", tmp_path / "run", "--set", override)
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_keeps_its_own_configuration(made, tiny, capsys):
    line = complaint(capsys, "train", tiny.root, "--out", made[0], "--resume", "--set", "train.seed=1")
    assert "--resume" in line
    assert cli.main(["train", str(tiny.root), "--out", str(made[0]), "--resume", "--progress", "none"]) == 0


def test_a_cap_and_a_preset_reach_the_run(tiny, tmp_path, capsys):
    run, given = tmp_path / "run", ["train", str(tiny.root), "--progress", "none", *OPTIONS]
    assert cli.main([*given, "--out", str(run), "--max-gaussians", "120", "--preset", "fast"]) == 0
    kept = checkpoint.load(run)
    assert len(kept.tensors["gaussians.means"]) <= 120 and kept.iteration == 20  # --set wins over the preset
    assert checkpoint.open_run(run).config.densify.max_gaussians == 120
    line = complaint(capsys, "train", tiny.root, "--out", tmp_path / "no", "--max-gaussians", "many")
    assert "densify.max_gaussians: expected int, got 'many'" in line
    assert "--preset slow: unknown preset" in complaint(
        capsys, "train", tiny.root, "--out", tmp_path / "no", "--preset", "slow"
    )


def test_a_need_can_be_overridden_when_baking(made, tmp_path, capsys):
    bare = tmp_path / "bare.r5dgs"
    assert cli.main(["bake", str(made[0]), "--out", str(bare), "--set", "needs.classifier=off"]) == 0
    assert scene_file.read(bare).identities is None and scene_file.read(made[1]).identities is not None
    assert "bake takes needs" in complaint(capsys, "bake", made[0], "--out", bare, "--set", "train.seed=1")


def test_an_unknown_mode_is_an_error_that_names_the_known_ones(made, capsys):
    assert "rigid" in complaint(capsys, "evaluate", made[0], "--mode", "wobbly")


def test_a_target_folder_that_does_not_exist_is_an_error_for_bake(made, tmp_path, capsys):
    assert "folder" in complaint(capsys, "bake", made[0], "--out", tmp_path / "deep" / "x.r5dgs")


def test_wrong_usage_is_status_2(capsys):
    for arguments in ([], ["fly"], ["train"]):
        with pytest.raises(SystemExit) as stop:
            cli.main(arguments)
        assert stop.value.code == 2
    assert "usage: r5dgs" in capsys.readouterr().err


def test_help_and_version_need_no_torch():
    code = (
        "import sys; from r5dgs_core import cli\n"
        "try: cli.main(['--version'])\n"
        "except SystemExit: pass\n"
        "print('torch' in sys.modules or 'numba' in sys.modules)"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.splitlines() == [f"r5dgs {__version__}", "False"]


def test_help_of_bench_names_every_variant(capsys):
    with pytest.raises(SystemExit):
        cli.main(["bench", "--help"])
    shown = capsys.readouterr().out.replace("\n", " ")
    assert all(f"{name}," in shown or f"{name} " in shown for name in variants.VARIANTS)
    assert f"(default: {' '.join(variants.DEFAULT_VARIANTS)})" in " ".join(shown.split())


def test_the_module_of_the_command_line_names_every_command():
    (commands,) = [action.choices for action in cli.parser()._actions if isinstance(action.choices, dict)]
    named = " ".join(cli.__doc__.split("\n\n")[0].split()).partition(": ")[2].rstrip(".").split(", ")
    assert sorted(named) == sorted(commands)


def test_the_bundled_data_is_found_and_small():
    found = demo.bundled_data()
    dataset = datasets.read(found)
    assert dataset.train and dataset.val and dataset.test and dataset.ground_truth is not None
    assert dataset.object_names
    assert sum(p.stat().st_size for p in found.rglob("*") if p.is_file()) < 4e6


def test_missing_bundled_data_is_said(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(demo, "NAME", "nothing")
    assert "install r5dgs again" in complaint(capsys, "demo", "--out", tmp_path / "demo")


def test_a_second_run_is_not_begun_over_the_first(made, tiny, capsys):
    before = (made[0] / "checkpoint.pt").read_bytes()
    line = complaint(capsys, "train", tiny.root, "--out", made[0], *OPTIONS)
    assert f"{made[0]}: holds a run at step 20; add --resume to go on, or --overwrite to begin again" in line
    assert (made[0] / "checkpoint.pt").read_bytes() == before


def test_resume_and_overwrite_exclude_each_other(made, tiny, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["train", str(tiny.root), "--out", str(made[0]), "--resume", "--overwrite"])
    assert stop.value.code == 2 and "not allowed with" in capsys.readouterr().err


def test_paths_of_the_wrong_kind_are_one_line(made, tiny, tmp_path, capsys):
    file = tmp_path / "letter.txt"
    file.write_text("mine")
    assert f"{file}: not a run folder" in complaint(capsys, "bake", file, "--out", tmp_path / "x.r5dgs")
    assert f"{file / 'run'}: cannot be made" in complaint(capsys, "train", tiny.root, "--out", file / "run", *OPTIONS)
    assert f"{file}: exists and is not a run" in complaint(capsys, "train", tiny.root, "--out", file, *OPTIONS)
    assert f"{tmp_path}: cannot be read" in complaint(
        capsys, "train", tiny.root, "--out", tmp_path / "r", "--config", tmp_path
    )
    assert file.read_text() == "mine" and [p.name for p in tmp_path.iterdir()] == ["letter.txt"]


@pytest.mark.parametrize("place", ["missing/deep/x.json", "."])
def test_an_evaluation_that_could_not_be_written_is_refused_before_the_work(made, tmp_path, capsys, monkeypatch, place):
    monkeypatch.setattr(evaluate, "evaluate", None)  # calling it would be a TypeError
    assert "--json" in complaint(capsys, "evaluate", made[0], "--json", tmp_path / place)


def test_the_table_is_shown_even_where_the_file_cannot_be_written(made, tmp_path, capsys, monkeypatch):
    def full_disk(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "write", full_disk)
    assert cli.main(["evaluate", str(made[0])]) == 1
    shown = capsys.readouterr()
    assert "PSNR" in shown.out and "No space left" in shown.err and str(made[0] / "evaluation.json") in shown.err


def test_only_the_data_of_a_run_bakes_it_and_measuring_on_others_is_said(made, tmp_path, capsys, caplog):
    other = tiny_datasets.make_dataset(tmp_path / "other", views=3)
    line = complaint(capsys, "bake", made[0], "--out", tmp_path / "x.r5dgs", "--data", other.root)
    assert f"{other.root}: is not the data that {made[0]} was trained on" in line
    assert not (tmp_path / "x.r5dgs").exists()
    for target in made:
        caplog.clear()
        assert cli.main(["evaluate", str(target), "--data", str(other.root), "--json", str(tmp_path / "e.json")]) == 0
        assert [r.getMessage() for r in caplog.records if r.name == commands.__name__] == [
            f"{other.root}: {target} was trained on other data than this; it is used all the same"
        ]


def test_evaluate_counts_its_images(made, tmp_path, capsys):
    assert cli.main(["evaluate", str(made[0]), "--json", str(tmp_path / "e.json"), "--progress", "json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(e["event"], e["done"], e["total"]) for e in events] == [("evaluate", k, 6) for k in range(1, 7)]


@pytest.fixture
def small_demo(tiny, monkeypatch):
    """Makes the demo run on the tiny data set; returns its arguments without --out."""
    monkeypatch.setattr(demo, "NAME", tiny.root.name)
    monkeypatch.setattr(demo, "bundled_data", lambda: tiny.root)
    return ["demo", *OPTIONS, "--progress", "json"]


def test_the_demo_may_be_run_twice_and_leaves_other_runs_alone(small_demo, made, tmp_path, capsys, monkeypatch):
    out = tmp_path / "my demo"
    for _ in range(2):
        assert cli.main([*small_demo, "--out", str(out), "--set", "train.seed=3"]) == 0
        events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        kinds = list(dict.fromkeys(event["event"] for event in events))
        assert kinds == ["start", "prepare", "step", "identity", "trained", "bake", "evaluate", "sheet", "written"]
        assert all((out / name).stat().st_size > 0 for name in ("demo.r5dgs", "evaluation.json", "contact_sheet.png"))
    assert "leave out --preset, --config, --set and" in complaint(capsys, *small_demo, "--out", out, "--resume")
    monkeypatch.setattr(demo, "NAME", "another data set")
    line = complaint(capsys, *small_demo, "--out", made[0])
    assert "add --resume to go on, or --overwrite" in line


@pytest.mark.parametrize("moment", [{"event": "step", "iteration": 10}, {"event": "evaluate", "done": 1}])
def test_a_stopped_demo_names_the_command_that_goes_on(small_demo, tmp_path, capsys, monkeypatch, moment):
    out = tmp_path / "my demo"

    @contextlib.contextmanager
    def stopping(kind):
        yield lambda event: signal.raise_signal(signal.SIGINT) if moment.items() <= event.items() else None

    with monkeypatch.context() as patch:
        patch.setattr(progress, "make", stopping)
        assert cli.main([*small_demo, "--out", str(out)]) == 130
    command = shlex.split(capsys.readouterr().err.split("go on with: ")[1])
    assert command == ["r5dgs", "demo", "--out", str(out), "--resume"]
    assert cli.main([*command[1:], "--progress", "none"]) == 0
    assert (out / "contact_sheet.png").exists()


def test_a_scene_goes_into_a_file_that_blender_finds(made, tmp_path, capsys):
    for out, words in ((tmp_path, "is a folder"), (tmp_path / "scene.zip", ".r5dgs")):
        assert words in complaint(capsys, "bake", made[0], "--out", out)


def test_a_data_set_that_has_moved_is_asked_for(made, tmp_path, capsys):
    shutil.copytree(made[0], tmp_path / "run")
    path = tmp_path / "run" / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "dataset": str(tmp_path / "gone")}))
    assert "--data" in complaint(capsys, "bake", path.parent, "--out", tmp_path / "x.r5dgs")
    assert "--data" in complaint(capsys, "evaluate", path.parent)


def test_a_reader_that_goes_away_is_no_traceback(made):
    command = f"{shlex.quote(sys.executable)} -m r5dgs_core.cli info {shlex.quote(str(made[1]))} | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=Path(cli.__file__).parents[1])
    assert "Traceback" not in done.stderr


def test_the_help_of_train_names_every_preset(capsys):
    with pytest.raises(SystemExit):
        cli.parser().parse_args(["train", "--help"])
    text = capsys.readouterr().out
    assert all(f"{name} " in text or f"{name}\n" in text for name in presets.PRESETS)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--stability", "--out", "x"], "report --stability: needs no scene"),
        (["scene.r5dgs", "--stability"], "report --stability: needs no scene"),
        (["scene.r5dgs", "--out", "x", "--json", "x.json"], "report --json: is for --stability"),
        (["scene.r5dgs"], "report: expected RUN|SCENE and --out DIR"),
    ],
)
def test_a_report_refuses_what_it_would_not_heed(given, said, capsys):
    assert cli.main(["report", *given]) == 1
    assert said in capsys.readouterr().err
