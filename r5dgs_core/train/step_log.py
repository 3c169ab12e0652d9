"""Log of a run: one JSON object per logged step, in a file that a resumed run continues."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .. import atomic_files
from ..errors import CheckpointError


class StepLog:
    """The log, open for further events. A context manager.

    Args:
        path: The file; created if it is missing.

    Raises:
        CheckpointError: The file cannot be written.
    """

    def __init__(self, path: Path):
        self._path = path
        try:
            self._stream = open(path, "a", encoding="utf-8")  # noqa: SIM115  (closed by __exit__)
        except OSError as error:
            raise CheckpointError(f"{path}: cannot be written: {error}") from error

    def __enter__(self) -> StepLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def append(self, event: dict[str, Any]) -> None:
        """Write an event as a line. Raises CheckpointError if that fails."""
        try:
            self._stream.write(json.dumps(event) + "\n")
            self._stream.flush()
        except OSError as error:
            place = f"{self._path}: cannot be written: {error}"
            raise CheckpointError(f"{place}; free disk space and continue with --resume") from error


def read(path: Path) -> list[dict[str, Any]]:
    """Return the events of a log, up to the first incomplete line."""
    events = []
    for line in path.read_bytes().splitlines():
        event = _parse(line)
        if event is None:
            break
        events.append(event)
    return events


def clean_up(path: Path, iteration: int) -> None:
    """Drop incomplete lines of a log, and lines of steps after ``iteration``, which will be taken again."""
    kept = []
    try:
        if not path.exists():
            return
        for line, event in zip(path.read_bytes().splitlines(), read(path), strict=False):
            if event["iteration"] > iteration:
                break
            kept.append(line + b"\n")
        atomic_files.write(path, b"".join(kept))
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be written: {error}") from error


def processor_start(path: Path, now: float) -> float | None:
    """Return a reading of the processor clock minus the processor time of earlier sessions in a log.

    The result is None if the last line has no processor time, as in logs of older versions.

    Raises:
        CheckpointError: The file cannot be read.
    """
    try:
        lines = path.read_bytes().splitlines() if path.exists() else []
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error}") from error
    event = _parse(lines[-1]) if lines else {"cpu_seconds": 0.0}
    return now - event["cpu_seconds"] if event and "cpu_seconds" in event else None


def _parse(line: bytes) -> dict[str, Any] | None:
    """Return the event of a line of the log; None if the line is incomplete."""
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) and isinstance(event.get("iteration"), int) else None
