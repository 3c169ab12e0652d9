"""Rows of the report: the front, round trips, fair turns, and names that do not overlap."""

import csv
import io
import json
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core.error_vs_time import report_rows
from r5dgs_core.error_vs_time.report_rows import Row
from r5dgs_core.evaluation import label_placement

SHAPE = ("scene", "task", "mode", "method", "setting", "error_kind", "error", "ms", "clock", "pareto")


def row(error=1.0, ms=1.0, kind="position", task="dynamics", spread=0.0, **more):
    return Row(task, "rigid", "m", "s", kind, error, ms, ms_low=ms - spread, ms_high=ms + spread, **more)


def test_rows_survive_json_and_csv():
    some = [row(0.25, 0.125, "position@t=0.8", note='a "note", with a comma', count=3), row(1.0, math.nan)]
    back = report_rows.from_dicts(json.loads(json.dumps([r.to_dict() for r in some], allow_nan=False)))
    np.testing.assert_equal([r.to_dict() for r in back], [r.to_dict() for r in some])
    table = list(csv.DictReader(io.StringIO(report_rows.to_csv(some))))
    assert tuple(table[0])[: len(SHAPE)] == SHAPE
    assert float(table[0]["error"]) == 0.25 and table[0]["note"] == some[0].note and table[1]["ms"] == ""


def test_spread_is_median_quartiles_and_worst():
    found = report_rows.spread(np.array([1.0, 2.0, 3.0, 4.0, 100.0]))
    assert found == {"error": 3.0, "error_low": 2.0, "error_high": 4.0, "error_worst": 100.0}
    assert report_rows.spread(np.array([1.0, 3.0, 2.0]), names=("a", "b", "c"))["worst_name"] == "b"
    assert report_rows.spread(np.array([1.0, 2.0]), more_is_better=True)["error_worst"] == 1.0
    assert all(math.isnan(v) for v in report_rows.spread(np.array([])).values())


@given(st.integers(0, 2**32 - 1), st.integers(1, 25))
def test_labels_never_overlap_cover_a_point_or_leave_the_frame(seed, count):
    rng = np.random.default_rng(seed)
    points, sizes = rng.uniform(20, 380, (count, 2)), rng.uniform([10, 8], [90, 14], (count, 2))
    markers = np.concatenate([points - 3, points + 3], axis=1)
    frame = np.array([0, 0, 400, 400.0])
    boxes = label_placement.place(points, sizes, frame, markers)
    kept = np.array([box for box in boxes if box is not None]).reshape(-1, 4)
    for i, box in enumerate(kept):
        assert (
            not label_placement.overlaps(box, np.delete(kept, i, axis=0)).any()
            and not label_placement.overlaps(box, markers).any()
        )
        assert (box[:2] >= frame[:2]).all() and (box[2:] <= frame[2:]).all()
    for box, size in zip(boxes, sizes, strict=True):
        if box is not None:
            np.testing.assert_allclose(box[2:] - box[:2], size)


def test_a_label_that_does_not_fit_is_omitted():
    point, size = np.array([[10.0, 10.0]]), np.array([[50.0, 10.0]])
    assert label_placement.place(point, size, np.array([0, 0, 20, 20.0]), np.zeros((0, 4))) == [None]
