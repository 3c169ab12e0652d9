"""Comparison of the player with the core: pictures, picking and search."""

from __future__ import annotations

import base64
import json
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core import errors
from r5dgs_core.data import images
from r5dgs_core.playback.scene_player import Player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import cameras
from r5dgs_core.scene.scene import Scene
from r5dgs_core.search import object_search

from .player import Browser

MIN_PIXELS = 400  # of an object whose place is compared
MARGIN = 3  # pixels around its box


@dataclass(frozen=True)
class Comparison:
    """A picture of the player and that of the rasterizer.

    Attributes:
        psnr: PSNR of the whole picture, dB.
        median: Median colour error over pixels with Gaussians, steps of 255.
        shift: Largest displacement of an object, pixels; 0 if none is large enough.
    """

    psnr: float
    median: float
    shift: float


def shown_cameras(scene: Scene, count: int = 3) -> list[int]:
    """Numbers of cameras that are spread over those of a scene."""
    return sorted({k * len(scene.cameras) // count for k in range(count)})


def shown_times(scene: Scene, end: float) -> list[float]:
    """Five times from the first one to the end of the file, two of them past t_max."""
    first, last = float(scene.tracks.times[0]), scene.t_max
    return [first, 0.5 * (first + last), last, 0.5 * (last + end), end]


def compare(
    browser: Browser, scene: Scene, url: str, side: int, end: float, folder: Path, ratio: int = 1
) -> list[Comparison]:
    """Compare pictures of some captured cameras at `shown_times`.

    Args:
        browser: The browser.
        scene: The scene.
        url: Address of its page.
        side: Longest side of the pictures.
        end: Last scene time of the page.
        folder: Existing folder for files.
        ratio: Pixels of the device per CSS pixel.
    """
    player, found = Player(scene), []
    for number in shown_cameras(scene):
        camera = cameras.resized(scene.cameras[number], side)
        window = (camera.width // ratio, camera.height // ratio)
        browser.open(f"{url}?ui=0&t={scene.t_max}&camera={number}", *window, ratio=ratio)
        for t in shown_times(scene, end):
            data = browser.eval(f"(r5dgs.go({t}), r5dgs.engine.picture())").partition(",")[2]
            path = folder / "picture.png"
            path.write_bytes(base64.b64decode(data))
            picture = images.read(path)[..., :3]
            output = scene_renderer.render(player, camera, t)
            found.append(_comparison(picture, np.clip(output.color, 0, 1), output.ids))
    return found


def _comparison(picture: np.ndarray, wanted: np.ndarray, ids: np.ndarray) -> Comparison:
    error = picture.astype(np.float64) - wanted
    steps = np.abs(picture - np.rint(255 * wanted) / 255)[ids >= 0] * 255
    shifts = [0.0]
    for object_id in np.unique(ids[ids > 0]).tolist():
        rows, columns = np.nonzero(ids == object_id)
        if len(rows) >= MIN_PIXELS:
            box = tuple(slice(max(int(v.min()) - MARGIN, 0), int(v.max()) + MARGIN + 1) for v in (rows, columns))
            shifts.append(_shift(wanted[box].mean(-1), picture[box].mean(-1)))
    return Comparison(float(-10 * np.log10(np.mean(error**2))), float(np.median(steps)), max(shifts))


def _shift(a: np.ndarray, b: np.ndarray) -> float:
    """Displacement between two grey pictures to first order, in pixels (Lucas-Kanade over the whole crop)."""
    down, right = np.gradient(a)
    normal = np.array([[(right * right).sum(), (right * down).sum()], [(right * down).sum(), (down * down).sum()]])
    change = b - a
    moved = np.linalg.lstsq(normal, -np.array([(right * change).sum(), (down * change).sum()]), rcond=None)[0]
    return float(np.hypot(*moved))


def picks(
    browser: Browser, scene: Scene, url: str, side: int, count: int = 50, ratio: int = 1
) -> dict[int, tuple[int, int]]:
    """Pick visible pixels of each object in captured views at t_max, with a number of pixels per CSS pixel.

    Returns:
        Numbers of right and of tried pixels by object id.
    """
    player, random_, result = Player(scene), random.Random(0), {}
    for number in shown_cameras(scene):
        camera = cameras.resized(scene.cameras[number], side)
        ids = scene_renderer.render(player, camera, scene.t_max).ids
        window = (camera.width // ratio, camera.height // ratio)
        browser.open(f"{url}?ui=0&t={scene.t_max}&camera={number}", *window, ratio=ratio)
        for object_id in np.unique(ids[ids > 0]).tolist():
            seen = np.argwhere(ids == object_id).tolist()
            if object_id not in result and len(seen) >= count:
                pixels = random_.sample(seen, count)
                found = browser.eval(f"{pixels}.map(([y, x]) => r5dgs.pick(x / {ratio}, y / {ratio}))")
                result[object_id] = (found.count(object_id), count)
    return result


def prompts(scene: Scene, count: int = 200) -> list[str]:
    """Prompts of all kinds about a scene: names, words, typos, plurals, lists, exclusions, nonsense."""
    random_ = random.Random(0)
    labels = [label for label in object_search.labels_of(scene) if label.object_id > 0]
    names = [name for label in labels for name in (label.name, *label.aliases)] + list(scene.vocabulary)
    names += ["zebra", "quantum sofa", "thing", "objects"]

    def word() -> str:
        name = random_.choice(names)
        at = random_.randrange(len(name))
        kind = random_.randrange(9)
        if kind == 0:
            return name[:at] + name[at + 1 :]  # a letter is missing
        if kind == 1:
            return name[:at] + name[at : at + 2][::-1] + name[at + 2 :]  # two are swapped
        if kind == 2:
            return name + random_.choice(["s", "es", " two", "!"])
        if kind == 3:
            return random_.choice(["the ", "my ", "two ", "a big "]) + name
        if kind == 4:
            return name.upper()
        return name if kind < 8 else name[: max(3, len(name) - 2)]

    forms = ("{0}", "{0}", "{0}", "{0} and {1}", "{0}, {1} or {2}", "not the {0}", "everything but {0}", "all")
    forms += (
        "{0} but not {1}",
        "nothing but {0}",
        "{0} and {1} except for {2}",
        "none",
        "everything",
        "{0} without {1}",
    )
    return [random_.choice(forms).format(word(), word(), word()) for _ in range(count)]


def ranking(scene: Scene, text: str) -> list[tuple[int, float]]:
    """Ids and scores that `r5dgs query` finds, best first; empty if it refuses the text."""
    try:
        return [(match.object_id, match.score) for match in object_search.search(scene, text)]
    except errors.R5dgsError:
        return []


def rankings_of_page(browser: Browser, texts: Sequence[str]) -> list[Any]:
    """Ids and scores that the open page finds for each text."""
    search = "r5dgs.controls.search.find(text).matches.map((match) => [match.id, match.score])"
    return browser.eval(f"{json.dumps(list(texts))}.map((text) => {search})")
