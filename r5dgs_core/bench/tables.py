"""Tables of a benchmark, as in the paper: for the terminal, as Markdown, and as rows for other programs.

Notation: a record is one case in one mode (docs/user/bench.md). A table row shows the mean over the seeds of one scene,
variant and mode and, if there are several seeds, plus or minus half their range.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

Record = dict[str, Any]
ABSENT = "-"
# The paper's name of a variant in a mode. 5DGS is trained like R5DGS, so either checkpoint can represent it.
PAPER = {
    ("5dgs", "standard"): "5DGS",
    ("r5dgs", "standard"): "5DGS",
    ("r5dgs", "rigid_paper"): "R5DGS",
    ("r5dgs_extra", "rigid_paper"): "R5DGS + extra",
}
OURS = "ours"
UNKNOWN = "unknown"
# Labels of the recorded properties of a machine.
_MACHINE = {
    "processor": "processor",
    "cores": "usable cores",
    "gpu": "GPU",
    "raster_threads": "threads of the rasterizer",
    "torch_threads": "threads of torch",
    "system": "system",
    "versions": "versions",
}
_ORDER = ("5DGS", "R5DGS", "R5DGS + extra", "", OURS)
_QUALITY = (("PSNR", "psnr", "{:.2f}"), ("SSIM", "ssim", "{:.4f}"), ("LPIPS", "lpips", "{:.4f}"))
_QUALITY = (*_QUALITY, ("FLIP", "flip", "{:.4f}"))
_COST = (("CPU s", "cpu_seconds", "{:.0f}"), ("wall s", "wall_seconds", "{:.0f}"), ("MB", "peak_mb", "{:.0f}"))
_PLAYED = (("FPS", "fps", "{:.1f}"), ("motion ms", "ms_motion", "{:.2f}"), ("raster ms", "ms_raster", "{:.2f}"))
_PLAYED = (*_PLAYED, ("CPU ms", "ms_cpu", "{:.2f}"))

_AGAINST = (("PSNR dB", "psnr", "{:+.2f}"), ("objects dB", "psnr_objects", "{:+.2f}"), ("FPS x", "fps", "{:.2f}"))
_AGAINST = (*_AGAINST, ("CPU x", "ms_cpu", "{:.2f}"))


@dataclass(frozen=True)
class Column:
    """Numeric column of a table.

    Attributes:
        label: Heading.
        value: Returns the number of a record, or None.
        form: Format string.
    """

    label: str
    value: Callable[[Record], float | None]
    form: str


@dataclass(frozen=True)
class Sheet:
    """Content of a table, independent of its layout.

    Attributes:
        title: Title.
        head: Column headings; the first ``words`` columns hold text, the others numbers.
        blocks: Rows of each scene, then rows of the mean over scenes.
        caption: Explanation for the reader.
        words: Number of text columns.
    """

    title: str
    head: tuple[str, ...]
    blocks: tuple[tuple[tuple[str, ...], ...], ...]
    caption: str
    words: int = 4


def sheets(result: dict[str, Any]) -> list[Sheet]:
    """Return the tables of a benchmark: quality past t_max, quality in the observed time, speed and mIoU, and, for runs
    played in mode "standard", the other modes relative to it.

    Args:
        result: Result of `bench.benchmark.run_bench`.
    """
    records, failures = result["results"], result["failures"]
    costs = [Column(label, _at("train", key), form) for label, key, form in _COST]
    tables = []
    for split, title in (("test", "Table 1: extrapolation (test)"), ("val", "Table 1, observed time (val)")):
        columns = [Column(label, _at("splits", split, key), form) for label, key, form in _QUALITY]
        tables.append((title, [*columns, *costs], "less is better for LPIPS and FLIP"))
    played = [Column(label, _at("playback", key), form) for label, key, form in _PLAYED]
    overlaps = [Column(f"mIoU {split}", _at("splits", split, "miou"), "{:.3f}") for split in ("test", "val")]
    count = Column("Gaussians", lambda record: record["gaussians"], "{:.0f}")
    note = f"frames of the test views in sequence, medians, color only; {_where(records)}"
    tables.append(("Table 2: speed and identities", [*played, *overlaps, count, costs[0], costs[2]], note))
    data = [(records, failures)] * len(tables)
    if compared := against_standard(records):
        columns = [Column(label, _at("against", key), form) for label, key, form in _AGAINST]
        tables.append(("Table 3: against `standard` of the same run", columns, "differences and ratios on test"))
        data.append((compared, []))
    head = ("scene", "method", "mode", "paper's row")
    seeds = sorted({record["seed"] for record in records})
    spread = f"; seeds {', '.join(map(str, seeds))}: mean ± half the range" if len(seeds) > 1 else ""
    return [
        Sheet(title, (*head, *(column.label for column in columns)), _blocks(*rows, columns), note + spread)
        for (title, columns, note), rows in zip(tables, data, strict=True)
    ]


def to_rich(sheet: Sheet) -> Table:
    """Convert a table for the terminal."""
    table = Table(title=sheet.title, title_justify="left", caption=sheet.caption, caption_justify="left")
    for index, label in enumerate(sheet.head):
        table.add_column(label, justify="left" if index < sheet.words else "right", no_wrap=True)
    for block in sheet.blocks:
        for line in block:
            table.add_row(*line)
        table.add_section()
    return table


def markdown(result: dict[str, Any]) -> str:
    """Return all tables, failures, and the machine and settings, as Markdown."""
    records, parts = result["results"], []
    for sheet in sheets(result):
        rule = ["---"] * sheet.words + ["---:"] * (len(sheet.head) - sheet.words)
        lines = [sheet.head, tuple(rule), *(line for block in sheet.blocks for line in block)]
        rows = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
        parts.append(f"## {sheet.title}\n\n{rows}\n\n{sheet.caption}\n")
    if result["failures"]:
        lines = [f"- {f['scene']}, {f['variant']}, seed {f['seed']}: {f['error']}" for f in result["failures"]]
        parts.append("## Failed runs\n\n" + "\n".join(lines) + "\n")
    settings = result["settings"]
    given = [f"preset {settings['preset']}"] if settings["preset"] else []
    given += [f"configuration {settings['config']}"] if settings["config"] else []
    given += settings["set"]
    parts.append(
        "## Method\n\n"
        f"Settings: {', '.join(given) or 'defaults'}. CPU s, wall s and MB refer to the training process, including "
        "start-up and labels; FPS refers to the measuring process.\n\n" + "\n".join(_machines(records)) + "\n"
    )
    return "\n".join(parts)


def report_rows(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Return rows in the form of ``r5dgs report``: PSNR against training time, and against the time of a frame.

    ``ms`` of training is processor time, or wall time if that is unknown. ``pareto`` is True if no faster row of the
    same task is at least as good.
    """
    rows: list[dict[str, Any]] = []
    for split in ("test", "val"):
        found = [(record, record["splits"][split]["psnr"]) for record in records]
        for task, ms in ((f"training, {split}", training_ms), (f"playback, {split}", _at("playback", "ms_frame"))):
            rows += [
                {
                    "task": f"{record['scene']}, {task}",
                    "mode": record["mode"],
                    "method": method(record),
                    "setting": f"seed {record['seed']}",
                    "error_kind": "psnr",
                    "error": psnr,
                    "ms": ms(record),
                    "pareto": False,
                }
                for record, psnr in found
                if psnr is not None and ms(record) is not None
            ]
    best: dict[str, float] = {}
    for row in sorted(rows, key=lambda row: (row["ms"], -row["error"])):
        row["pareto"] = row["error"] > best.get(row["task"], -float("inf"))
        best[row["task"]] = max(row["error"], best.get(row["task"], -float("inf")))
    return rows


