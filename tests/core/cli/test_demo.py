"""The demo's figures are in one place."""

from pathlib import Path

from r5dgs_core.cli.commands import demo

ROOT = Path(__file__).parents[3]


def evaluation(**changes):
    found = {split: demo.EXPECTED[split] + changes.get(split, 0.0) for split in demo.EXPECTED}
    return {"splits": {split: {"rigid": {"psnr": value}} for split, value in found.items()}}


def test_a_run_falls_short_if_it_is_more_than_a_decibel_below_the_committed_figure():
    assert demo.shortfalls(evaluation()) == demo.shortfalls(evaluation(val=-0.9, test=-0.9)) == []
    assert [line.split(":")[0] for line in demo.shortfalls(evaluation(test=-1.1))] == ["test"]
    assert len(demo.shortfalls(evaluation(val=float("nan")))) == 1


def test_the_last_line_and_ci_take_the_committed_figures():
    assert demo.expectation() == "expected about 42 / 37 dB (val / test)"
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "demo.shortfalls(result)" in script and "demo.expectation()" in script
