"""Contact sheet of a scene: ground truth, rendering, difference and identity map at four times."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ..data import dataset as datasets
from ..data import images
from ..scene import sampling
from ..scene.scene import Scene
from . import metrics, miou
from .evaluate import Rendering, is_later, render, truth_background

COLUMNS = 4
GAIN = 4.0
PANEL_PX, DPI = 280, 100
BACKGROUND_COLOR, UNKNOWN_COLOR = (0.16, 0.16, 0.18), (1.0, 0.0, 1.0)


def choose_views(dataset: datasets.Dataset) -> tuple[datasets.View, ...]:
    """Pick four views by increasing time, two observed and two past t_max, from one camera if possible.

    Held-out views come first: val (train if empty) for observed times, test for later ones. If a split has too few
    views, the other one fills its columns.
    """
    early, late = dataset.val or dataset.train, dataset.test
    by_camera: dict[str, tuple[list[datasets.View], list[datasets.View]]] = {}
    for place, views in enumerate((early, late)):
        for view in views:
            by_camera.setdefault(view.camera.name, ([], []))[place].append(view)
    shared = [pair for pair in by_camera.values() if pair[0] and pair[1]]
    best = max(shared, key=lambda pair: min(len(pair[0]), 2) + min(len(pair[1]), 2), default=(list(early), list(late)))
    half = COLUMNS // 2
    count = [min(half, len(pair)) for pair in best]
    for place in (0, 1):
        count[place] = min(len(best[place]), COLUMNS - count[1 - place])
    chosen = [view for pair, number in zip(best, count, strict=True) for view in _spread(pair, number)]
    return tuple(sorted(chosen, key=lambda view: view.t))


def write(
    scene: Scene,
    dataset: datasets.Dataset,
    path: Path,
    *,
    views: Sequence[datasets.View] | None = None,
    mode: str = "rigid",
    background: np.ndarray | None = None,
    backend: str = "auto",
) -> Path:
    """Render views of a data set and write the contact sheet.

    Args:
        scene: The scene.
        dataset: Its data set.
        path: PNG file to write.
        views: Columns of the sheet; `choose_views` if None.
        mode: Playback mode past t_max.
        background: Color behind transparent pixels of the true images, sRGB; `truth_background` if None. [3]
        backend: Rasterizer.
    """
    views = choose_views(dataset) if views is None else views
    renderings = [render(scene, view.camera, view.t, mode, backend=backend) for view in views]
    background = truth_background(scene) if background is None else background
    truths = [datasets.load_image(view, background) for view in views]
    masks = [datasets.load_mask(view) for view in views]
    images.write_png(path, draw(scene, views, renderings, truths, masks))
    return path


def draw(
    scene: Scene,
    views: Sequence[datasets.View],
    renderings: Sequence[Rendering],
    truths: Sequence[np.ndarray],
    masks: Sequence[np.ndarray | None],
) -> np.ndarray:
    """Draw the sheet: one column per view; rows are ground truth, rendering, difference and identity map.

    Args:
        scene: The scene, for names, colors and t_max.
        views: The columns, at least one.
        renderings: Rendering of the scene for each view.
        truths: True images. [H, W, 3] each
        masks: True object ids, drawn as outlines, or None. [H, W] each

    Returns:
        The picture. [h, w, 3] uint8
    """
    if not views:
        raise ValueError("views: expected at least one")
    rows = ("ground truth", "ours", f"difference x {GAIN:g}", "identity map")
    aspect = views[0].camera.height / views[0].camera.width
    panel = PANEL_PX / DPI
    left, top, bottom = 0.45, 0.95, 0.75
    width = left + panel * len(views) + 0.1
    height = top + len(rows) * panel * aspect + bottom
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    edges = {"left": left / width, "right": 1 - 0.1 / width, "top": 1 - top / height, "bottom": bottom / height}
    grid = figure.add_gridspec(len(rows), len(views), **edges, wspace=0.03, hspace=0.03)
    figure.suptitle(f"{scene.name}: observed until t_max = {scene.t_max:.3f}", fontsize=12, y=1 - 0.2 / height)
    for column, (view, shown, truth, mask) in enumerate(zip(views, renderings, truths, masks, strict=True)):
        difference = np.clip(GAIN * np.abs(shown.color - truth), 0, 1)
        pictures = (truth, shown.color, difference, color_ids(scene, shown.ids))
        for row, picture in enumerate(pictures):
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(picture, interpolation="nearest", vmin=0, vmax=1)
            axes.set_xticks([])
            axes.set_yticks([])
            if row == 3 and mask is not None:
                for object_id in np.unique(mask[miou.objects_of(mask)]):
                    axes.contour(mask == object_id, levels=[0.5], colors="white", linewidths=0.8)
            if column == 0:
                axes.set_ylabel(rows[row], fontsize=11)
            if row == 0:
                title, color = _title(scene, view, metrics.psnr(shown.color, truth))
                axes.set_title(title, fontsize=9, color=color)
    handles = _legend_handles(scene)
    per_row = max(2, int(width / 1.25))
    figure.legend(handles=handles, loc="lower center", ncols=min(per_row, len(handles)), fontsize=9, frameon=False)
    buffer = io.BytesIO()
    canvas.print_rgba(buffer)
    w, h = canvas.get_width_height()
    return np.frombuffer(buffer.getvalue(), np.uint8).reshape(h, w, 4)[..., :3].copy()


def _title(scene: Scene, view: datasets.View, psnr: float) -> tuple[str, str]:
    """Return the title of a column, and its color."""
    future = is_later(scene, view.t)
    when = f"t = {view.t:.3f}, past t_max" if future else f"t = {view.t:.3f}, observed"
    return f"{when}\n{view.name} ({view.camera.name}), {psnr:.1f} dB", "#a03000" if future else "black"


def _legend_handles(scene: Scene) -> list[Patch]:
    handles = [Patch(facecolor=item.color, edgecolor="0.3", label=item.name) for item in scene.objects if item.id > 0]
    handles.append(Patch(facecolor=BACKGROUND_COLOR, edgecolor="0.3", label="background"))
    handles.append(Patch(facecolor="white", edgecolor="0.3", label="true outline"))
    return handles


def color_ids(scene: Scene, ids: np.ndarray) -> np.ndarray:
    """Color an id map with the objects' colors; background is dark gray, ids without object magenta.

    Args:
        ids: Object ids. [H, W]

    Returns:
        Colors, sRGB. [H, W, 3] float32
    """
    picture = np.full((*ids.shape, 3), UNKNOWN_COLOR, np.float32)
    picture[ids == 0] = BACKGROUND_COLOR
    for item in scene.objects:
        if item.id > 0:
            picture[ids == item.id] = item.color
    return picture


def _spread(views: Sequence[datasets.View], count: int) -> list[datasets.View]:
    """Return at most ``count`` views spread over their times: the last, the first if count > 1, and others between."""
    ordered = sorted(views, key=lambda view: view.t)
    return ordered[-1:] if count == 1 else sampling.spread(ordered, count)
