"""Progress of long operations: live bars in a terminal, one JSON object per line for programs, plain lines in a log."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from . import terminal
from .time_left import TimedProgress

Event = dict[str, Any]
Progress = Callable[[Event], None]
PLAIN_EVERY_S = 10.0
LABELS = {"step": "train", "identity": "identities"}  # labels of bars; the default is the name of the event


@contextmanager
def make(kind: str) -> Iterator[TimedProgress]:
    """Yield a function that shows events and adds the remaining seconds to counted ones.

    Args:
        kind: "auto" (bars in a terminal, else a plain line per phase and every ten seconds), "json" or "none".
    """
    if kind == "json":
        yield TimedProgress(lambda event: print(json.dumps(event), flush=True))
    elif kind == "none":
        yield TimedProgress(lambda event: None)
    elif sys.stdout.isatty():
        with _rich() as show:
            yield TimedProgress(show)
    else:
        yield TimedProgress(_plain())


@contextmanager
def _rich() -> Iterator[Progress]:
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    columns = [
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[count]}"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}", markup=False),  # paths and names may contain markup brackets
    ]
    with Progress(*columns, console=terminal.console()) as bars:
        tasks: dict[str, TaskID] = {}
        waiting: list[TaskID] = []
        steps = [0]
        last = _remembering()

        def show(event: Event) -> None:
            event = last(event)
            name, position = str(event["event"]), count_of(event)
            for task in waiting:  # a phase without a count is finished when the next event arrives
                bars.update(task, total=1, completed=1)
            waiting.clear()
            if name == "start":
                steps[0] = event["iterations"]
            elif position is not None:
                done, total = position[0], position[1] or steps[0]
                if name not in tasks:
                    tasks[name] = bars.add_task(LABELS.get(name, name), total=total, count="", note="")
                bars.update(tasks[name], completed=done, count=f"{done}/{total}", note=describe(event))
            elif "text" in event:
                waiting.append(bars.add_task(name, total=None, count="", note=event["text"]))

        yield show


def _plain() -> Progress:
    last: dict[str, float] = {}
    remembered = _remembering()

    def show(event: Event) -> None:
        event = remembered(event)
        now, position = time.monotonic(), count_of(event)
        if position is None:
            print(f"{event['event']}: {describe(event)}", flush=True)
        elif position[0] == position[1] or now - last.get(event["event"], -PLAIN_EVERY_S) >= PLAIN_EVERY_S:
            last[event["event"]] = now
            total = f" of {event['total']} {event.get('unit', 'images')}" if "total" in event else ""
            text = describe(event)
            print(f"{event['event']} {position[0]}{total}{text and ': ' + text}", flush=True)

    return show


def _remembering() -> Callable[[Event], Event]:
    """Return a function that adds the last held-out PSNR of the run to step events without one."""
    known: Event = {}

    def complete(event: Event) -> Event:
        if event["event"] == "start":
            known.clear()
        if event["event"] != "step":
            return event
        known.update({key: event[key] for key in ("val_psnr",) if key in event})
        return {**known, **event}

    return complete


def count_of(event: Event) -> tuple[int, int | None] | None:
    """Return the position of a counted event and its end, if known; None for other events."""
    if "iteration" in event:
        return event["iteration"], event.get("iterations")
    if "done" in event:
        return event["done"], event["total"]
    return None


def describe(event: Event) -> str:
    """Return a short description of an event."""
    parts = []
    if "text" in event:
        parts.append(event["text"])
    if "loss" in event:
        parts.append(f"loss {event['loss']:.4f}")
    if "val_psnr" in event:
        parts.append(f"held-out {event['val_psnr']:.1f} dB")
    if "gaussians" in event:
        parts.append(f"{event['gaussians']} Gaussians")
    if "seconds_left" in event:
        parts.append(f"{event['seconds_left']:.0f} s left")
    if "iterations" in event and "loss" not in event:
        parts.append(f"{event['iterations']} steps")
    if event.get("from"):
        parts.append(f"continuing at step {event['from']}")
    return terminal.printable(", ".join(parts))
