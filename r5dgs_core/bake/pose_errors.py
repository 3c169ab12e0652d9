"""Standard deviations of the observed poses of bodies, from the training images.

Notation: J is the derivative of a body's pixels with respect to its pose, r their misfit, g = J^T r the score of a
view. S knots, P values of pixels. A change of a pose is a rotation vector in world axes, and a displacement in radii of
the body.

The pose of least misfit has the covariance (J^T J)^-1 (sum g g^T) (J^T J)^-1. The sum is over views instead of pixels,
because the misfits of trained Gaussians are correlated over a view. The ratio to the covariance for independent pixels
is pooled over the knots of a body, because single knots have few views. A track also drifts together with the texture
that is trained with it; `FACTOR` is the measured ratio of true errors to these deviations. If the misfit is as large as
the contrast of the texture, wrong rotations have blurred it, and the rotations are unknown.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..config.config import Config
from ..data import dataset as datasets
from ..motion import rotations
from ..motion.history import UNKNOWN_TURN, PoseErrors
from ..playback import scene_player
from ..render import posed_scene, scene_renderer
from ..render.posed_scene import PosedScene
from ..scene import cameras, sampling
from ..scene.scene import Scene
from ..train import train_views
from . import unseen_rotations
from .unseen_rotations import Surface, Unseen

VIEWS = 4  # maximum number of views of a knot, spread evenly
STEP = 0.03  # change of the pose for finite differences, rad or radii
MARGIN = 2  # dilation of the pixels that show a body, px
MIN_PIXELS = 8  # minimum number of pixels of a body in a view
FACTOR = 1.2  # ratio of measured errors to deviations, of displacements and of rotations
UNEXPLAINED = 0.5  # misfit above which the rotations are unknown, as a share of the contrast of the texture
LARGE = 2.0  # misfit that may count as unexplained, relative to the root mean square misfit of all pixels
UNKNOWN = UNKNOWN_TURN  # also the standard deviation of an unknown displacement, radii


@dataclass(frozen=True)
class _BodyPixels:
    """Pixels of a body in a view.

    Attributes:
        slopes: Derivatives of the values with respect to the pose. [P, 6]
        misses: Picture minus image. [P]
        inner: Squared misfit of the pixels inside the body's outline.
        texture: Squared differences of these pixels in the image from their mean colour.
        values: Number of values of these pixels.
        points: Points of the surface that they show, world. [P', 3]
        colors: Their colours in the image. [P', 3]
        eye: Position of the camera. [3]
        plane: Two orthogonal unit vectors perpendicular to the direction of the body, world. [2, 3]
        moments: Second moments of its outline along them, at distance 1. [2, 2]
    """

    slopes: np.ndarray
    misses: np.ndarray
    inner: float
    texture: float
    values: int
    points: np.ndarray
    colors: np.ndarray
    eye: np.ndarray
    plane: np.ndarray
    moments: np.ndarray


@dataclass(frozen=True)
class Measured:
    """Errors of the observed poses of bodies, by group.

    Attributes:
        errors: The errors; those of rotations leave out unseen axes.
        unseen: Bodies with rotations that the images do not show.
    """

    errors: dict[int, PoseErrors]
    unseen: dict[int, Unseen]


NOTHING = Measured({}, {})


def measure(
    scene: Scene,
    dataset: datasets.Dataset,
    config: Config,
    groups: Collection[int],
    masked: bool,
    explained: Callable[[datasets.View, np.ndarray], np.ndarray | None] = lambda view, image: None,
) -> Measured:
    """Return the errors of the observed poses of some groups, and the rotations that are not seen.

    Args:
        scene: The scene with the trained motion.
        dataset: Its data set.
        config: Configuration of the run.
        groups: The bodies.
        masked: True if the masks of the data set have the ids of the scene's objects.
        explained: Returns the pixels of a view that training has not left out, given its image in the colours of its
            camera; None for all. [H, W] bool

    Raises:
        DatasetError: An image is missing or cannot be read.
    """
    scene = dataclasses.replace(scene, t_max=math.inf)  # the player then never uses the motion model
    players = [scene_player.Player(part) for part in (scene, *(_moved(scene, groups, axis) for axis in range(6)))]
    behind = train_views.behind(dataset, config)
    knots = np.array([train_views.nearest_knot(scene.tracks.times, view.t) for view in dataset.train])
    looks: dict[tuple[int, int], list[_BodyPixels]] = {}
    misfits = []
    for knot in range(len(scene.tracks.times)) if groups else ():
        views = [view for view, k in zip(dataset.train, knots, strict=True) if k == knot]
        posed_at: dict[float, list[PosedScene]] = {}  # by time
        for number, view in enumerate(sampling.spread(views, VIEWS)):
            if view.t not in posed_at:
                center = view.camera.center  # float32 is most precise near the cameras
                posed_at[view.t] = [posed_scene.pose_frame(scene, player.frame(view.t, center)) for player in players]
            posed = posed_at[view.t]
            given, ids = datasets.load_given_image(view, behind), datasets.load_mask(view) if masked else None
            truth = datasets.in_scene_colors(view, given)
            if ids is None or number == 0:
                picture = scene_renderer.render_frame(scene, posed[0], view.camera)
                squared, pixels = (np.clip(picture.color, 0, 1) - truth) ** 2, explained(view, given)
                misfits.append(float((squared if pixels is None else squared[pixels]).mean()))
                ids = picture.ids if ids is None else ids
            for group in groups:
                mine = ids == scene.groups[group].object_id
                if mine.sum() >= MIN_PIXELS:
                    look = _look(scene, group, posed, view, truth, mine)
                    looks.setdefault((group, knot), []).append(look)
    usual, count = float(np.mean(misfits)) if misfits else 0.0, len(scene.tracks.times)
    found: dict[int, PoseErrors] = {}
    unseen: dict[int, Unseen] = {}
    for g in groups:
        mine = [looks.get((g, s), []) for s in range(count)]
        axes = unseen_rotations.find(_surfaces(scene, g, mine))
        if axes is not None:
            unseen[g] = axes
        found[g] = _errors(mine, scene.groups[g].model.radius, usual, scene.tracks.poses[g, :, :4], axes)
    return Measured(found, unseen)


def _surfaces(scene: Scene, group: int, looks: Sequence[Sequence[_BodyPixels]]) -> list[Surface]:
    """Return the surface of a body at the knots that show it, from its pixels at each knot [S]; empty if the body has
    no Gaussians.
    """
    rest = scene.gaussians.means[scene.gaussians.motion_ids == group].astype(np.float64)
    pivot, found = scene.groups[group].pivot, []
    if len(rest) == 0:
        return found
    for pose, own in zip(scene.tracks.poses[group], looks, strict=True):
        if own:
            center = pivot + rotations.rotate(pose[:4], np.median(rest, axis=0) - pivot) + pose[4:]
            away = np.concatenate([look.points for look in own]) - center
            directions = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
            colors = np.concatenate([look.colors for look in own])
            planes = np.stack([look.plane for look in own])
            moments = np.stack([look.moments * float(((look.eye - center) ** 2).sum()) for look in own])
            found.append(Surface(directions, colors, planes, moments, pose[:4]))
    return found


def _moved(scene: Scene, groups: Collection[int], axis: int) -> Scene:
    """Return the scene with small changes of the poses of some groups: turns about an axis 0 to 2, or shifts."""
    poses = scene.tracks.poses.copy()
    for group in groups:
        if axis < 3:
            turn = rotations.rotvecs_to_quats(STEP * np.eye(3)[axis])
            poses[group, :, :4] = rotations.normalize(rotations.multiply(turn, poses[group, :, :4]))
        else:
            poses[group, :, 1 + axis] += STEP * scene.groups[group].model.radius
    return scene.with_arrays(track_poses=poses)


def _look(
    scene: Scene,
    group: int,
    frames: Sequence[PosedScene],
    view: datasets.View,
    truth: np.ndarray,
    mine: np.ndarray,
) -> _BodyPixels:
    """Compare a body's pixels in a view with pictures of the scene: in the observed poses (first), and in others."""
    region = ndimage.binary_dilation(mine, iterations=MARGIN)
    rows, columns = ndimage.find_objects(region.astype(np.int8))[0]
    size = columns.stop - columns.start, rows.stop - rows.start
    camera = cameras.crop(view.camera, columns.start, rows.start, *size)
    centers, scales = frames[0].means.astype(np.float64) + frames[0].origin, np.exp(frames[0].log_scales.max(1))
    near = np.flatnonzero(cameras.reached_by(camera, centers, scales))
    own = scene.gaussians.motion_ids[near] == group
    parts = [posed_scene.rows_of(frame, near) for frame in frames]
    region = np.asarray(region[rows, columns], bool)
    core = np.asarray(ndimage.binary_erosion(mine)[rows, columns], bool)
    drawn = [scene_renderer.render_frame(scene, posed_scene.with_moved(parts[0], part, own), camera) for part in parts]
    pictures = [np.clip(one.color, 0, 1).astype(np.float64) for one in drawn]
    depths = np.asarray(drawn[0].depth, np.float64)[core]
    rays = cameras.pixel_rays(camera)[core]
    forward = camera.T_cam_world[2, :3]
    eye = -camera.T_cam_world[:3, :3].T @ camera.T_cam_world[:3, 3]
    image = np.asarray(truth[rows, columns], np.float64)
    slopes = np.stack([(picture - pictures[0])[region].ravel() for picture in pictures[1:]], -1) / STEP
    inner = image[core] - (image[core].mean(0) if core.any() else 0.0)
    return _BodyPixels(
        slopes,
        (pictures[0] - image)[region].ravel(),
        float(((pictures[0] - image)[core] ** 2).sum()),
        float((inner**2).sum()),
        int(3 * core.sum()),
        eye + rays * (depths / (rays @ forward))[:, None],
        image[core],
        eye,
        *_outline(cameras.pixel_rays(camera)[mine[rows, columns]]),
    )


def _outline(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors perpendicular to the mean of some rays, and the second moments along them. [n, 3]"""
    middle = rays.mean(0) / np.linalg.norm(rays.mean(0))
    plane = np.linalg.svd(middle[None])[2][1:]
    return plane, np.cov(rays @ plane.T / (rays @ middle)[:, None], rowvar=False)


def _errors(
    looks: Sequence[Sequence[_BodyPixels]],
    radius: float,
    usual: float,
    quats: np.ndarray,
    unseen: Unseen | None,
) -> PoseErrors:
    """Return the errors of a body's poses.

    Args:
        looks: Its pixels in the views of each knot. S
        radius: Its radius, world units.
        usual: Squared misfit of a value anywhere in the images.
        quats: Its rotations, unit wxyz. [S, 4]
        unseen: Axes to leave out of the errors of its rotations.
    """
    variances, ratios = np.full((len(looks), 6), np.inf), []
    for s, own in enumerate(looks):
        if any(look.slopes.any() for look in own):  # a body without Gaussians changes no pixel
            slopes, misses = (np.concatenate([getattr(look, name) for look in own]) for name in ("slopes", "misses"))
            misfit = max(float((misses**2).mean()), 1e-8)
            inverse = np.linalg.inv(slopes.T @ slopes + misfit / UNKNOWN**2 * np.eye(6))
            scores = np.stack([look.slopes.T @ look.misses for look in own])
            variances[s] = misfit * np.diag(inverse)
            ratios.append(((inverse @ scores.T) ** 2).sum(1) / variances[s])
            if unseen is not None and len(unseen.axes) == 1:
                axis = rotations.rotate(quats[s], unseen.axes[0])
                across = np.eye(3) - np.outer(axis, axis)
                variances[s, :3] = 1.5 * misfit * np.diag(across @ inverse[:3, :3] @ across)  # of two axes
    every = [look for own in looks for look in own]
    inner, texture = sum(look.inner for look in every), sum(look.texture for look in every)
    blurred = inner > max(UNEXPLAINED * texture, LARGE**2 * usual * sum(look.values for look in every))
    pooled = np.mean(ratios, axis=0) if ratios else np.ones(6)
    found = []
    for part, lost in ((slice(3, 6), False), (slice(0, 3), blurred)):
        deviation = FACTOR * np.sqrt(variances[:, part].mean(1) * pooled[part].mean())
        deviation = np.where(np.isinf(deviation), deviation, UNKNOWN if lost else np.minimum(deviation, UNKNOWN))
        found.append(deviation)
    return PoseErrors(tuple((radius * found[0]).tolist()), tuple(found[1].tolist()))


def with_unseen(errors: PoseErrors, unseen: Unseen) -> PoseErrors:
    """Return the errors of all rotations, with `UNKNOWN` about unseen axes, for the scene file."""
    turn, count = np.array(errors.turn), len(unseen.axes)
    every = np.sqrt(((3 - count) * turn**2 + count * UNKNOWN**2) / 3) if count < 3 else UNKNOWN
    return dataclasses.replace(errors, turn=tuple(np.where(np.isinf(turn), turn, every).tolist()))
