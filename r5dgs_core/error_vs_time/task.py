"""Description of a task of the report: how it is measured, and how its rows are shown, plotted and recommended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..data.dataset import Dataset
from ..evaluation import lpips
from ..scene.scene import Scene
from .report_rows import Row

Measured = tuple[list[Row], list[str]]  # rows, and the reasons for missing measurements


@dataclass(frozen=True)
class Request:
    """Scene, data and settings that a task measures with.

    Attributes:
        scene: The scene.
        dataset: Its data set, or None.
        place: Path of the run folder or scene file, or None.
        tau: Time past t_max at which integrators are compared.
        splits: Splits whose images are compared.
        rounds: Timing rounds.
        clock: Clock of the rows' ``ms``, from `timing.CLOCKS`.
        backend: Rasterizer.
        count: Called with the number of measured images and the total.
        rows: Rows of the tasks before this one.
        perceptual: Network for LPIPS, or None.
    """

    scene: Scene
    dataset: Dataset | None
    place: Path | None
    tau: float
    splits: Sequence[str]
    rounds: int
    clock: str
    backend: str
    count: Callable[[int, int], None]
    rows: Sequence[Row] = ()
    perceptual: lpips.Lpips | None = None

    @property
    def data(self) -> Dataset:
        """The data set, for tasks with `Task.needs_data`."""
        if self.dataset is None:
            raise ValueError("dataset: expected one, got None")
        return self.dataset


def by_mode(row: Row) -> tuple[str, str]:
    """Return the key of rows that share a color: the base of the mode, fitted models apart."""
    return row.mode.split("/")[0], "models" if row.mode == "rigid/fitted" else ""


@dataclass(frozen=True)
class Panel:
    """Panel of the plot of a task.

    Attributes:
        kind: Kind of error.
        label: Label of the axis of errors.
        title: Title of the panel, from its first row and the facts of the scene.
        name: Label of a point.
        floor: Error at which smaller ones are drawn.
        factor: Factor on the errors.
        subject: Work that takes the time.
        series: Key of the rows that share a color.
        in_line: True for the points that the line of their series connects; None for a panel without lines.
        line_name: Label of the line of a series; None for lines without labels.
        label_size: Font size of the labels of points.
        reference: Method without times whose error is drawn as a line across the panel, or None.
        reference_name: Label of that line.
    """

    kind: str
    label: str
    title: Callable[[Row, dict[str, Any]], str]
    name: Callable[[Row], str]
    floor: float
    factor: float = 1.0
    subject: str = "a frame"
    series: Callable[[Row], tuple[str, str]] = by_mode
    in_line: Callable[[Row], bool] | None = None
    line_name: Callable[[tuple[str, str]], str] | None = None
    label_size: float = 8.5
    reference: str | None = None
    reference_name: str = ""


@dataclass(frozen=True)
class Goal:
    """Criterion of the recommendation for a task.

    Attributes:
        kind: Kind of error.
        slack: Maximum loss against the best method that is accepted for speed, in the unit of the error.
        form: Formats an error or a difference of errors.
        name: Name of a method.
        worst_object: True if the object with the largest error counts. A median hides one object that moves on wrongly.
        selectable: False for rows that cannot be recommended.
        remark: Text to append, from all rows of the scene and the recommended one.
    """

    kind: str
    slack: float
    form: Callable[[float], str]
    name: Callable[[Row], str]
    worst_object: bool = False
    selectable: Callable[[Row], bool] = lambda row: True
    remark: Callable[[Sequence[Row], Row], str] = lambda rows, pick: ""


@dataclass(frozen=True)
class Task:
    """A task of the report.

    Attributes:
        name: Name, from `task_names.TASKS`.
        title: Title of the table.
        measure: Measures the task.
        panel: Panel of the plot.
        goal: Criterion of the recommendation.
        needs_data: True if the task compares with a data set.
        counts: True if the task reports its progress by `Request.count`.
        over_objects: True if errors are medians over objects.
        in_seconds: True if times are shown in seconds.
        has_quartiles: False if times are taken once.
    """

    name: str
    title: str
    measure: Callable[[Request], Measured]
    panel: Panel
    goal: Goal
    needs_data: bool = False
    counts: bool = False
    over_objects: bool = False
    in_seconds: bool = False
    has_quartiles: bool = True

    @property
    def time_unit(self) -> tuple[str, float]:
        """Unit in which times are shown, and one millisecond in this unit."""
        return ("s", 1e-3) if self.in_seconds else ("ms", 1.0)


def percent(value: float) -> str:
    """Format a position error or a difference of such errors."""
    return f"{100 * value:.2g} % of the size"


def decibels(value: float) -> str:
    """Format a PSNR or a difference of PSNRs."""
    return f"{value:.2f} dB"


def levels(value: float) -> str:
    """Format an error of pixels or a difference of such errors."""
    return f"{value:.2g} levels"


def method_and_setting(row: Row) -> str:
    """Name a row by its method and setting."""
    return f"{row.method}, {row.setting}"
