"""Laws of timing in interleaved rounds."""

import itertools

import numpy as np
import pytest

from r5dgs_core import timing


def test_rounds_alternate_in_direction_over_all_calls(monkeypatch):
    monkeypatch.setattr(timing, "SAMPLE_MS", 0.0)
    seen = []
    times = timing.take({name: lambda name=name: seen.append(name) for name in "abc"}, 3)
    assert "".join(seen) == "aabbcc" + "abc" + "cba" + "abc"  # two calls each to compile and to see how long one is
    assert set(times) == set("abc") and all(
        (np.diff(t.wall) >= 0).all() and (t.wall >= 0).all() for t in times.values()
    )
    with pytest.raises(ValueError, match="rounds"):
        timing.take({}, 0)


def test_times_add_up_and_scale_and_rows_use_one_clock():
    one, two = (timing.Times(k * np.array([0.5, 1, 2, 3]), k * np.array([3.5, 4, 5, 6])) for k in (1, 2))
    columns = (one + two).scaled(0.5).columns("cpu")
    assert columns == {"clock": "cpu", "ms": 7.5, "ms_low": 6.0, "ms_high": 9.0, "ms_wall": 3.0, "ms_cpu": 7.5}
    assert one.columns()["ms"] == one.ms() == 2.0 and one.ms("cpu") == 5.0


def test_a_coarse_processor_clock_gives_no_zero(monkeypatch):
    ticks = itertools.count()
    monkeypatch.setattr(timing.time, "process_time", lambda: 0.01 * (next(ticks) // 40))
    assert timing.take({"quick": lambda: None}, 1)["quick"].cpu[0] > 0


def test_slow_contenders_leave_after_fewer_rounds(monkeypatch):
    monkeypatch.setattr(timing, "PATIENCE_MS", 0.0)
    turns = []

    class Counted(timing.Contender):
        def take_turn(self):
            turns.append(1)
            return super().take_turn()

    timing.take({"slow": Counted(lambda: None)}, 10)
    assert len(turns) == timing.ENOUGH
