"""The stability table passes, and a broken integrator fails only the rows that test it."""

import dataclasses
import io
import json
import math
import pkgutil
import re

import numpy as np
import pytest
from rich.console import Console

from r5dgs_core import stability
from r5dgs_core.cli import main
from r5dgs_core.motion import rigid_fit, rotations, se3
from r5dgs_core.scene import validation
from r5dgs_core.stability import cases as stability_cases
from r5dgs_core.stability import scenes as stability_scenes
from r5dgs_core.stability import training

pytestmark = pytest.mark.heavy

LONG = [case for case in stability.CASES if case.name.endswith("1e7 frames")]  # seconds each; few frames run, too
COSTLY = [  # half a second and more each
    case
    for case in stability.CASES
    if (case.topic, case.name)
    in {
        ("loading", "1000 bodies"),
        ("small angles", "gradients of the exponential at 0, 1e-300 to 1e-4 rad"),
        ("keying", "an orbit of 1e15 units per unit, 600 frames"),
        ("breaks", "2 within a time step, 5 poses left"),
        ("contacts", "coin that spins with 60 rad/s"),
        ("contacts", "five boxes on each other for 10 s"),
        ("contacts", "mass ratio 1e+06"),
    }
]
SHORT = [case for case in stability.CASES if case not in LONG + COSTLY]
COMPARED = {  # rows whose errors of the TRACE integrator are tested; those of others take longer than all else
    ("growth", "one step of 1 rad"),
    ("direction of time", "forward, then backward, 4 steps"),
    ("distances in a body", "1e4 from the origin, to 100 times the observed time"),
}


@pytest.fixture(scope="module")
def rows():
    return stability.run([case if (case.topic, case.name) in COMPARED else alone(case) for case in SHORT])


def alone(case):
    """The case without the TRACE integrator."""
    return dataclasses.replace(case, trace_rk2=None)


def failed(cases):
    """Names of the rows that fail, topic and name."""
    return {(row.topic, row.name) for row in stability.run([alone(case) for case in cases]) if not row.passed}


def of(*topics):
    return [case for case in stability.CASES if case.topic in topics]


def case(measure, tolerance=1.0, trace_rk2=None):
    return stability_cases.Case("topic", "name", "method", "quantity", tolerance, "source", measure, trace_rk2)


@pytest.mark.nightly
def test_every_case_of_millions_of_frames_passes():
    assert LONG and not failed(LONG)


@pytest.mark.slow
def test_every_costly_case_passes():
    assert len(COSTLY) == 7 and not failed(COSTLY)


@pytest.mark.slow
def test_every_case_passes(rows):
    assert [(row.topic, row.name, row.measured, row.message) for row in rows if not row.passed] == []


@pytest.mark.slow
def test_every_case_is_described_and_unique(rows):
    assert len({(row.topic, row.name) for row in rows}) == len(rows) == len(SHORT)
    for row in rows:
        assert row.name and row.method and row.quantity and row.source
        assert row.seconds >= 0 and math.isfinite(row.measured)


@pytest.mark.parametrize("method", sorted({case.method for case in (*stability.CASES, *training.CASES)}))
def test_every_named_function_exists(method):
    for name in re.sub(r" \(.*\)$", "", method).split(", "):
        assert callable(pkgutil.resolve_name(f"r5dgs_core.{name}"))


@pytest.mark.slow
def test_rows_of_a_topic_are_adjacent(rows):
    topics = [row.topic for row in rows]
    starts = [topic for before, topic in zip(["", *topics], topics, strict=False) if topic != before]
    assert len(starts) == len(set(starts))


@pytest.mark.slow
def test_the_table_is_the_same_on_every_run(rows):
    again = stability.run([alone(case) for case in of("order", "twists of members", "keys")])
    first = {(row.topic, row.name): row.measured for row in rows}
    for row in again:
        assert row.measured == first[row.topic, row.name]


