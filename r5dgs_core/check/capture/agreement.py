"""Agreement of the masks of different cameras."""

from __future__ import annotations

import functools
import itertools
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ...data import masks
from ...data.dataset import Dataset
from ...data.views import View
from ...findings import Collector
from ...scene import cameras
from ...terminal import printable
from . import pictures
from .pictures import Album

APART = 2.0  # maximum distance from the epipolar line, in radii of the object
LEAST = 3  # minimum number of times at which two cameras show an object


@dataclass(frozen=True)
class Sighting:
    """Object in a mask.

    Attributes:
        view: The view.
        center: Centre of its pixels. [2]
        radius: Radius of a disc of the same area, pixels.
        whole: True if it does not touch the border.
    """

    view: View
    center: np.ndarray
    radius: float
    whole: bool


def sightings(view: View, ids: np.ndarray) -> dict[int, Sighting]:
    """Return the objects of a mask [H, W]."""
    found = {}
    for object_id in np.unique(ids).tolist():
        if object_id not in (0, masks.UNKNOWN):
            y, x = np.nonzero(ids == object_id)
            whole = min(x.min(), y.min()) > 0 and x.max() < ids.shape[1] - 1 and y.max() < ids.shape[0] - 1
            center = np.array([x.mean() + 0.5, y.mean() + 0.5])
            found[object_id] = Sighting(view, center, float(np.sqrt(len(x) / np.pi)), bool(whole))
    return found


def check(found: Dataset, seen: dict[int, list[Sighting]], collect: Collector, album: Album) -> None:
    """Check that the ids of masks mean the same objects in all cameras, and that several cameras see each.

    Args:
        found: The data set.
        seen: All sightings of each object in training views.
        collect: Findings.
        album: Pictures.
    """
    masked = {view.camera.name for view in found.train if view.mask_path is not None}
    if len(masked) < 2 or len({view.mask_video for view in found.train if view.mask_path is not None}) > 1:
        return  # one camera, or ids that are valid within one video only
    place = str(found.mask_folder)
    for object_id, all_seen in sorted(seen.items()):
        name = printable(found.object_names.get(object_id, f"id {object_id}"))
        cameras = {one.view.camera.name for one in all_seen}
        if len(cameras) == 1 and len(all_seen) > 1:
            one = max(all_seen, key=lambda sighting: sighting.radius)
            draw = functools.partial(_draw_one, one, object_id, name)
            collect.add(
                "D69",
                f"{place}: only {next(iter(cameras))} sees {name}",
                picture=album.write(f"D69_{object_id}", draw),
            )
        elif len(cameras) > 1:
            _check_rays(object_id, name, all_seen, place, collect, album)


def _check_rays(
    object_id: int, name: str, all_seen: list[Sighting], place: str, collect: Collector, album: Album
) -> None:
    """Compare the centres of an object in pairs of cameras at the same time."""
    by_time: dict[float, list[Sighting]] = defaultdict(list)
    for one in all_seen:
        if one.whole:
            by_time[one.view.t].append(one)
    apart: dict[tuple[str, str], list[tuple[float, Sighting, Sighting]]] = defaultdict(list)
    for group in by_time.values():
        for a, b in itertools.combinations(sorted(group, key=lambda one: one.view.camera.name), 2):
            if a.view.camera.name != b.view.camera.name:
                key = (a.view.camera.name, b.view.camera.name)
                apart[key].append((distance(a, b) / max(b.radius, 1.0), a, b))
    wrong = {}
    for pair, rows in apart.items():
        values = [value for value, *_ in rows]
        if len(rows) >= LEAST and float(np.median(values)) > APART:
            wrong[pair] = float(np.median(values))
    if not wrong:
        return
    pair = max(wrong, key=wrong.__getitem__)
    value, a, b = sorted(apart[pair], key=lambda row: row[0])[len(apart[pair]) // 2]
    pairs = " and ".join(f"{one}, {other}" for one, other in sorted(wrong))
    collect.add(
        "D68",
        f"{place}: {name} is not the same thing in {pairs}: its masks are {value:.1f} radii apart",
        picture=album.write(f"D68_{object_id}", lambda: _draw_pair(a, b, object_id)),
    )


def _draw_one(one: Sighting, object_id: int, name: str) -> Figure:
    return pictures.side_by_side([(pictures.outlined(one.view, object_id), f"{name} in {one.view.name}")])


def _draw_pair(a: Sighting, b: Sighting, object_id: int) -> Figure:
    line = epipolar_line(a, b)
    panels = [
        (pictures.outlined(a.view, object_id), a.view.name),
        (pictures.outlined(b.view, object_id, line), f"{b.view.name}: where it should be"),
    ]
    return pictures.side_by_side(panels)


def epipolar_line(a: Sighting, b: Sighting) -> np.ndarray:
    """Return the line a u + b v + c = 0 in the second image on which the first centre lies. [3]"""
    return cameras.fundamental(a.view.camera, b.view.camera) @ np.append(a.center, 1.0)


def distance(a: Sighting, b: Sighting) -> float:
    """Return the distance of the second centre from the epipolar line of the first, pixels."""
    line = epipolar_line(a, b)
    return float(abs(line @ np.append(b.center, 1.0)) / max(float(np.hypot(line[0], line[1])), 1e-12))
