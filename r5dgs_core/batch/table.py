"""Table of the captures of a batch, for the terminal and as Markdown."""

from __future__ import annotations

from typing import Any

from rich.table import Table

MODE = "rigid"  # playback mode of the figures
COLUMNS = ("capture", "Gaussians", "training s", "PSNR val", "PSNR test", "SSIM test", "mIoU test", "failure")


def rows(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the cells of a result (`jobs.run`), in the order of `COLUMNS`."""
    found = []
    for name, evaluation in result["captures"].items():
        train, splits = evaluation["train"], evaluation["splits"]
        val, test = (splits.get(split, {}).get(MODE, {}) for split in ("val", "test"))
        found.append(
            (
                name,
                _number(train.get("gaussians"), 0),
                _number(train.get("seconds"), 0),
                _number(val.get("psnr"), 2),
                _number(test.get("psnr"), 2),
                _number(test.get("ssim"), 4),
                _number(test.get("miou"), 3),
                "",
            )
        )
    return found + [(name, *[""] * (len(COLUMNS) - 2), reason) for name, reason in result["failures"].items()]


def markdown(result: dict[str, Any]) -> str:
    """Return the table of a result as Markdown."""
    lines = [COLUMNS, tuple("---" for _ in COLUMNS), *rows(result)]
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in lines)


def to_rich(result: dict[str, Any]) -> Table:
    """Return the table of a result for the terminal."""
    table = Table(*COLUMNS)
    for row in rows(result):
        table.add_row(*row)
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