@pytest.mark.slow
def test_traces_integrator_shows_the_errors_predicted_by_theory(rows):
    by_name = {(row.topic, row.name): row for row in rows}
    assert by_name["growth", "one step of 1 rad"].trace_rk2 == pytest.approx(math.sqrt(1.25) - 1)
    assert by_name["direction of time", "forward, then backward, 4 steps"].trace_rk2 > 1
    assert by_name["distances in a body", "1e4 from the origin, to 100 times the observed time"].trace_rk2 > 0.01


def magnus_of_order_two(monkeypatch):
    """Omit the commutator, as in an exponential of the midpoint twist."""
    honest = se3.step_twists
    monkeypatch.setattr(se3, "step_twists", lambda w, v, e, a, t, steps, order=4: honest(w, v, e, a, t, steps, 2))


def test_an_integrator_of_order_two_fails_only_the_rows_for_order_four(monkeypatch):
    magnus_of_order_two(monkeypatch)
    assert failed(of("order", "closed forms", "growth", "time grid")) == {
        ("order", "Magnus-4 is of order 4"),
        ("order", "16 steps, axis that tilts"),
        ("order", "64 steps, axis that tilts"),
        ("order", "256 steps, axis that tilts"),
        ("order", "steps chosen by rule, 60 random twists"),
    }


def test_quaternions_by_the_trace_formula_fail_at_half_turns_and_nowhere_else(monkeypatch):
    def by_trace(rotmats):
        m = np.asarray(rotmats)
        with np.errstate(all="ignore"):
            w = 0.5 * np.sqrt(1 + np.trace(m, axis1=-2, axis2=-1))
            vec = [m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]]
            return np.stack([w, *(part / (4 * w) for part in vec)], -1)

    monkeypatch.setattr(rotations, "rotmats_to_quats", by_trace)
    broken = failed(of("small angles", "half turns", "signs"))
    assert ("half turns", "matrix to quaternion at pi, float64") in broken
    through_half_turns = {("signs", "ten turns in steps of 20 degrees")}
    assert all(name.startswith("matrix to quaternion") for _, name in broken - through_half_turns)


def test_signs_that_jump_fail_the_rows_on_signs(monkeypatch):
    monkeypatch.setattr(rotations, "make_continuous", lambda quats: quats)
    broken = failed(of("signs", "half turns"))
    assert broken == {("signs", "ten turns in steps of 20 degrees")}


@pytest.mark.slow
def test_a_fit_that_mirrors_fails_for_points_in_a_plane(monkeypatch):
    def mirrored(source, target, weights):
        center, moved = weights @ source, weights @ target
        u, _, vt = np.linalg.svd(((target - moved) * weights[:, None]).T @ (source - center))
        rotmat = u @ vt
        residuals = np.linalg.norm(target - moved - (source - center) @ rotmat.T, axis=-1)
        return rotations.rotmats_to_quats(rotmat), center, moved, residuals

    monkeypatch.setattr(rigid_fit, "_kabsch", mirrored)
    broken = failed(of("degenerate groups"))
    names = {name for _, name in broken}
    assert {"plane: errors match their prediction", "3 points: all points within 8 sigma"} <= names
    assert not any(name.startswith("box") for name in names)


def test_motion_that_is_not_rigid_fails_the_rows_on_distances(monkeypatch):
    honest = rotations.quats_to_rotmats
    monkeypatch.setattr(rotations, "quats_to_rotmats", lambda quats: honest(quats) * (1 + 3e-6))
    names = {name for _, name in failed(of("distances in a body"))}
    assert "1e4 from the origin, to 100 times the observed time" in names
    assert "places 0 from the origin, seen from the body" in names
    assert not any(name.startswith("unit quaternions") for name in names)


