"""Progress of long work: a live line in a terminal, one JSON object per line for programs, plain lines in a log."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

Event = dict[str, Any]
Progress = Callable[[Event], None]
PLAIN_EVERY_S = 10.0


@contextmanager
def make(kind: str) -> Iterator[Progress]:
    """A function that shows events.

    Args:
        kind: "auto" (rich in a terminal, else a plain line every ten seconds), "json" or "none".
    """
    if kind == "json":
        yield lambda event: print(json.dumps(event), flush=True)
    elif kind == "none":
        yield lambda event: None
    elif sys.stdout.isatty():
        with _rich() as show:
            yield show
    else:
        yield _plain()


@contextmanager
def _rich() -> Iterator[Progress]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = [
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    ]
    with Progress(*columns) as bars:
        tasks: dict[str, Any] = {}

        def show(event: Event) -> None:
            if event["event"] == "start":
                tasks["step"] = bars.add_task("train", total=event["iterations"], note="preparing")
            elif event["event"] in ("step", "identity"):
                name = event["event"]
                if name not in tasks:
                    tasks[name] = bars.add_task("identities", total=event["iterations"], note="")
                bars.update(tasks[name], completed=event["iteration"], note=describe(event))

        yield show


def _plain() -> Progress:
    last = [0.0]

    def show(event: Event) -> None:
        now = time.monotonic()
        if event["event"] not in ("step", "identity"):
            print(f"{event['event']}: {describe(event)}", flush=True)
        elif now - last[0] >= PLAIN_EVERY_S:
            last[0] = now
            print(f"{event['event']} {event['iteration']}: {describe(event)}", flush=True)

    return show


def describe(event: Event) -> str:
    """An event in a few words."""
    parts = []
    if "loss" in event:
        parts.append(f"loss {event['loss']:.4f}")
    if "gaussians" in event:
        parts.append(f"{event['gaussians']} Gaussians")
    if "seconds_left" in event:
        parts.append(f"{event['seconds_left']:.0f} s left")
    if "iterations" in event and "loss" not in event:
        parts.append(f"{event['iterations']} steps")
    return ", ".join(parts)