def against_standard(records: Sequence[Record]) -> list[Record]:
    """Return the records of runs that were played in mode "standard", in their other modes, with ``against``.

    ``against`` holds differences of test PSNR over all pixels and over object pixels (dB), and ratios of frames per
    second and of processor time.
    """
    runs = {(r["scene"], r["variant"], r["seed"]): r for r in records if r["mode"] == "standard"}
    found = []
    for record in records:
        base = runs.get((record["scene"], record["variant"], record["seed"]))
        if base is None or record is base:
            continue
        against: dict[str, float | None] = {}
        for key in ("psnr", "psnr_objects"):
            ours, theirs = record["splits"]["test"][key], base["splits"]["test"][key]
            against[key] = None if ours is None or theirs is None else ours - theirs
        for key in ("fps", "ms_cpu"):
            ours, theirs = record["playback"][key], base["playback"][key]
            against[key] = None if ours is None or not theirs else ours / theirs
        found.append({**record, "against": against})
    return found


def method(record: Record) -> str:
    """Return representation and variant: "tracks", "field/r5dgs"."""
    representation, variant = record["representation"], record["variant"]
    return representation if variant == representation else f"{representation}/{variant}"


def training_ms(record: Record) -> float | None:
    """Return the training time in milliseconds: processor time, or wall time if that is unknown."""
    train = record["train"]
    seconds = train["cpu_seconds"] if train["cpu_seconds"] is not None else train["wall_seconds"]
    return None if seconds is None else 1e3 * seconds


def paper_row(variant: str, mode: str, variants: Iterable[str]) -> str:
    """Return the row of the paper's tables that a variant in a mode corresponds to; "ours" if it is new, or "".

    Args:
        variant: The variant.
        mode: Playback mode.
        variants: All variants of the benchmark.
    """
    if mode == "standard" and variant == "r5dgs" and "5dgs" in variants:
        return ""
    return OURS if mode == "rigid" else PAPER.get((variant, mode), "")


