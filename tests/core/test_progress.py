"""Progress: one JSON object per line for programs, few lines for a log, no output on request."""

import json

import pytest

from r5dgs_core import progress

EVENTS = [
    {"event": "start", "iterations": 100, "dataset": "data"},
    {"event": "prepare", "text": "kernels"},
    *[
        {"event": "step", "iteration": i, "loss": 0.5 / i, "gaussians": 10 * i, "seconds_left": 100.0 - i}
        for i in range(1, 101)
    ],
    {"event": "identity", "iteration": 5, "iterations": 5, "loss": 0.1},
    {"event": "trained", "gaussians": 1000},
    {"event": "bake", "text": "motion models"},
    {"event": "evaluate", "done": 3, "total": 9},
    {"event": "sheet", "text": "contact sheet"},
]


def show(kind):
    with progress.make(kind) as report:
        for event in EVENTS:
            report(event)


def test_json_lines_are_the_events(capsys):
    show("json")
    shown = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(shown) == len(EVENTS)
    for line, event in zip(shown, EVENTS, strict=True):
        assert {key: line[key] for key in event} == event and line.keys() - event.keys() <= {"seconds_left"}


def test_none_is_silent(capsys):
    show("none")
    assert capsys.readouterr() == ("", "")


def test_a_log_gets_few_lines(capsys, monkeypatch):
    now = [1000.0]

    def clock():
        now[0] += 1.0
        return now[0]

    monkeypatch.setattr(progress.time, "monotonic", clock)
    show("auto")
    lines = capsys.readouterr().out.splitlines()
    told = [line for line in lines if ":" in line and not line.startswith(("step ", "identity ", "evaluate "))]
    assert told == [
        "start: 100 steps",
        "prepare: kernels",
        "trained: 1000 Gaussians",
        "bake: motion models",
        "sheet: contact sheet",
    ]
    counted = [line.split()[0] for line in lines if line not in told]
    assert any(line.startswith("evaluate 3 of 9 images") for line in lines)
    assert 5 <= counted.count("step") <= 1 + 100 / progress.PLAIN_EVERY_S
    assert counted[-2:] == ["identity", "evaluate"]  # each phase shows at once
    assert lines[2] == "step 1: loss 0.5000, 10 Gaussians, 99 s left"


def test_a_terminal_gets_bars(capsys, monkeypatch):
    monkeypatch.setattr(progress.sys.stdout, "isatty", lambda: True, raising=False)
    show("auto")
    shown = capsys.readouterr().out
    for words in ("prepare", "kernels", "train", "100/100", "identities", "5/5", "bake", "evaluate", "3/9", "sheet"):
        assert words in shown


@pytest.mark.parametrize(
    ("event", "words"),
    [
        ({"event": "x"}, ""),
        ({"event": "x", "text": "now this"}, "now this"),
        ({"event": "x", "done": 3, "total": 9}, ""),
        ({"event": "x", "iterations": 7}, "7 steps"),
        ({"event": "x", "loss": 0.25, "iterations": 7}, "loss 0.2500"),
        ({"event": "x", "loss": 0.25, "val_psnr": 31.23, "gaussians": 5}, "loss 0.2500, held-out 31.2 dB, 5 Gaussians"),
    ],
)
def test_events_in_words(event, words):
    assert progress.describe(event) == words


@pytest.mark.parametrize("terminal", [False, True])
def test_steps_repeat_the_last_measurement_of_held_out_views(capsys, monkeypatch, terminal):
    monkeypatch.setattr(progress.sys.stdout, "isatty", lambda: terminal, raising=False)
    monkeypatch.setattr(progress, "PLAIN_EVERY_S", 0.0)
    with progress.make("auto") as report:
        report({"event": "start", "iterations": 2})
        report({"event": "step", "iteration": 1, "loss": 0.5, "val_psnr": 31.23})
        report({"event": "step", "iteration": 2, "loss": 0.4})
    assert "loss 0.4000, held-out 31.2 dB" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("terminal", [False, True])
def test_a_new_run_resets_the_measurements_of_held_out_views(capsys, monkeypatch, terminal):
    monkeypatch.setattr(progress.sys.stdout, "isatty", lambda: terminal, raising=False)
    monkeypatch.setattr(progress, "PLAIN_EVERY_S", 0.0)
    with progress.make("auto") as report:
        report({"event": "start", "iterations": 1})
        report({"event": "step", "iteration": 1, "loss": 0.5, "val_psnr": 31.23})
        capsys.readouterr()
        report({"event": "start", "iterations": 2})
        report({"event": "step", "iteration": 2, "loss": 0.4})
    shown = " ".join(capsys.readouterr().out.split())
    assert "loss 0.4000" in shown and "loss 0.4000, held-out" not in shown
