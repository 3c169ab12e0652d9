"""Initial state of training: Gaussians from visual hulls and the plane sweep, tracks from triangulated masks.

Group numbering: 0 is the pinned background, 1..M the objects in the order of their ids, then one shadow per object.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...config.config import Config
from ...config.sections.training import InitSection
from ...model.gaussians import Gaussians
from ..representations.representation import TRACKS, Representation
from ..train_views import TrainView, by_camera, nearest_knot
from . import (
    background_images,
    color_balance,
    evidence,
    free_space,
    knots,
    place_gaussians,
    plane_sweep,
    scatter,
    shadows,
    triangulation,
    visual_hull,
)

log = logging.getLogger(__name__)

MASKS = "Remedy: masks, such as those of 'r5dgs masks DATA --backend features' (docs/user/masks.md)"
MIN_CAMERAS = 3  # minimum number of cameras to place a scene from the images of one time
SEEN_AT_ALL = 1e-3  # score of a time at which the object has a position, but no view shows all of it


@dataclass(frozen=True)
class FirstTracks:
    """Initial tracks of the bodies, without rotation.

    Attributes:
        times: Knots, increasing. [S]
        centers: Centres of the bodies, row 0 for the pinned group. [B, 3]
        translations: Triangulated displacements at the knots. [B, S, 3]
        casters: Body that each shadow group follows. [W]
        plane_normal: Unit normal of the supporting plane, or None. [3]
        slope: Shift of a shadow along the plane per unit that its caster rises. [3]
        light: Unit direction to the light. [3]
    """

    times: np.ndarray
    centers: np.ndarray
    translations: np.ndarray
    casters: np.ndarray
    plane_normal: np.ndarray | None
    slope: np.ndarray
    light: np.ndarray


@dataclass(frozen=True)
class InitialState:
    """Initial state of training.

    Attributes:
        gaussians: Canonical Gaussians; each body is in its state at its reference time.
        tracks: Initial tracks at the observed times.
        object_ids: Object id of each body; row 0 is the background. [B]
        places: Positions of the objects by the masks.
        first_time: Index of the time at which training begins.
        plane: Unit normal and offset (n . x = h) of the supporting plane, or None.
        sky: Coefficients of the sky, or None if none was found. [9, 3]
        evidence: Evidence of the images on the objects' motion.
        colors: Colours of the cameras; None if they were not compared or do not differ.
        free_space: Space to keep free of background; None if the depth of the background is not ambiguous.
    """

    gaussians: Gaussians
    tracks: FirstTracks
    object_ids: np.ndarray
    places: triangulation.ObjectPositions
    first_time: int
    plane: tuple[np.ndarray, float] | None
    sky: np.ndarray | None
    evidence: evidence.BodyEvidence
    colors: color_balance.ColorBalance | None = None
    free_space: free_space.FreeSpace | None = None


def start(
    views: Sequence[TrainView],
    config: Config,
    motion: type[Representation],
    find_sky: bool,
    rng: np.random.Generator,
    cloud: tuple[np.ndarray, np.ndarray] | None = None,
) -> InitialState:
    """Create the initial Gaussians and tracks.

    Args:
        views: Training views in normalised coordinates.
        config: Configuration of the run.
        motion: Representation that will be trained. If it never moves, all images show one time.
        find_sky: True if the background may contain sky; False if its colour is fixed.
        rng: Random generator.
        cloud: Points and colours in [0, 1] of a reconstruction, normalised coordinates. [P, 3] each

    Returns:
        The initial state.
    """
    init = config.init
    times = knots.of(views)
    if not motion.moves and len(times) > 1:
        log.info("nothing moves in any view: training a static scene")
        times = times[-1:]
    places = triangulation.locate(views, times, init.min_mask_pixels)
    _warn(views, motion)
    by_motion = motion.sorts_by_motion and not any(v.has_mask for v in views)
    first = 0 if config.curriculum.start == "first" else _first_time(places, len(times))
    if by_motion and config.curriculum.start != "first":
        first = (len(times) - 1) // 2
    backgrounds = background_images.compute(_at_once(views, times, first) if by_motion else views)
    # With random points or those of a reconstruction, the sweep serves mainly to find the sky and the plane.
    swept = init.background_points if init.placement == "scene" and cloud is None else min(init.background_points, 5000)
    views, backgrounds, search, colors = _balanced(views, backgrounds, swept, config)
    centers, translations, clouds = _bodies(views, times, places, first, init, rng)
    eyes = np.stack([v.camera.center for v in views])
    plane = supporting_plane(search.distinct_points(), places, eyes, rng)
    placed = search.place(swept, plane, find_sky, rng)
    found = _background(views, backgrounds, placed, init, rng, cloud)
    where, shade, free = _cleared(found, views, times, places, config)
    log.info("background: %d points from %d cameras; %d objects", len(where), len(backgrounds), len(clouds))
    parts = [place_gaussians.solid([*clouds, (where, shade, 0)], init.opacity)]
    casters, slope = np.zeros(0, np.int64), np.zeros(3)
    to_light = np.array([0.0, 0.0, 1.0]) if plane is None else plane[0]
    if plane is not None and config.train.shadows and init.shadow_points > 0 and motion.moves:
        casters = np.arange(1, len(centers))
        light = shadows.find_light(views, backgrounds, places, times, plane, rng)
        slope, to_light = shadows.slope(light.direction, plane[0]), -light.direction
        log.info("light travels along %s (darkening %.3f)", np.round(light.direction, 2), light.darkening)
        for body in casters:
            known, group = (centers[body], float(places.radii[body - 1])), len(centers) + int(body) - 1
            parts.append(place_gaussians.shadow(*known, light.direction, plane, group, init.shadow_points, rng))
    gaussians = place_gaussians.gaussians_of(parts, config.train.sh_degree)
    if motion.moves and config.train.shading and config.train.representation == TRACKS:
        place_gaussians.shade_outwards(gaussians, centers, init.shading)
    tracks = FirstTracks(times, centers, translations, casters, None if plane is None else plane[0], slope, to_light)
    ids, seen = np.concatenate([[0], places.object_ids]), evidence.gather(views, places, times)
    return InitialState(gaussians, tracks, ids, places, first, plane, placed.sky, seen, colors, free)


def _balanced(
    views: Sequence[TrainView], backgrounds: Sequence[background_images.BackgroundImage], points: int, config: Config
) -> tuple[
    Sequence[TrainView],
    Sequence[background_images.BackgroundImage],
    plane_sweep.Sweep,
    color_balance.ColorBalance | None,
]:
    """Sweep the background images for a number of points, with corrected colours if the fixed cameras differ.

    Returns:
        Views and background images in corrected colours, their sweep, and the colours of the cameras. These are None if
        some camera has no background image, or the cameras do not differ.
    """
    depths, wanted = config.init.sweep_depths, config.needs.camera_colours
    search = plane_sweep.Sweep(backgrounds, points, depths)
    names = {view.camera.name for view in views}
    if wanted == "off" or len(names) < 2 or names != {b.camera.name for b in backgrounds} or len(names) == len(views):
        return views, backgrounds, search, None
    colors = color_balance.find(backgrounds, search, depths, forced=wanted == "on")
    if colors is None:
        return views, backgrounds, search, None
    balanced = colors.backgrounds(backgrounds)
    return colors.views(views), balanced, plane_sweep.Sweep(balanced, points, depths), colors


def _warn(views: Sequence[TrainView], motion: type[Representation]) -> None:
    """Warn if objects or motion cannot be learned from the views."""
    if motion.moves and not any(v.has_mask for v in views):
        if motion.sorts_by_motion:
            log.warning("no masks: the field moves all Gaussians, and objects are found by their motion. %s", MASKS)
        else:
            log.warning(
                "no masks and no moving objects found: everything is trained as one static scene. %s, or "
                "--set train.representation=field",
                MASKS,
            )
    elif len({view.t for view in views}) == 1:
        log.warning("only one observed time: motion cannot be learned. Remedy: frames at more times")


def _bodies(
    views: Sequence[TrainView],
    times: np.ndarray,
    places: triangulation.ObjectPositions,
    first: int,
    init: InitSection,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray, int]]]:
    """Place the objects in their visual hulls, each at its reference time.

    Returns:
        Centres [B, 3] and translations [B, S, 3] of the bodies, row 0 for the pinned group; and points, colours and
        row of each object.
    """
    bodies = len(places.object_ids) + 1
    centers = np.zeros((bodies, 3))
    translations = np.zeros((bodies, len(times), 3))
    count = 0 if init.placement == "random" else init.object_points
    clouds = []
    for row, object_id in enumerate(places.object_ids):
        reference = _reference_time(places.visibility[row], places.measured[row], first)
        centers[row + 1] = places.centers[row, reference]
        translations[row + 1] = places.centers[row] - centers[row + 1]
        then = [v for v in views if v.has_mask and nearest_knot(times, v.t) == reference]
        carved = visual_hull.carve(then, int(object_id), centers[row + 1], places.radii[row], count, rng)
        clouds.append((*carved, row + 1))
    return centers, translations, clouds


def _background(
    views: Sequence[TrainView],
    backgrounds: Sequence[background_images.BackgroundImage],
    placed: plane_sweep.BackgroundPoints,
    init: InitSection,
    rng: np.random.Generator,
    cloud: tuple[np.ndarray, np.ndarray] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and colours of the background: random, of a reconstruction, or of the sweep. [P, 3] each"""
    where, shade = placed.points, placed.colors
    if init.placement == "random":
        where, shade = scatter.random_points(backgrounds, init.background_points, rng)
    elif cloud is not None:
        known, hues = scatter.behind_objects(*cloud, views, init.background_points, rng)
        fill = rng.permutation(len(where))[: max(0, init.background_points - len(known))]
        where, shade = np.concatenate([known, where[fill]]), np.concatenate([hues, shade[fill]])
    if len(where) == 0:
        log.warning(
            "the background cannot be placed: too little of it is visible to two cameras (there %s). Remedy: more "
            "cameras that look at the same place",
            "is one" if len(backgrounds) == 1 else f"are {len(backgrounds)}",
        )
    return where, shade


