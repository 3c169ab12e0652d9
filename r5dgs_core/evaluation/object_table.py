"""Tables of a scene's objects: visibility, motion and confidence of the label of each; errors of its motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from ..data import dataset as datasets
from ..playback import scene_player
from ..render import viewpoints
from ..scene import predictability, sampling
from ..scene.motion_words import motion_of
from ..scene.scene import MotionGroup, Scene
from ..scene.splats import to_opacities
from . import evaluate, miou

MAX_VIEWS = 24  # maximum number of views in which pixels are counted


@dataclass(frozen=True)
class ObjectRow:
    """Row of the table.

    Attributes:
        id: Object id; 0 is the background, -1 unassigned Gaussians.
        name: Name of the object.
        aliases: Other words for it.
        caption: Sentence that describes it, or "".
        gaussians: Number of member Gaussians.
        pixels: Mean number of pixels per view.
        views: Number of views that show it.
        motion: Motion in words.
        rigid_rms: RMS distance of the members from their rigid motion, as a share of the radius; None if they move
            rigidly by construction.
        confidence: Mean probability of this object by the classifier over the members' encodings, weighted by opacity;
            None if the scene stores no encodings.
        strays: Number of members that move with the group of another object.
        iou: IoU with the true masks of the views, same ids; None if no mask shows the object.
        outlook: Reliability of its motion.
    """

    id: int
    name: str
    aliases: tuple[str, ...]
    caption: str
    gaussians: int
    pixels: float
    views: int
    motion: str
    rigid_rms: float | None
    confidence: float | None
    strays: int
    iou: float | None
    outlook: predictability.Outlook = predictability.UNKNOWN


def measure(
    scene: Scene, views: Sequence[datasets.View | viewpoints.Viewpoint], mode: str = "rigid", *, backend: str = "auto"
) -> list[ObjectRow]:
    """Render a scene from some views and measure its objects.

    Args:
        scene: The scene.
        views: Cameras and times; views of a data set are compared with their masks.
        mode: Playback mode past t_max.
        backend: Rasterizer.

    Returns:
        One row per object of the scene's table.
    """
    player = scene_player.Player(scene, mode)
    tally = miou.Overlap([item.id for item in scene.objects if item.id > 0])
    pixels = {item.id: 0 for item in scene.objects}
    seen = dict.fromkeys(pixels, 0)
    for view in views:
        ids = evaluate.render_timed(scene, view.camera, view.t, player.frame, backend=backend).ids
        for object_id, count in zip(*(found.tolist() for found in np.unique(ids, return_counts=True)), strict=True):
            pixels[object_id] = pixels.get(object_id, 0) + count
            seen[object_id] = seen.get(object_id, 0) + 1
        mask = datasets.load_mask(view) if isinstance(view, datasets.View) else None
        if mask is not None:
            tally.add(ids, mask)
    found = tally.result()
    known, sure, astray = found["iou_objects"] or {}, confidences(scene), strays(scene)
    outlooks = predictability.outlooks(scene)
    rows = []
    for item in scene.objects:
        groups = [group for group in scene.groups if group.object_id == item.id and group.role == "body"]
        row = ObjectRow(
            id=item.id,
            name=item.name,
            aliases=item.aliases,
            caption=item.caption,
            gaussians=item.count,
            pixels=pixels[item.id] / max(len(views), 1),
            views=seen[item.id],
            motion=motion_of(scene, groups),
            rigid_rms=_residual(scene, groups),
            confidence=sure.get(item.id),
            strays=astray.get(item.id, 0),
            iou=known.get(str(item.id)) if item.id > 0 else found["iou_background"] if item.id == 0 else None,
            outlook=outlooks[item.id],
        )
        rows.append(row)
    return rows


def own_views(scene: Scene) -> list[viewpoints.Viewpoint]:
    """Return views of the scene's own cameras at distinct observed times, or overviews if it stores no cameras."""
    first = float(scene.tracks.times[0])
    cameras = sampling.spread(scene.cameras, MAX_VIEWS) or [viewpoints.overview(scene)] * 3
    # Golden-ratio steps keep camera order and time order uncorrelated.
    shares = (0.5 + 0.6180339887 * np.arange(len(cameras))) % 1.0
    times = first + shares * (scene.t_max - first)
    return [viewpoints.Viewpoint(camera, float(t)) for camera, t in zip(cameras, times, strict=True)]