def _where(records: Sequence[Record]) -> str:
    """Describe the machine of the timings, or the properties that differ between records."""
    found = {key: sorted({_format(record["machine"], key) for record in records}) for key in _MACHINE}
    differ = [f"{_MACHINE[key]} {' / '.join(said)}" for key, said in found.items() if len(said) > 1]
    if differ:
        return f"not all measured alike, see tables.md: {', '.join(differ)}"
    told = [(key, found[key][0]) for key in ("raster_threads", "processor", "gpu") if found[key]]
    return ", ".join(f"{_MACHINE[key]} {said}" for key, said in told if said != ABSENT)


def _machines(records: Sequence[Record]) -> list[str]:
    """Return a line per machine, threads and versions on which runs were trained or measured.

    If there are several, each line lists its runs.
    """
    lines = []
    for task, where in (("trained", "trained_on"), ("measured", "machine")):
        ran: dict[str, dict[str, None]] = {}
        for record in records:
            text = ", ".join(f"{word} {_format(record[where], key)}" for key, word in _MACHINE.items())
            mode = f" {record['mode']}" if where == "machine" else ""
            who = f"{record['scene']} {record['variant']}{mode} seed {record['seed']}"
            ran.setdefault(text if record[where] else UNKNOWN, {})[who] = None
        differ = len(ran) > 1
        if differ:
            lines += ["", f"Not all runs were {task} alike, so their times do not compare:", ""]
        for text, who in ran.items():
            lines.append(f"- {task}: {text}" + (f" ({'; '.join(who)})" if differ else ""))
    return lines


def _format(machine: dict[str, Any] | None, key: str) -> str:
    """Format a property of a machine."""
    value = (machine or {}).get(key, UNKNOWN)
    if isinstance(value, dict):
        return " ".join(f"{name} {version}" for name, version in value.items())
    return ABSENT if value is None else str(value)


def _at(*path: str) -> Callable[[Record], float | None]:
    """Return a function that looks up a value of a record by a path of keys."""

    def value(record: Record) -> float | None:
        found: Any = record
        for key in path:
            found = found[key]
        return found

    return value


def _blocks(
    records: Sequence[Record], failures: Sequence[dict[str, Any]], columns: Sequence[Column]
) -> tuple[tuple[tuple[str, ...], ...], ...]:
    """Return the rows of each scene, of failed cases, and of the mean over scenes if there are several."""
    variants = {record["variant"] for record in records}
    scenes = list(dict.fromkeys(item["scene"] for item in (*records, *failures)))
    groups: dict[tuple[str, str], dict[str, list[Record]]] = {}
    for record in records:
        groups.setdefault((record["variant"], record["mode"]), {}).setdefault(record["scene"], []).append(record)
    keys = sorted(groups, key=lambda key: (_ORDER.index(paper_row(*key, variants)), key))

    def words(scene: str, key: tuple[str, str]) -> tuple[str, ...]:
        some = next(iter(groups[key].values()))[0]
        return scene, method(some), key[1], paper_row(*key, variants)

    blocks = []
    for scene in scenes:
        lines = [
            (*words(scene, key), *(_cell(groups[key][scene], column) for column in columns))
            for key in keys
            if scene in groups[key]
        ]
        done = {record["variant"] for record in records if record["scene"] == scene}
        failed = dict.fromkeys(method(f) for f in failures if f["scene"] == scene and f["variant"] not in done)
        lines += [(scene, name, "", "", "failed", *[ABSENT] * (len(columns) - 1)) for name in failed]
        blocks.append(tuple(lines))
    if len(scenes) > 1:
        lines = []
        for key in keys:
            if set(groups[key]) == set(scenes):
                means = [_mean_over_scenes(list(groups[key].values()), column) for column in columns]
                lines.append((*words(f"mean of {len(scenes)}", key), *means))
        blocks.append(tuple(lines))
    return tuple(block for block in blocks if block)


def _cell(records: Sequence[Record], column: Column) -> str:
    """Format the mean over seeds, with half their range if there are several; absent if a seed lacks the value."""
    values = [column.value(record) for record in records]
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return ABSENT
    mean = column.form.format(sum(known) / len(known))
    half = column.form.format((max(known) - min(known)) / 2).removeprefix("+")
    return mean if len(known) == 1 else f"{mean} ± {half}"


def _mean_over_scenes(scenes: Sequence[Sequence[Record]], column: Column) -> str:
    """Format the mean of the scenes' means; absent if a scene lacks the value."""
    means = []
    for records in scenes:
        values = [column.value(record) for record in records]
        known = [value for value in values if value is not None]
        if len(known) < len(values):
            return ABSENT
        means.append(sum(known) / len(known))
    return column.form.format(sum(means) / len(means))