def _cleared(
    background: tuple[np.ndarray, np.ndarray],
    views: Sequence[TrainView],
    times: np.ndarray,
    places: triangulation.ObjectPositions,
    config: Config,
) -> tuple[np.ndarray, np.ndarray, free_space.FreeSpace | None]:
    """Return the background points that hide no object, their colours, and the space to keep free of background.

    Args:
        background: Points and their colours. [P, 3] each
        views: Training views.
        times: Knots. [S]
        places: Positions of the objects.
        config: Configuration of the run.
    """
    where, shade = background
    if config.train.representation != TRACKS:  # objects may then consist of Gaussians of the background
        return where, shade, None
    free = free_space.find(views, times, places, where)
    if free is None:
        return where, shade, None
    kept = ~free.contains(where)
    log.info("background: %d points left out, as they would hide objects that the masks show", (~kept).sum())
    return where[kept], shade[kept], free


def supporting_plane(
    background: np.ndarray, places: triangulation.ObjectPositions, eyes: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, float] | None:
    """Fit the plane that carries the objects: most background points, with objects and cameras on one side.

    Args:
        background: Background points. [P, 3]
        places: Positions of the objects.
        eyes: Centres of the cameras. [V, 3]
        rng: Random generator (RANSAC).

    Returns:
        Unit normal towards the cameras and offset h in n . x = h; None if no plane contains a fifth of the points.
    """
    tolerance = 0.05
    if len(background) < 50:
        return None
    inside = np.concatenate([places.centers[places.measured], eyes])
    best: np.ndarray | None = None
    for _ in range(500):
        a, b, c = background[rng.choice(len(background), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-6:
            continue
        normal /= length
        side = (inside - a) @ normal
        if np.median(side) < 0:
            normal, side = -normal, -side
        if (side < -tolerance).mean() > 0.05:
            continue
        near = np.abs((background - a) @ normal) < tolerance
        if best is None or near.sum() > best.sum():
            best = near
    if best is None or best.sum() < 0.2 * len(background):
        return None
    inliers = background[best]
    middle = np.median(inliers, axis=0)
    normal = np.linalg.svd(inliers - inliers.mean(0), full_matrices=False)[2][2]
    normal = normal if np.median((inside - middle) @ normal) > 0 else -normal
    return normal, float(np.median(inliers @ normal))


def _at_once(views: Sequence[TrainView], times: np.ndarray, knot: int) -> Sequence[TrainView]:
    """Return the views of one observed time, in which moving objects have one place; all views if these are too few."""
    then = [v for v in views if nearest_knot(times, v.t) == knot]
    return then if len(by_camera(then)) >= MIN_CAMERAS else views


def _first_time(places: triangulation.ObjectPositions, count: int) -> int:
    """Return the index of the time at which most objects are well visible.

    Among similar times the middle one is taken, to minimise drift.
    """
    if len(places.object_ids) == 0:
        return 0
    total = np.where(places.measured, places.visibility + SEEN_AT_ALL, 0.0).sum(0)
    good = np.flatnonzero(total >= 0.9 * total.max())
    return int(good[np.argmin(np.abs(good - (count - 1) / 2))])


def _reference_time(visibility: np.ndarray, measured: np.ndarray, first: int) -> int:
    """Return the time nearest to ``first`` at which an object is well visible."""
    score = np.where(measured, visibility + SEEN_AT_ALL, 0.0)
    good = np.flatnonzero(score >= 0.75 * score.max())
    return int(good[np.argmin(np.abs(good - first))])