def confidences(scene: Scene) -> dict[int, float]:
    """Return the classifier's mean probability of the members' own label, weighted by opacity.

    Returns:
        Probability by object id, for objects with members; empty if the scene stores no encodings or no classifier.
    """
    if scene.gaussians.identities is None or scene.classifier is None:
        return {}
    opacities = to_opacities(scene.gaussians.opacity_logits)
    found = {}
    for k, item in enumerate(item for item in scene.objects if item.id >= 0):
        rows = slice(item.start, item.start + item.count)
        answers = (
            scene.gaussians.identities[rows].astype(np.float64) @ scene.classifier.weight.T + scene.classifier.bias
        )
        answers -= answers.max(axis=1, keepdims=True, initial=-np.inf)
        shares = np.exp(answers)
        total = float(opacities[rows].sum())
        if total > 0:
            found[item.id] = float((opacities[rows] * shares[:, k] / shares.sum(axis=1)).sum() / total)
    return found


def strays(scene: Scene) -> dict[int, int]:
    """Return the number of stray members of each object.

    A stray moves with the group of another object, or rests although its object has a group of its own. A shadow is
    background that follows its caster, and counts as resting.
    """
    bodies = {group.id: group.object_id for group in scene.groups if group.role == "body"}
    owner = np.array([bodies.get(group.id, 0) for group in scene.groups])[scene.gaussians.motion_ids]
    labels = np.maximum(scene.gaussians.object_ids, 0)
    # Objects without a group of their own rest with the background and are not strays.
    away = (owner != labels) & ((owner > 0) | np.isin(labels, list(bodies.values())))
    ids, counts = np.unique(scene.gaussians.object_ids[away], return_counts=True)
    return dict(zip(ids.tolist(), counts.tolist(), strict=True))


def table(scene: Scene, rows: Sequence[ObjectRow], views: int) -> Table:
    """Return the rows as a terminal table.

    Args:
        scene: The scene.
        rows: Rows of `measure`.
        views: Number of views that were rendered.
    """
    title = escape(f"objects of {scene.name}")
    shown = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    measured, compared = (any(getattr(row, key) is not None for row in rows) for key in ("rigid_rms", "iou"))
    numbers = (*(["bends"] if measured else []), "sure", "strays", *(["IoU"] if compared else []))
    for name in ("id", "name", "count", "pixels", "views", "motion", *numbers):
        words = name in ("name", "motion")
        shown.add_column(name, justify="left" if words else "right", no_wrap=not words, overflow="fold")
    for row in rows:
        cells = [str(row.id), ", ".join([row.name, *row.aliases]), str(row.gaussians), f"{row.pixels:.0f}"]
        cells += [str(row.views), row.motion]
        cells += ["-" if row.rigid_rms is None else f"{100 * row.rigid_rms:.2g} %"] if measured else []
        cells += ["-" if row.confidence is None else f"{row.confidence:.3f}", str(row.strays)]
        cells += ["-" if row.iou is None else f"{row.iou:.3f}"] if compared else []
        shown.add_row(*map(Text, cells))  # as plain text, because names may contain markup brackets
    shown.caption, shown.caption_justify = _caption(scene, rows, views), "left"
    return shown


