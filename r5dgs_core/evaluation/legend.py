"""Legend of a scene: a picture with its objects outlined, tinted and named.

Pixels are counted from the upper left corner, except in boxes for `label_placement`, which use the lower left corner.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence

import numpy as np
from matplotlib import patheffects
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.transforms import IdentityTransform
from scipy import ndimage

from ..render import viewpoints
from ..scene import cameras
from ..scene.scene import Scene, SceneObject
from . import evaluate, label_placement

LONGEST = 1024  # minimum pixels along the longer side, so that names are legible for images of any size
TINT = 0.3  # share of an object's color mixed into its pixels
ROOM = 0.9  # share of a name's box that its object must cover for the name to be written on it
BEHIND = 0.6  # brightness factor of the background
MIN_LETTER_HEIGHT = 10.0  # minimum height of letters, pixels
DPI = 100
_DARK, _LIGHT, _FAINT = "#101014", "#ffffff", "#8c8c94"


def draw(
    scene: Scene,
    viewpoint: viewpoints.Viewpoint,
    mode: str = "rigid",
    *,
    longest: int | None = None,
    backend: str = "auto",
) -> np.ndarray:
    """Draw the legend of a scene.

    Args:
        scene: The scene.
        viewpoint: Camera and time.
        mode: Playback mode past t_max.
        longest: Pixels along the longer side; those of the camera, but at least `LONGEST`, if None.
        backend: Rasterizer.

    Returns:
        The picture with a strip below that lists all objects. [h, w, 3] uint8
    """
    camera = viewpoint.camera
    longest = max(camera.width, camera.height, LONGEST) if longest is None else longest
    camera = cameras.resized(camera, longest)
    shown = evaluate.render(scene, camera, viewpoint.t, mode, backend=backend)
    future = evaluate.is_later(scene, viewpoint.t)
    when = f"t = {viewpoint.t:.4g}, past t_max = {scene.t_max:.4g}" if future else f"t = {viewpoint.t:.4g}"
    return annotate(scene, shown.color, shown.ids, f"{scene.name}, camera {camera.name or '-'}, {when}")


def annotate(scene: Scene, color: np.ndarray, ids: np.ndarray, title: str) -> np.ndarray:
    """Outline, tint and name the objects of a picture.

    Args:
        scene: The scene, for names and colors.
        color: The picture, sRGB in [0, 1]. [H, W, 3]
        ids: Object of each pixel. [H, W]
        title: First entry of the strip.

    Returns:
        The picture with the strip below. [h, W, 3] uint8
    """
    with warnings.catch_warnings():
        # Letters missing from the font become squares; the id beside them still identifies the object.
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        return _annotate(scene, color, ids, title)


def _annotate(scene: Scene, color: np.ndarray, ids: np.ndarray, title: str) -> np.ndarray:
    height, width = ids.shape
    font_px = max(max(width, height) / 60, MIN_LETTER_HEIGHT)
    listed = [item for item in scene.objects if item.id > 0]
    strip = _Strip(listed, set(np.unique(ids).tolist()), title, width, font_px)
    figure = Figure(figsize=(width / DPI, (height + strip.height) / DPI), dpi=DPI, facecolor=_DARK)
    canvas = FigureCanvasAgg(figure)
    picture = np.zeros((height + strip.height, width, 3), np.float32)
    picture[:height] = _painted(color, ids, listed, max(round(font_px / 8), 1))
    picture[height:] = 0.07
    figure.figimage(picture, origin="upper", vmin=0, vmax=1)
    strip.draw(figure)
    _name(figure, ids, listed, strip.height, font_px)
    buffer = io.BytesIO()
    canvas.print_rgba(buffer)
    w, h = canvas.get_width_height()
    return np.frombuffer(buffer.getvalue(), np.uint8).reshape(h, w, 4)[..., :3].copy()


def middle(mask: np.ndarray) -> tuple[float, float, float]:
    """Return the point deepest inside the largest part of a non-empty mask.

    Returns:
        Column and row of the pixel's center, and its distance from the edge in pixels.
    """
    parts, count = ndimage.label(mask)  # type: ignore[misc]
    if count > 1:
        mask = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    depth = np.asarray(ndimage.distance_transform_edt(np.pad(mask, 1)))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(depth)), mask.shape)
    return float(column) + 0.5, float(row) + 0.5, float(depth[row, column])


def _painted(color: np.ndarray, ids: np.ndarray, listed: Sequence[SceneObject], line: int) -> np.ndarray:
    """Return the picture with tints, outlines ``line`` pixels wide, and a dark seam around them. [H, W, 3]"""
    picture = np.clip(color, 0, 1).astype(np.float32)
    known = np.isin(ids, [item.id for item in listed])
    picture[~known] *= BEHIND
    square = np.ones((3, 3), bool)
    for item in listed:
        mask = ids == item.id
        if not mask.any():
            continue
        own = np.asarray(item.color, np.float32)
        picture[mask] = (1 - TINT) * picture[mask] + TINT * own
        seam = np.asarray(ndimage.binary_dilation(mask, square, line), bool) & ~known
        picture[seam] *= 0.35
        inner = np.asarray(ndimage.binary_erosion(mask, square, line, border_value=True), bool)
        picture[mask & ~inner] = own
    return picture


def _halo(font_px: float) -> list[patheffects.AbstractPathEffect]:
    return [patheffects.withStroke(linewidth=0.25 * font_px * 72 / DPI, foreground=_DARK)]


def _write(figure: Figure, x: float, y: float, text: str, font_px: float, color: str = _LIGHT):
    """Draw light text with a dark halo, its lower left corner at a pixel of the figure, without math markup."""
    return figure.text(
        x, y, text, transform=IdentityTransform(), fontsize=font_px * 72 / DPI, color=color, va="bottom", ha="left",
        parse_math=False, path_effects=_halo(font_px),
    )  # fmt: skip


def _extent(figure: Figure, text: str, font_px: float) -> tuple[float, float]:
    """Return width, with some margin, and height of a text in pixels."""
    drawn = _write(figure, 0, 0, text, font_px)
    box = drawn.get_window_extent(FigureCanvasAgg(figure).get_renderer())
    drawn.remove()
    return 1.04 * box.width + 1, box.height  # text with a halo is drawn as outlines, which are wider


def _name(figure: Figure, ids: np.ndarray, listed: Sequence[SceneObject], bottom: int, font_px: float) -> None:
    """Write names on the objects, or beside small ones; shortened to the id, or omitted, if there is no room."""
    height, width = ids.shape
    found = [(int((ids == item.id).sum()), item) for item in listed]
    found = sorted((pair for pair in found if pair[0]), key=lambda pair: -pair[0])
    if not found:
        return
    inside = np.array([middle(ids == item.id) for _, item in found])
    points, depths = inside[:, :2], inside[:, 2]
    points[:, 1] = bottom + height - points[:, 1]
    frame = np.array([0, bottom, width, bottom + height]) + 0.25 * font_px * np.array([1, 1, -1, -1])
    texts = [f"{item.id} {item.name}" for _, item in found]
    sizes = np.array([_extent(figure, text, font_px) for text in texts])
    boxes: list[np.ndarray | None] = [None] * len(found)
    for k, (_, item) in enumerate(found):
        box = np.concatenate([points[k] - sizes[k] / 2, points[k] + sizes[k] / 2])
        left, low, right, high = np.rint(box - [0, bottom, 0, bottom]).astype(int)
        under = ids[max(height - high, 0) : max(height - low, 0), max(left, 0) : max(right, 0)]
        if under.size and (under == item.id).sum() >= ROOM * (high - low) * (right - left):
            boxes[k] = box
    on = np.array([box is not None for box in boxes])
    # A label beside an object covers no object if there is room for that; otherwise it only avoids their middles.
    middles = np.concatenate([points - 0.7 * depths[:, None], points + 0.7 * depths[:, None]], axis=1)
    everything = _cells(np.isin(ids, [item.id for _, item in found]), bottom, font_px)
    for k in np.flatnonzero(~on):
        whole, short = texts[k], str(found[k][1].id)
        for text, hidden in ((whole, everything), (whole, middles), (short, everything), (short, middles)):
            taken = np.concatenate([hidden, *(box[None] for box in boxes if box is not None)])
            texts[k] = text
            boxes[k] = _beside(points[k], np.array(_extent(figure, text, font_px)), frame, taken, font_px)
            if boxes[k] is not None:
                break
    for point, box, text, named_on, (_, item) in zip(points, boxes, texts, on, found, strict=True):
        if box is None:
            continue
        if not named_on:
            _lead(figure, point, np.clip(point, box[:2], box[2:]), item, font_px)
        _write(figure, box[0], box[1], text, font_px)


def _cells(mask: np.ndarray, bottom: int, font_px: float) -> np.ndarray:
    """Return boxes that cover a mask: the non-empty squares of a grid of half a letter's height. [B, 4]"""
    side = max(round(0.5 * font_px), 1)
    height, width = mask.shape
    padded = np.pad(mask, ((0, -height % side), (0, -width % side)))
    rows, columns = np.nonzero(padded.reshape(len(padded) // side, side, -1, side).any(axis=(1, 3)))
    left, high = columns * side, bottom + height - rows * side
    return np.stack([left, high - side, left + side, high], axis=1).astype(np.float64)


def _beside(
    point: np.ndarray, size: np.ndarray, frame: np.ndarray, taken: np.ndarray, font_px: float
) -> np.ndarray | None:
    """Return the box of one name near its point, scaled with the letters; None if no place is free. [4]"""
    unit = font_px / 17  # `label_placement` uses distances for letters 17 pixels high
    (box,) = label_placement.place(point[None] / unit, size[None] / unit, frame / unit, taken / unit)
    return None if box is None else box * unit


def _lead(figure: Figure, point: np.ndarray, end: np.ndarray, item: SceneObject, font_px: float) -> None:
    """Draw a line from an object's middle, marked with a dot, to its name."""
    pixels, thin = np.stack([point, end]), 0.12 * font_px * 72 / DPI
    dark = [patheffects.withStroke(linewidth=3 * thin, foreground=_DARK)]
    for ends, marker in ((pixels, ""), (pixels[:1], "o")):
        figure.add_artist(
            Line2D(
                ends[:, 0],
                ends[:, 1],
                transform=IdentityTransform(),
                color=item.color,
                linewidth=thin,
                marker=marker,
                markersize=4 * thin,
                path_effects=dark,
            )  # fmt: skip
        )


class _Strip:
    """List of all objects below the picture: color square, id and name; faint if the object is not seen."""

    def __init__(self, listed: Sequence[SceneObject], seen: set[int], title: str, width: int, font_px: float):
        self._font, self._row = font_px, round(1.7 * font_px)
        measure = Figure(figsize=(1, 1), dpi=DPI)
        self._entries: list[tuple[float, int, SceneObject | None, str]] = []
        x, row, gap = 0.6 * font_px, 0, 1.2 * font_px
        entries: list[tuple[SceneObject | None, str]] = [(None, title)]
        entries += [(item, f"{item.id} {item.name}{'' if item.id in seen else ' (not seen)'}") for item in listed]
        for item, text in entries:
            wide = _extent(measure, text, font_px)[0] + (0 if item is None else font_px)
            if x + wide > width - 0.6 * font_px and x > 0.6 * font_px:
                x, row = 0.6 * font_px, row + 1
            self._entries.append((x, row, item, text))
            x, row = (0.6 * font_px, row + 1) if item is None else (x + wide + gap, row)
        rows = 1 + max(entry[1] for entry in self._entries)
        self._seen, self.height = seen, round(rows * self._row + 0.6 * font_px)

    def draw(self, figure: Figure) -> None:
        for x, row, item, text in self._entries:
            y = self.height - 0.3 * self._font - (row + 1) * self._row + 0.3 * self._font
            if item is None:
                _write(figure, x, y, text, self._font)
                continue
            side = 0.7 * self._font
            figure.add_artist(
                Rectangle((x, y + 0.25 * self._font), side, side, transform=IdentityTransform(), facecolor=item.color)
            )
            faint = item.id not in self._seen
            _write(figure, x + self._font, y, text, self._font, _FAINT if faint else _LIGHT)
