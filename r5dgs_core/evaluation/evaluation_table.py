"""Terminal tables of an evaluation and of a scene's needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Group
from rich.markup import escape
from rich.table import Table

from . import miou

# Rows of the tables: key in METRICS, label, column name in tables of several modes ("" = omitted), number format.
_SHOWN = (
    ("psnr", "PSNR, mean over images (dB)", "PSNR", "{:.2f}"),
    ("psnr_aligned", "PSNR with aligned cameras (dB)", "aligned", "{:.2f}"),
    ("psnr_explained", "PSNR of explained regions (dB)", "explained", "{:.2f}"),
    ("psnr_pooled", "PSNR of the pooled error (dB)", "", "{:.2f}"),
    ("psnr_objects", "PSNR on object pixels (dB)", "objects", "{:.2f}"),
    ("ssim", "SSIM", "SSIM", "{:.4f}"),
    ("ssim_objects", "SSIM on object pixels", "", "{:.4f}"),
    ("flip", "FLIP (less is better)", "FLIP", "{:.4f}"),
    ("lpips", "LPIPS (less is better)", "LPIPS", "{:.4f}"),
    ("miou", "mIoU, same ids", "mIoU", "{:.3f}"),
    ("miou_matched", "mIoU, matched ids", "", "{:.3f}"),
    ("iou_background", "IoU of the background", "", "{:.3f}"),
    ("ms_motion", "motion, per frame (ms)", "motion", "{:.2f}"),
    ("ms_raster", "rasterization, per frame (ms)", "raster", "{:.1f}"),
    ("images", "images", "", "{:d}"),
)
ABSENT = "not computed"


def make(evaluation: dict[str, Any]) -> Table | Group:
    """Lay out an evaluation (`evaluate.evaluate`): image metrics above, pose errors of the objects below.

    Args:
        evaluation: The evaluation, as in ``evaluation.json``.

    Returns:
        A rich table. With several modes, a table with one row per mode, followed by the pose errors.
    """
    columns = [(split, mode, values) for split, modes in evaluation["splits"].items() for mode, values in modes.items()]
    if len({mode for _, mode, _ in columns}) > 1:
        return Group(_of_modes(evaluation, columns), *_poses(evaluation))
    table = Table(title=_title(evaluation), title_justify="left", caption=_caption(columns), caption_justify="left")
    table.add_column("")
    for split, _, _ in columns:
        table.add_column(split, justify="right")
    padding = [""] * max(0, 2 - len(columns))
    for _ in padding:
        table.add_column("")
    for key, label, _, form in _SHOWN:
        values = [metrics[key] for _, _, metrics in columns]
        if any(value is not None for value in values):
            table.add_row(label, *(ABSENT if value is None else form.format(value) for value in values), *padding)
    table.add_section()
    for label, cells in _overlaps(evaluation, columns):
        table.add_row(label, *cells, *padding)
    table.add_section()
    rest = [""] * max(0, len(columns) - 2)
    rows = [row for row in evaluation["objects"] if row["position_error"] is not None]
    if rows:
        table.add_row("[bold]pose at the last time[/bold]", "position error", "rotation error", *rest)
    for row in rows:
        position, angle = f"{row['position_error']:.4f}", f"{row['rotation_error_deg']:.2f} deg"
        table.add_row(_called(row["name"], row["id"]), position, angle, *rest)
    return table


def _of_modes(evaluation: dict[str, Any], rows: Sequence[tuple[str, str, dict[str, Any]]]) -> Table:
    """Return a table with one row per split and mode; columns without any value are omitted."""
    table = Table(title=_title(evaluation), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.caption, table.caption_justify = f"motion and raster: ms per frame. {_caption(rows)}", "left"
    shown = [
        (key, short, form)
        for key, _, short, form in _SHOWN
        if short and any(metrics[key] is not None for _, _, metrics in rows)
    ]
    for name in ("", *(short for _, short, _ in shown)):
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    before = None
    for split, mode, metrics in rows:
        if split != before:
            table.add_section()
            table.add_row(f"[bold]{split}[/bold]")
        cells = ("-" if metrics[key] is None else form.format(metrics[key]) for key, _, form in shown)
        table.add_row(mode, *cells)
        before = split
    return table


def _caption(columns: Sequence[tuple[str, str, dict[str, Any]]]) -> str:
    """Return the number of images per split and, if computed, the definition of mIoU."""
    counts = {split: (metrics["images"], metrics.get("images_later")) for split, _, metrics in columns}
    parts = []
    for split, (images, later) in counts.items():
        if images and later is not None:
            where = {0: "interpolated", images: "extrapolated"}.get(later, f"{later} of them extrapolated")
            parts.append(f"{split}: {images} held-out images, {where}")
    said = "; ".join(parts)
    if any(metrics["miou"] is not None for _, _, metrics in columns):
        said += f". {miou.DEFINITION}"
    return said


def _overlaps(
    evaluation: dict[str, Any], columns: Sequence[tuple[str, str, dict[str, Any]]]
) -> list[tuple[str, list[str]]]:
    """Return a heading and the rows of the objects' IoU; an empty list without masks."""
    named = {str(row["id"]): row["name"] for row in evaluation["objects"]}
    found = [metrics.get("iou_objects") or {} for _, _, metrics in columns]
    ids = sorted({key for values in found for key in values}, key=int)
    rows: list[tuple[str, list[str]]] = []
    for key in ids:
        cells = []
        for _, _, metrics in columns:
            same = (metrics.get("iou_objects") or {}).get(key)
            cell = "not shown" if same is None else f"{same:.3f}"
            other = (metrics.get("id_map") or {}).get(key)
            if same is not None and other is not None and str(other) != key:
                cell += f" ({metrics['iou_objects_matched'][key]:.3f} as {other})"
            cells.append(cell)
        rows.append((_called(named[key], key) if key in named else f"id {key}", cells))
    return [("[bold]IoU of each object, same ids[/bold]", [""] * len(columns)), *rows] if rows else []


