"""Several runs in a report: the front beyond the noise, spread, groups, training logs and recommendations."""

import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core.cli.commands import report as command
from r5dgs_core.error_vs_time import (
    image_task,
    pareto_front,
    pose_task,
    recommendation,
    run_spread,
    scene_groups,
    training_task,
)
from r5dgs_core.error_vs_time.report_rows import Row
from r5dgs_core.train import step_log


def row(error=1.0, ms=1.0, kind="position", name="m", task="poses", spread=0.0, **more):
    return Row(task, "rigid", name, "s", kind, error, ms, ms_low=ms - spread, ms_high=ms + spread, **more)


def front(*runs):
    """Methods on the front."""
    return {r.method for r in run_spread.combine(runs) if r.pareto}


@st.composite
def runs(draw):
    count, methods = draw(st.integers(1, 3)), draw(st.integers(1, 8))
    numbers, spreads = st.integers(1, 12).map(float), st.sampled_from([0.0, 0.4, 1.5])
    kind = draw(st.sampled_from(["position", "psnr"]))
    return [
        [row(draw(numbers), draw(numbers), kind, f"m{i}", spread=draw(spreads)) for i in range(methods)]
        for _ in range(count)
    ]


@given(runs())
def test_the_front_gets_better_with_time_and_nothing_better_is_as_fast(some):
    lines = run_spread.lines(some)
    found = pareto_front.front(lines)
    assert found
    ordered = sorted(found, key=lambda key: pareto_front.mean_ms(lines[key]))
    for i, key in enumerate(ordered):
        assert all(pareto_front.is_better(lines[key], lines[fast]) for fast in ordered[:i])
        beaten = [
            other
            for other in lines
            if pareto_front.is_better(lines[other], lines[key]) and not pareto_front.is_faster(lines[key], lines[other])
        ]
        assert not beaten


def test_only_the_best_of_equally_fast_methods_is_on_the_pareto_front():
    some = [row(2.0, 1.0, name="a", spread=0.2), row(1.0, 1.1, name="b", spread=0.2), row(0.5, 9.0, name="c")]
    assert front(some) == {"b", "c"}


def test_more_decibels_are_better_and_tasks_have_fronts_of_their_own():
    some = [row(30.0, 1.0, "psnr", "a"), row(20.0, 2.0, "psnr", "b"), row(20.0, 2.0, "psnr", "c", "raster")]
    assert front(some) == {"a", "c"}


def test_a_row_without_time_is_on_no_front():
    assert front([row(0.0, math.nan, name="a"), row(math.nan, 1.0, name="b")]) == set()


def test_a_slower_method_needs_a_gain_beyond_the_noise_over_runs():
    """The gain is 0.2 on average; it counts if it is steady, not if it varies by more."""

    def three(gains):
        return [
            [row(seed, 1.0, "psnr", "fast"), row(seed + gain, 2.0, "psnr", "slow")]
            for seed, gain in zip((30.0, 33.0, 36.0), gains, strict=True)
        ]

    assert front(*three((0.2, 0.15, 0.25))) == {"fast", "slow"}
    assert front(*three((0.2, -0.3, 0.7))) == {"fast"}


def test_a_gain_below_the_printed_digits_does_not_count():
    assert front([row(30.0, 1.0, "psnr", "fast"), row(30.004, 2.0, "psnr", "slow")]) == {"fast"}


def test_runs_are_combined_into_medians_with_range_and_worst_object():
    some = [[row(e, t, error_worst=e + 1, worst_name=f"ball {e:g}")] for e, t in ((3.0, 1.0), (1.0, 4.0), (2.0, 2.0))]
    (one,) = run_spread.combine(some, "kitchen")
    assert (one.scene, one.runs, one.error, one.error_min, one.error_max) == ("kitchen", 3, 2.0, 1.0, 3.0)
    assert (one.ms, one.ms_min, one.ms_max, one.error_worst, one.worst_name) == (2.0, 1.0, 4.0, 4.0, "ball 3")


def test_runs_that_differ_in_the_seed_alone_are_one_group():
    def identity(name="kitchen", data="d", **train):
        return scene_groups.identity(name, {"dataset_digest": data, "config": {"train": train}})

    some = {"a": identity(seed=0, iterations=9), "b": identity(seed=1, iterations=9), "c": identity(iterations=5)}
    some |= {"d": identity("room", iterations=9), "e": identity("room", "other", iterations=9)}
    groups = scene_groups.by_name(some)
    assert list(groups.values()) == [["a", "b"], ["c"], ["d"], ["e"]]
    assert list(groups)[:3] == ["kitchen, train.iterations 9", "kitchen, train.iterations 5", "room"]


def recommend(*some):
    return recommendation.recommend(run_spread.combine(some, "kitchen"), run_spread.lines(some))


