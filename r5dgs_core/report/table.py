"""An evaluation, and what a scene needs, as tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table

# Rows of the table: key in METRICS, what the user reads, format.
_ROWS = (
    ("psnr", "PSNR, mean over images (dB)", "{:.2f}"),
    ("psnr_pooled", "PSNR of the pooled error (dB)", "{:.2f}"),
    ("psnr_objects", "PSNR on object pixels (dB)", "{:.2f}"),
    ("ssim", "SSIM", "{:.4f}"),
    ("ssim_objects", "SSIM on object pixels", "{:.4f}"),
    ("flip", "FLIP (less is better)", "{:.4f}"),
    ("lpips", "LPIPS (less is better)", "{:.4f}"),
    ("miou", "mIoU, same ids", "{:.3f}"),
    ("miou_matched", "mIoU, matched ids", "{:.3f}"),
    ("ms_motion", "motion, per frame (ms)", "{:.2f}"),
    ("ms_raster", "rasterization, per frame (ms)", "{:.1f}"),
    ("images", "images", "{:d}"),
)
_CAPTION = "val: held-out views in the observed time; test: later times (as the data set splits them)"
ABSENT = "not computed"


def make(evaluation: dict[str, Any]) -> Table:
    """Lay out an evaluation (`evaluate.evaluate`): images above, pose errors of the objects below.

    Args:
        evaluation: The evaluation, as in ``evaluation.json``.

    Returns:
        The table, to print with rich.
    """
    columns = [(split, mode, values) for split, modes in evaluation["splits"].items() for mode, values in modes.items()]
    several = len({mode for _, mode, _ in columns}) > 1
    table = Table(title=_title(evaluation), title_justify="left", caption=_CAPTION, caption_justify="left")
    table.add_column("")
    for split, mode, _ in columns:
        table.add_column(f"{split} {mode}" if several else split, justify="right")
    padding = [""] * max(0, 2 - len(columns))
    for _ in padding:
        table.add_column("")
    for key, label, form in _ROWS:
        values = [metrics[key] for _, _, metrics in columns]
        if any(value is not None for value in values):
            table.add_row(label, *(ABSENT if value is None else form.format(value) for value in values), *padding)
    table.add_section()
    rest = [""] * max(0, len(columns) - 2)
    rows = [row for row in evaluation["objects"] if row["position_error"] is not None]
    if rows:
        table.add_row("[bold]pose at the last time[/bold]", "position error", "rotation error", *rest)
    for row in rows:
        position, angle = f"{row['position_error']:.4f}", f"{row['rotation_error_deg']:.2f} deg"
        table.add_row(f"{row['name']} ({row['id']})", position, angle, *rest)
    return table


def needs(rows: Sequence[dict[str, Any]]) -> Table:
    """The needs table of a scene: of the whole, then object by object.

    Args:
        rows: ``Scene.needs``.

    Returns:
        The table, to print with rich.
    """
    table = Table(title="what the scene needs", title_justify="left")
    for name, side in (("", "left"), ("need", "left"), ("value", "right"), ("threshold", "right"), ("", "left")):
        table.add_column(name, justify=side)  # type: ignore[arg-type]
    table.add_column("what the value is", overflow="fold")
    owner = None
    for row in rows:
        if row.get("object") != owner:
            table.add_section()
        shown = "" if row.get("object") == owner else row.get("object", "")
        owner = row.get("object")
        numbers = (f"{float(row.get(key, float('nan'))):.4g}" for key in ("value", "threshold"))
        table.add_row(
            shown, str(row.get("name", "")), *numbers, str(row.get("decision", "")), str(row.get("reason", ""))
        )
    return table


def _title(evaluation: dict[str, Any]) -> str:
    train = evaluation["train"]
    parts = [str(evaluation["scene"])]
    if train.get("gaussians") is not None:
        parts.append(f"{train['gaussians']} Gaussians")
    if train.get("iterations") is not None:
        parts.append(f"{train['iterations']} iterations")
    if train.get("seconds") is not None:
        parts.append(f"trained in {train['seconds']:.0f} s")
    return ", ".join(parts)