def test_a_case_that_raises_fails_with_its_message_and_the_others_still_run():
    def broken():
        raise RuntimeError("no [such] thing")

    found = stability.run([case(broken), case(lambda: 0.5, trace_rk2=broken), case(lambda: math.nan)])
    assert [row.passed for row in found] == [False, True, False]
    assert found[0].message == "RuntimeError: no [such] thing"
    assert math.isnan(found[0].measured) and math.isnan(found[1].trace_rk2)
    console = Console(width=200, file=io.StringIO())
    console.print(stability.make(found))
    assert "no [such] thing" in console.file.getvalue()
    assert stability.summary(found).startswith("1 of 3 cases pass")


def test_a_case_that_takes_too_long_fails_without_counting_preparation(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(stability.time, "process_time", lambda: clock[0])

    def takes(seconds):
        clock[0] += seconds
        return 0.0

    slow = dataclasses.replace(case(lambda: takes(10.5)), prepare=lambda: takes(1.0))
    quick = dataclasses.replace(case(lambda: takes(9.0)), prepare=lambda: takes(100.0))
    found = stability.run([slow, quick])
    assert [row.passed for row in found] == [False, True]
    assert found[0].message == "took 10.5 s of processor time, expected at most 10"


def test_short_trainings_on_extreme_data_stay_finite():
    rows = stability.run(training.CASES)
    assert [(row.name, row.measured, row.message) for row in rows if row.measured != 0] == []


@pytest.mark.slow
def test_the_table_fits_80_columns(rows):
    console = Console(width=80, file=io.StringIO())
    console.print(stability.make(rows))
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert sum("pass" in line for line in lines) == len(rows)


def test_rows_are_valid_json_for_all_values(tmp_path):
    found = stability.run([case(lambda: math.inf, trace_rk2=lambda: math.nan), case(lambda: 0.0)])
    path = stability.write(found, tmp_path / "rows.json")
    read = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert (read["passed"], read["failed"]) == (1, 1)
    assert (read["rows"][0]["measured"], read["rows"][0]["trace_rk2"]) == ("inf", "nan")
    assert set(read["rows"][1]) == {field.name for field in dataclasses.fields(stability.CaseResult)}


def test_the_exit_code_follows_the_rows(monkeypatch, tmp_path, capsys):
    path = tmp_path / "rows.json"
    monkeypatch.setattr(training, "CASES", ())
    monkeypatch.setattr(stability, "CASES", (case(lambda: 0.5),))
    assert main.main(["report", "--stability", "--json", str(path), "--progress", "none"]) == 0
    assert "1 of 1 cases pass" in capsys.readouterr().out
    monkeypatch.setattr(stability, "CASES", (case(lambda: 2.0),))
    assert main.main(["report", "--stability", "--json", str(path), "--progress", "none"]) == 1
    assert "failed: topic: name" in capsys.readouterr().out
    assert json.loads(path.read_text())["failed"] == 1


def test_an_unwritable_path_is_rejected_before_the_work(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(stability, "run", lambda *_, **__: pytest.fail("ran"))
    assert main.main(["report", "--stability", "--json", str(tmp_path / "none" / "rows.json")]) == 3
    assert "create it first" in capsys.readouterr().err


def test_scenes_of_the_table_can_be_stored_in_files():
    validation.check(stability_scenes.every_motion(singles=True), "every motion")
    validation.check(stability_scenes.scene_of([], [], singles=True), "empty")


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.3, 2.0, 20.0])
def test_the_references_agree_with_each_other(size):
    w, v = size * np.array([0.36, 0.48, -0.8]), np.array([0.4, -0.2, 0.1])
    rotmat, displacement = stability_cases.truth(stability_cases.Twist.of(w, v), 1.0)
    exact = stability_cases.exact_exp(w, v)
    np.testing.assert_allclose(rotmat, exact[0], atol=1e-14)
    np.testing.assert_allclose(displacement, exact[1], atol=1e-14)
    cosine = 1 - size**2 * float(stability_cases.ratios(size**2)[1])
    assert cosine == pytest.approx(math.cos(size), abs=1e-12)
