"""The demo's figures are in one place."""

import importlib.util
from pathlib import Path

import pytest

from r5dgs_core.cli.commands import demo
from r5dgs_core.config import config

ROOT = Path(__file__).parents[3]


def demo_psnr():
    """The script of CI, as a module."""
    spec = importlib.util.spec_from_file_location("demo_psnr", ROOT / ".ci" / "demo_psnr.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def evaluation(**changes):
    found = {split: demo.EXPECTED[split] + changes.get(split, 0.0) for split in demo.EXPECTED}
    return {"splits": {split: {"rigid": {"psnr": value}} for split, value in found.items()}}


def test_a_run_falls_short_if_it_is_more_than_a_decibel_below_the_committed_figure():
    assert demo_psnr().shortfalls(evaluation()) == demo_psnr().shortfalls(evaluation(val=-0.9, test=-0.9)) == []
    assert [line.split(":")[0] for line in demo_psnr().shortfalls(evaluation(test=-1.1))] == ["test"]
    assert len(demo_psnr().shortfalls(evaluation(val=float("nan")))) == 1


def test_the_last_line_and_ci_take_the_committed_figures():
    assert demo.expectation() == "expected about 42 / 37 dB (val / test)"
    for script in ("run", "nightly"):
        assert "python .ci/demo_psnr.py" in (ROOT / ".ci" / script).read_text(encoding="utf-8")
    check = (ROOT / ".ci" / "demo_psnr.py").read_text(encoding="utf-8")
    assert "demo.EXPECTED" in check and "demo.expectation()" in check


@pytest.mark.parametrize(
    ("setting", "remains"),
    [
        ("train.seed=2", True),
        ("train.device='cpu'", True),
        ("train.iterations=300", False),
        ("train.representation='field'", False),
    ],
)
def test_the_committed_figures_are_not_expected_of_runs_with_other_settings(setting, remains):
    assert demo.has_expectation(config.Config())
    assert demo.has_expectation(config.Config().override([setting])) == remains