def _called(name: str, object_id: int | str) -> str:
    """Return name and id of an object, with markup brackets in the name escaped."""
    return f"{escape(name)} ({object_id})"


def _poses(evaluation: dict[str, Any]) -> list[Table]:
    """Return the table of pose errors, always for mode "rigid"; an empty list without true poses."""
    rows = [row for row in evaluation["objects"] if row["position_error"] is not None]
    if not rows:
        return []
    table = Table(title="pose at the last time, mode rigid", title_justify="left")
    for name, side in (("", "left"), ("position error", "right"), ("rotation error", "right")):
        table.add_column(name, justify=side)  # type: ignore[arg-type]
    for row in rows:
        errors = (f"{row['position_error']:.4f}", f"{row['rotation_error_deg']:.2f} deg")
        table.add_row(_called(row["name"], row["id"]), *errors)
    return [table]


def needs(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the table of a scene's needs, for the whole scene and then per object.

    Args:
        rows: ``Scene.needs``.

    Returns:
        A rich table.
    """
    table = Table(title="needs of the scene", title_justify="left")
    for name, side in (("", "left"), ("need", "left"), ("value", "right"), ("threshold", "right"), ("", "left")):
        table.add_column(name, justify=side)  # type: ignore[arg-type]
    table.add_column("meaning of the value", overflow="fold")
    owner = None
    for row in rows:
        if row.get("object") != owner:
            table.add_section()
        shown = "" if row.get("object") == owner else escape(str(row.get("object", "")))
        owner = row.get("object")
        numbers = (f"{float(row.get(key, float('nan'))):.4g}" for key in ("value", "threshold"))
        table.add_row(
            shown, str(row.get("name", "")), *numbers, str(row.get("decision", "")), escape(str(row.get("reason", "")))
        )
    return table


def _title(evaluation: dict[str, Any]) -> str:
    train = evaluation["train"]
    parts = [escape(str(evaluation["scene"]))]
    if train.get("gaussians") is not None:
        parts.append(f"{train['gaussians']} Gaussians")
    if train.get("iterations") is not None:
        parts.append(f"{train['iterations']} iterations")
    if train.get("seconds") is not None:
        parts.append(f"trained in {train['seconds']:.0f} s")
    return ", ".join(parts)
