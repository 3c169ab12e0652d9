"""Long operators run step by step in a window, report progress, and clean up however they end."""

import importlib
from types import SimpleNamespace

import pytest

from r5dgs_core import errors

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")


class Window:
    """Stand-in for a context with a window, which the bpy module lacks. Records the calls of an operator."""

    def __init__(self):
        self.said, self.done, self.timers = [], [], 0
        self.window = object()
        self.workspace = SimpleNamespace(status_text_set=self.said.append)
        self.window_manager = SimpleNamespace(
            progress_begin=lambda low, high: self.done.append("begin"),
            progress_update=self.done.append,
            progress_end=lambda: self.done.append("end"),
            modal_handler_add=lambda operator: None,
            event_timer_add=self._add,
            event_timer_remove=self._remove,
        )

    def _add(self, seconds, window):
        self.timers += 1
        return "timer"

    def _remove(self, timer):
        self.timers -= 1


@pytest.fixture
def running(blender, extension, monkeypatch):
    module = importlib.import_module("r5dgs.r5dgs_addon.ui.stepwise_operator")
    monkeypatch.setattr(module, "bpy", SimpleNamespace(app=SimpleNamespace(background=False), types=blender.types))
    return module


def make(running, steps):
    """An operator that runs steps, a window, and the list of its reports."""
    reports = []
    members = {"steps": lambda self, context: steps, "suggest": lambda self, context: True}
    operator = type("Operator", (running.Stepwise,), members)()
    operator.report = lambda kind, text: reports.append((*kind, text))
    return operator, Window(), reports


def begin(running, steps):
    """`make`, and start the operator modally."""
    operator, window, reports = make(running, steps)
    assert operator.invoke(window, None) == {"RUNNING_MODAL"} and window.timers == 1
    return operator, window, reports


def blink(operator, window, kind="TIMER"):
    return operator.modal(window, SimpleNamespace(type=kind))


def tidy(window):
    return window.timers == 0 and window.said[-1] is None and window.done[-1] == "end"


def endless(running, closed):
    """Endless steps that record when they are closed."""
    try:
        while True:
            yield running.Step(0, 9, "frame", slow=True)
    finally:
        closed.append(True)


def test_the_end_is_reported_with_warnings(running):
    def steps():
        for number in range(3):
            yield running.Step(number, 3, f"file {number}")
        return running.Outcome("3 files", ["one is odd"])

    operator, window, reports = begin(running, steps())
    assert blink(operator, window, "MOUSEMOVE") == {"RUNNING_MODAL"}
    assert blink(operator, window) == {"FINISHED"}
    assert reports == [("INFO", "3 files"), ("WARNING", "one is odd")] and tidy(window)
    assert "file 2, 2 of 3" in window.said[-2] and window.done == ["begin", 0, 1 / 3, 2 / 3, "end"]


@pytest.mark.parametrize("why", ["a script asks", "there is no window", "Blender runs in the background"])
def test_scripts_and_background_run_all_steps_immediately(running, monkeypatch, why):
    def steps():
        yield running.Step(0, 1, "frame")
        return running.Outcome("1 file")

    operator, window, reports = make(running, steps())
    window.window = None if why == "there is no window" else window.window
    monkeypatch.setattr(running.bpy.app, "background", why == "Blender runs in the background")
    ask = operator.execute if why == "a script asks" else lambda context: operator.invoke(context, None)
    assert ask(window) == {"FINISHED"} and reports == [("INFO", "1 file")]
    assert window.timers == 0 and window.done == window.said == []


def test_the_remaining_time_follows_from_the_pace_so_far(running, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(running, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def steps():
        for done in range(1, 5):
            now[0] += 2.0
            yield running.Step(done, 4, "frame")
        return running.Outcome("4 files")

    operator, window, _ = begin(running, steps())
    for told in ("1 of 4, 6 s left", "2 of 4, 4 s left", "3 of 4, 2 s left"):
        blink(operator, window)
        assert told in window.said[-1]
    blink(operator, window)
    assert blink(operator, window) == {"FINISHED"}


def test_the_window_announces_a_slow_step_before_it_runs(running):
    packed = []

    def steps():
        yield running.Step(0, 2, "frame")
        yield running.Step(1, 2, "packing", slow=True)
        packed.append(True)
        return running.Outcome("done")

    operator, window, _ = begin(running, steps())
    assert blink(operator, window) == {"RUNNING_MODAL"}
    assert window.said[-1] == "Export: packing" and not packed
    assert blink(operator, window) == {"FINISHED"} and packed


def test_esc_closes_the_steps(running):
    closed = []
    operator, window, reports = begin(running, endless(running, closed))
    assert blink(operator, window) == {"RUNNING_MODAL"} and not closed
    assert blink(operator, window, "ESC") == {"CANCELLED"} and closed
    assert tidy(window) and "stopped" in reports[0][1]


def test_esc_restores_the_window_even_if_cleaning_up_the_steps_fails(running):
    def steps():
        try:
            while True:
                yield running.Step(0, 9, "frame", slow=True)
        finally:
            raise ZeroDivisionError

    operator, window, _ = begin(running, steps())
    blink(operator, window)
    with pytest.raises(ZeroDivisionError):
        blink(operator, window, "ESC")
    assert tidy(window)


def test_unregistering_stops_running_steps_first(running, extension, monkeypatch):
    closed, stop, window = [], running.stop_all, None
    monkeypatch.setattr(running, "stop_all", lambda context: stop(window))  # the module bpy has no window
    operator, window, _ = begin(running, endless(running, closed))
    blink(operator, window)
    assert not closed
    extension.unregister()
    extension.register()
    assert closed == [True] and tidy(window)
    stop(window)
    assert window.timers == 0, "it was stopped twice"


def test_an_error_the_user_can_act_on_is_reported_and_leaves_the_window_as_it_was(running):
    def steps():
        yield running.Step(0, 2, "frame")
        raise errors.ConfigError("expected another")

    operator, window, reports = begin(running, steps())
    assert blink(operator, window) == {"CANCELLED"} and reports == [("ERROR", "expected another")]
    assert tidy(window)


def test_a_fault_in_the_steps_is_raised_and_leaves_the_window_as_it_was(running):
    def steps():
        yield running.Step(0, 2, "frame")
        raise ZeroDivisionError

    operator, window, reports = begin(running, steps())
    with pytest.raises(ZeroDivisionError):
        blink(operator, window)
    assert tidy(window) and reports == []


def test_the_cursor_shows_loading_progress_and_is_restored_after_an_error(running):
    window = Window()
    with pytest.raises(ZeroDivisionError), running.cursor(window) as progress:
        progress(0.4)
        raise ZeroDivisionError
    assert window.done == ["begin", 40.0, "end"]


def test_without_a_window_no_progress_is_shown_at_the_cursor(running):
    window = Window()
    window.window = None
    with running.cursor(window) as progress:
        progress(0.4)
    assert window.done == []
