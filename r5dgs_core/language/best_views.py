"""Best views of an object for an image encoder: crops of renderings in which the object is well visible.

Renderings need no data set, and crops have the encoder's resolution. Visible pixels are counted in small pictures from
the scene's own cameras at observed times.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..playback import scene_player
from ..render import highlight, scene_renderer, viewpoints
from ..scene import sampling
from ..scene.cameras import Camera, resized
from ..scene.scene import Scene

VIEWS = 6  # maximum number of views per object
_LOOK = 256  # longer side of the small pictures, pixels
_CAMERAS = 8  # maximum number of cameras to try
_TIMES = 4  # number of times to try
_TRIED = 10  # maximum number of views per object that are also rendered without occluders
_MIN_PIXELS = 12  # minimum visible area in a small picture
_WANTED_SIDE = 32  # object size in the camera's picture, pixels; smaller objects get a lower score
_CUT = 0.3  # factor on the score of an object cut by the border
_AGAIN = 0.4  # factor on the score for each chosen view of the same camera
_SAME_TIME = 0.8  # factor on the score for each chosen view at the same time
_MARGIN = 0.15  # margin around the object on each side, as a share of its larger side
_GRAY = 0.5  # background of isolated crops


@dataclasses.dataclass(frozen=True)
class Sighting:
    """An object in the picture of one camera.

    Attributes:
        camera: The scene's camera.
        t: Scene time.
        box: Square around the object: left, top, right, bottom in pixels of the camera.
        worth: Score: number of visible pixels, reduced for objects that are occluded, cut or tiny.
    """

    camera: Camera
    t: float
    box: tuple[float, float, float, float]
    worth: float


def find(
    scene: Scene,
    object_ids: Sequence[int],
    *,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> dict[int, list[Sighting]]:
    """Find the best views of objects, spread over cameras and times.

    Args:
        progress: Called with the number of finished pictures and their total.

    Returns:
        At most `VIEWS` per object, the best first; an empty list for objects that no camera shows.
    """
    seen: dict[int, list[tuple[Sighting, np.ndarray]]] = {object_id: [] for object_id in object_ids}
    places, player = _viewpoints(scene), scene_player.Player(scene)
    for done, at in enumerate(places):
        small = resized(at.camera, _LOOK)
        ids = scene_renderer.render(player, small, at.t, backend=backend).ids
        for object_id in object_ids:
            mask = ids == object_id
            if mask.sum() >= _MIN_PIXELS:
                seen[object_id].append((_sighting(at, small, mask), mask))
        if progress:
            progress(done + 1, len(places))
    result = {}
    for object_id, found in seen.items():
        found.sort(key=lambda entry: -entry[0].worth)
        tried = [
            dataclasses.replace(sighting, worth=sighting.worth * _unhidden(scene, object_id, sighting, mask, backend))
            for sighting, mask in found[:_TRIED]
        ]
        result[object_id] = _spread(tried)
    return result


def crops(
    scene: Scene, object_id: int, sighting: Sighting, size: int = 256, *, backend: str = "auto"
) -> tuple[np.ndarray, np.ndarray]:
    """Render two crops of an object: isolated on gray, and in the scene. Each [size, size, 3], sRGB in [0, 1]"""
    camera = _cut(sighting.camera, sighting.box, size)
    alone = highlight.isolate(scene, [object_id], camera, sighting.t, backend=backend)
    alpha = alone[..., 3:]
    whole = scene_renderer.render(scene_player.Player(scene), camera, sighting.t, backend=backend)
    context = np.clip(whole.color, 0, 1)
    return (alone[..., :3] * alpha + _GRAY * (1 - alpha)).astype(np.float32), context


def _viewpoints(scene: Scene) -> list[viewpoints.Viewpoint]:
    some = sampling.spread(scene.cameras, _CAMERAS) or [viewpoints.overview(scene)]
    times = np.unique(np.linspace(scene.tracks.times[0], scene.t_max, _TIMES))
    return [viewpoints.Viewpoint(camera, float(t)) for t in times for camera in some]


def _sighting(at: viewpoints.Viewpoint, small: Camera, mask: np.ndarray) -> Sighting:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    scale = at.camera.width / small.width
    left, right = scale * columns[0], scale * (columns[-1] + 1)
    top, bottom = scale * rows[0], scale * (rows[-1] + 1)
    side = max(right - left, bottom - top)
    whole = columns[0] > 0 and rows[0] > 0 and columns[-1] < mask.shape[1] - 1 and rows[-1] < mask.shape[0] - 1
    worth = float(mask.sum()) * (1.0 if whole else _CUT) * min(side / _WANTED_SIDE, 1.0) ** 2
    half = (0.5 + _MARGIN) * side
    x, y = 0.5 * (left + right), 0.5 * (top + bottom)
    return Sighting(at.camera, at.t, (x - half, y - half, x + half, y + half), worth)


def _unhidden(scene: Scene, object_id: int, sighting: Sighting, mask: np.ndarray, backend: str) -> float:
    """Share of an object's pixels that are not occluded."""
    small = resized(sighting.camera, _LOOK)
    alone = highlight.isolate(scene, [object_id], small, sighting.t, backend=backend)[..., 3] > 0.5
    return float((mask & alone).sum() / max(alone.sum(), 1))


def _spread(sightings: list[Sighting]) -> list[Sighting]:
    """Choose the best views greedily; each chosen view lowers the scores of others of its camera and time."""
    left, taken = list(sightings), []
    while left and len(taken) < VIEWS:
        worths = [
            each.worth
            * _AGAIN ** sum(other.camera is each.camera for other in taken)
            * _SAME_TIME ** sum(other.t == each.t for other in taken)
            for each in left
        ]
        best = int(np.argmax(worths))
        if worths[best] <= 0:
            break
        taken.append(left.pop(best))
    return taken


def _cut(camera: Camera, box: tuple[float, float, float, float], size: int) -> Camera:
    """Return a camera for a square of another camera's picture, at its own resolution."""
    left, top, right, _ = box
    scale = size / max(right - left, 1e-6)
    to_square = np.array([[scale, 0, -scale * left], [0, scale, -scale * top], [0, 0, 1.0]])
    return dataclasses.replace(camera, width=size, height=size, intrinsics=to_square @ camera.intrinsics)