def test_the_fastest_nearly_best_method_is_recommended_with_its_margin():
    some = [row(e, t, "psnr", clock="cpu", task="images") for e, t in ((38.0, 40.0), (37.8, 12.0), (36.7, 5.0))]
    some = [Row(**{**r.__dict__, "mode": mode}) for r, mode in zip(some, ("a", "b", "c"), strict=True)]
    truth = row(37.0, math.nan, "psnr", image_task.ORACLE, "images")
    (found,) = recommend([*some, truth])
    assert (found["mode"], found["ms"], round(found["loss"], 6)) == ("b", 12.0, 0.2)
    for part in ("b, 12 ms (processor)", "0.20 dB below the best (a, 40 ms", "next faster: c, 5 ms", "costs 1.10 dB"):
        assert part in found["text"]
    assert "0.80 dB above true poses" in found["text"]


def test_a_model_that_only_the_truth_can_choose_is_not_recommended():
    alone = Row("poses", "rigid/fitted", "hinge", pose_task.ALONE, "position", 0.0, 0.1, error_worst=0.0)
    (found,) = recommend([alone, row(0.01, 1.0, name="chosen", error_worst=0.01)])
    assert found["method"] == "chosen"


@pytest.mark.parametrize("task", ["poses", "family"])
def test_a_method_that_loses_one_object_is_not_recommended(task):
    def run(more):
        fast = row(0.01, 1.0, name="few", task=task, error_worst=0.5 + more, worst_name="ball")
        return [fast, row(0.02, 9.0, name="all", task=task, error_worst=0.03 + more, worst_name="cup")]

    (found,) = recommend(run(0.0), run(0.01))
    assert (found["method"], round(found["error"], 6)) == ("all", 0.035)
    assert (
        "3.5 % of the size (3 % of the size to 4 % of the size in 2 runs) for the worst object (cup)" in found["text"]
    )
    assert "costs 47 % of the size" in found["text"]


# Training.


def write_run(folder, *events, views=5):
    folder.mkdir()
    config = {"train": {"iterations": 200, "representation": "tracks", "probe_views": views}}
    (folder / "run.json").write_text(json.dumps({"config": config}))
    lines = [{"event": "step", "gaussians": 9, "loss": 0.1, **event} for event in events]
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def test_training_is_measured_by_the_processor_time_of_the_log(tmp_path):
    events = [
        {"iteration": 100, "seconds": 9.0, "cpu_seconds": 4.0, "val_psnr": 30.0},
        {"iteration": 200, "seconds": 20.0, "cpu_seconds": 8.0, "val_psnr": 33.0},
    ]
    test = [Row("images", "rigid", "playback", "test", "psnr", 31.0)]
    rows, absent = training_task.measure(write_run(tmp_path / "run", *events), test)
    assert not absent and [r.error for r in rows] == [30.0, 33.0, 31.0]
    assert [(r.ms, r.ms_wall, r.clock) for r in rows[:2]] == [(4e3, 9e3, "cpu"), (8e3, 2e4, "cpu")]
    assert rows[-1].error_kind == "psnr@test" and rows[-1].ms == 8e3


def test_a_log_without_processor_time_is_shown_as_wall_time_and_named(tmp_path):
    run = write_run(tmp_path / "run", {"iteration": 200, "seconds": 20.0, "val_psnr": 33.0})
    (only,), absent = training_task.measure(run)
    assert only.clock == "wall" and only.ms == 2e4 and math.isnan(only.ms_cpu)
    assert "wall times only" in absent[0] and "train again" in absent[0]


def test_the_processor_time_of_a_resumed_run_goes_on_unless_the_log_has_none(tmp_path):
    old = write_run(tmp_path / "old", {"iteration": 1, "seconds": 2.0}) / "log.jsonl"
    new = write_run(tmp_path / "new", {"iteration": 1, "seconds": 2.0, "cpu_seconds": 1.5}) / "log.jsonl"
    assert step_log.processor_start(tmp_path / "none", 10.0) == 10.0
    assert step_log.processor_start(new, 10.0) == 8.5 and step_log.processor_start(old, 10.0) is None


@pytest.mark.parametrize("kept", [False, True])
def test_a_missing_record_is_named_with_the_remedy(tmp_path, kept):
    run = write_run(tmp_path / "run", {"iteration": 200, "seconds": 20.0})
    if not kept:
        (run / "log.jsonl").unlink()
    rows, absent = training_task.measure(run)
    assert not rows and ("train.probe_every > 0" if kept else "train again") in absent[0]


def test_a_data_set_applies_to_the_runs_before_it(tmp_path):
    a, b, c, data = (tmp_path / name for name in ("a", "b", "c", "data"))
    for run in (a, b, c):
        write_run(run)
    data.mkdir()
    assert command.pair([a, b, data, c]) == [(a, data), (b, data), (c, None)]
    assert command.pair([Path("x.r5dgs")]) == [(Path("x.r5dgs"), None)]