def outlook_table(scene: Scene, rows: Sequence[ObjectRow]) -> Table | None:
    """Return the reliability of the objects' motion as a terminal table; None if nothing is known of any object.

    Args:
        scene: The scene.
        rows: Rows of `measure`.
    """
    known = [row for row in rows if row.outlook.is_known]
    if not known:
        return None
    title = "errors of observed poses, and confidence of the prediction"
    shown = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    end = f"at t = {predictability.horizon(scene):g}"
    for name in ("id", "name", "rotation", "position", end, "prediction"):
        left = name in ("name", "prediction")
        shown.add_column(name, justify="left" if left else "right", no_wrap=name == "id", overflow="fold")
    for row in known:
        own = row.outlook
        turn = "-" if own.rotation_error_deg is None else predictability.rotation_text(own.rotation_error_deg)
        place = "-" if own.position_error_percent is None else predictability.position_text(own.position_error_percent)
        width = "-" if own.half_width is None else f"± {own.half_width:.2g} ({own.half_width_percent:.2g} %)"
        shown.add_row(*map(Text, (str(row.id), row.name, turn, place, width, own.warning or "")))
    shown.caption, shown.caption_justify = _OUTLOOK, "left"
    return shown


_OUTLOOK = (
    "rotation, position: estimated standard deviations of the observed poses, median over the times and worst; "
    "%: of the object's size; ±: half width of the 95 % band in world units"
)


def to_json(scene: Scene, rows: Sequence[ObjectRow], views: int) -> dict[str, Any]:
    """Return the rows as JSON: ``{"scene", "views", "horizon", "hygiene", "label_hygiene", "objects": [...]}``.

    An object has the attributes of `ObjectRow`, with those of its `predictability.Outlook`.
    """
    objects = []
    for row in rows:
        found = asdict(row)
        outlook = found.pop("outlook")
        objects.append({**found, "aliases": list(row.aliases), **outlook})
    cleaned = {"hygiene": _recorded(scene, "regrouping"), "label_hygiene": _recorded(scene, "label_hygiene")}
    end = predictability.horizon(scene)
    return {"scene": scene.name, "views": views, "horizon": end, **cleaned, "objects": objects}


def _recorded(scene: Scene, key: str) -> dict[str, Any] | None:
    """Return counts that training stored in the scene, or None if the step did not run.

    Args:
        key: ``regrouping`` for motion labels, or ``label_hygiene`` for object labels.
    """
    found = scene.provenance.get(key)
    return dict(found) if isinstance(found, dict) else None


def _caption(scene: Scene, rows: Sequence[ObjectRow], views: int) -> str:
    parts = [f"count: Gaussians; pixels: mean over {views} views"]
    if any(row.rigid_rms is not None for row in rows):
        parts.append("bends: rms distance from the rigid motion, of the radius; - if rigid by construction")
    else:
        parts.append("all members move rigidly by construction: no residual")
    if any(row.confidence is not None for row in rows):
        parts.append("sure: mean probability of the members' own id, by the classifier")
    else:
        parts.append("sure: -, as the scene stores no identity encodings")
    parts.append("strays: members that move with another object")
    if any(row.iou is not None for row in rows):
        parts.append("IoU: with the true masks of these views, same ids")
    found = _recorded(scene, "regrouping")
    if found is not None:
        moved = sum(int(found.get(key, 0)) for key in ("to_bodies", "to_shadows", "to_rest"))
        parts.append(f"regrouping: {moved} of {found.get('moving', 0)} moving Gaussians changed their group")
    cleaned = _recorded(scene, "label_hygiene")
    if cleaned is not None:
        rules = {rule: int(cleaned.get(rule, 0)) for rule in ("neighbours", "motion", "outliers")}
        by = ", ".join(f"{rule} {count}" for rule, count in rules.items())
        parts.append(f"label cleanup: {sum(rules.values())} of {cleaned.get('gaussians', 0)} labels changed ({by})")
    return "; ".join(parts)


def _residual(scene: Scene, groups: Sequence[MotionGroup]) -> float | None:
    """Return the RMS share of the radius, weighted by members; None if all groups move rigidly."""
    if not any(group.rigid_max > 0 for group in groups):
        return None
    counts = np.array([max(int((scene.gaussians.motion_ids == group.id).sum()), 1) for group in groups])
    squares = np.array([(group.rigid_rms / max(group.model.radius, 1e-9 * scene.extent)) ** 2 for group in groups])
    return float(np.sqrt(np.average(squares, weights=counts)))
