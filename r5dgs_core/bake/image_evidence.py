"""Evidence of the training images on the motion of a scene's groups: image errors, significance of a change.

Notation: a group's poses change along d from the trained ones (0) to a simpler motion (1). To first order the image of
view v at l is I_v + l D_v. With the residual r_v = I_v - truth, each cluster c of views (a camera, or some of its
times) has the information q_c = sum D^2 and the score g_c = -sum r D, so that l = sum g / sum q fits the images best.
Errors are correlated between neighbouring pixels and times, and effects that change the look of a surface, such as a
passing shadow, are common to all cameras. Therefore the noise is not derived from the number of pixels: it is the
variance of sum (g - l q) over clusters of views and over patches of the body's surface (the sandwich estimate,
clustered both ways).
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ..data import dataset as datasets
from ..errors import DatasetError
from ..motion import rotations
from ..playback import scene_player
from ..render import posed_scene, scene_renderer
from ..scene import cameras
from ..scene.sampling import spread
from ..scene.scene import Scene
from ..train import train_views
from . import motion_support
from .draft import Context
from .motion_support import Compared, Support

log = logging.getLogger(__name__)

PIXELS = 700_000  # total of the sampled views
MIN_VIEWS, MAX_VIEWS = 20, 40  # limits of the number of sampled views
PATCHES = 8  # patches per body: its octants
WHOLE = 500_000  # pixels of an image above which only the part that a group may reach is drawn
FEW = 20  # bodies above which a change of one is drawn only there, of the Gaussians there, in images of any size
REACH = 3.4  # standard deviations at which an opaque Gaussian is fainter than the rasterizer draws
MARGIN = 2.0  # pixels added to the reach, for the low-pass filter and rounding
KEPT = 2_000_000  # Gaussians in the frames of the trained motion that are kept in memory
STEP = 0.02  # change of the poses for finite differences of the images, rad or radii


class ImageEvidence:
    """Comparison of a scene with a sample of its training views.

    Args:
        scene: The scene with the trained motion; groups stay within the observed time.
        views: Views, as from `sample`.
        behind: Colour behind transparent pixels; None if the images are opaque. [3]
        explained: Returns the pixels of a view to compare, given its image in the colours of its camera; None for all.
            [H, W] bool

    Raises:
        DatasetError: An image is missing or cannot be read.
    """

    def __init__(
        self,
        scene: Scene,
        views: Sequence[datasets.View],
        behind: np.ndarray | None,
        explained: Callable[[datasets.View, np.ndarray], np.ndarray | None] = lambda view, image: None,
    ):
        # With an infinite t_max, the player uses the track at the last knot, too, and never the motion model.
        self._scene = dataclasses.replace(scene, t_max=math.inf)
        self._views = views
        self._truths, self._explained = [], []
        for view in views:
            given = datasets.load_given_image(view, behind)
            self._truths.append(datasets.in_scene_colors(view, given))
            self._explained.append(explained(view, given))
        self._clusters = motion_support.clusters(views)
        moves = (scene.tracks.poses[..., 1:] != 0).any(axis=(1, 2))
        self._bodies = sum(group.role == "body" and bool(moves[group.id]) for group in scene.groups)
        self.remember()

    def remember(self) -> None:
        """Compare the pictures of the trained motion with the images; to be called when these have changed."""
        self._player = scene_player.Player(self._scene)
        self._frames: dict[int, scene_player.Frame] = {}
        self._reach: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # pixels of all Gaussians in each of the frames
        self._errors = [self._error(self._trained(row), row) for row in range(len(self._views))]
        self.psnr = _mean_psnr(self._errors)

    def loss(self, poses: np.ndarray) -> float:
        """Return the decrease of the mean PSNR on the sampled views, dB, if the groups take other poses [G, S, 7]."""
        moving = self._moving(self._scene.tracks.poses, poses)
        player = scene_player.Player(self._with(poses))
        errors = []
        for row, error in enumerate(self._errors):
            trained = self._trained(row)
            frames = [trained, player.frame_after(trained)]
            window, shown = self._window(row, frames, moving)
            if window == self._whole(row):
                errors.append(self._error(frames[1], row))
            else:
                old, new = (self._error(frame, row, window, shown) for frame in frames)
                errors.append(error + (new - old) * self._count(row, window) / self._count(row, self._whole(row)))
        return self.psnr - _mean_psnr(errors)

    def support(
        self,
        group: int,
        before: np.ndarray,
        after: np.ndarray,
        size: float,
        rows: Sequence[int] | None = None,
        compared: dict[int, Compared] | None = None,
    ) -> Support:
        """Return the significance of a change of shape and place. All pictures are drawn with the shading of ``after``,
        so that changes of colour do not count.

        Args:
            group: The group.
            before: Trained poses of all groups. [G, S, 7]
            after: Poses of all groups with the simpler motion. [G, S, 7]
            size: Largest change, rad or radii.
            rows: Indices of the views to use; None for all.
            compared: Views compared before for the same change, which are not drawn again; new ones are added.
        """
        rows = range(len(self._views)) if rows is None else rows
        compared = {} if compared is None else compared
        missing = [row for row in rows if row not in compared]
        compared |= dict(zip(missing, self._compare(group, before, after, size, missing), strict=True))
        scores, information = np.zeros((2, int(self._clusters.max()) + 1, PATCHES + 1))
        for row in rows:
            scores[self._clusters[row]] += compared[row].scores
            information[self._clusters[row]] += compared[row].information
        pixels = sum(compared[row].pixels for row in rows)
        return motion_support.estimate(scores, information, pixels, sum(compared[row].changed for row in rows))

    def _compare(
        self, group: int, before: np.ndarray, after: np.ndarray, size: float, rows: Sequence[int]
    ) -> Iterator[Compared]:
        """Compare a change with the images of some views; arguments as for `support`."""
        step = min(1.0, STEP / max(size, 1e-12))
        simpler = scene_player.Player(self._with(after))
        here, plus, minus = (
            scene_player.Player(self._with(_between(before, after, share))) for share in (0.0, step, -step)
        )
        colored = self._scene.shading is not None and not np.array_equal(before[..., :4], after[..., :4])
        octants, moving = self._octants(group), self._moving(before, after)
        for row in rows:
            trained, changed = self._trained(row), 0.0
            own = [player.frame_after(trained) for player in (here, plus, minus, simpler)]
            window, shown = self._window(row, own, moving)
            draw = functools.partial(self._draw, row=row, window=window, shown=shown)
            factor = own[3].shading_factor
            lit = own[:3] if factor is None else [dataclasses.replace(f, shading_factor=factor) for f in own[:3]]
            picture, patches = draw(dataclasses.replace(lit[0], object_ids=octants))
            slope = (draw(lit[1])[0] - draw(lit[2])[0]).astype(np.float64)
            slope /= 2 * step
            explained = self._explained[row]
            if explained is not None:
                slope[~explained[window]] = 0
                patches = np.where(explained[window], patches, PATCHES)
            error = (picture - self._truths[row][window]) * slope
            if colored:
                turned = (draw(own[3])[0] - draw(own[0])[0]) ** 2
                changed = float((turned if explained is None else turned[explained[window]]).sum())
            yield Compared(
                -np.bincount(patches.ravel(), error.sum(-1).ravel(), PATCHES + 1),
                np.bincount(patches.ravel(), (slope**2).sum(-1).ravel(), PATCHES + 1),
                int((patches < PATCHES).sum()),
                changed,
            )

    def _with(self, poses: np.ndarray) -> Scene:
        return self._scene.with_arrays(track_poses=poses)

    def _octants(self, group: int) -> np.ndarray:
        """Return the patch of each Gaussian: its octant about the pivot; `PATCHES` in other groups. [N] int32"""
        scene = self._scene
        octants = ((scene.gaussians.means > scene.groups[group].pivot) @ np.array([1, 2, 4])).astype(np.int32)
        return np.where(scene.gaussians.motion_ids == group, octants, np.int32(PATCHES))

    def strongest_views(self, changes: np.ndarray) -> list[int]:
        """Return one view per cluster: the one with the largest change [S] at the knot nearest to its time."""
        knots = np.abs(self._scene.tracks.times[:, None] - [view.t for view in self._views]).argmin(0)
        clusters = range(int(self._clusters.max()) + 1)
        mine = (np.flatnonzero(self._clusters == cluster) for cluster in clusters)
        return [int(rows[np.argmax(changes[knots[rows]])]) for rows in mine]

    def _moving(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return a mask of the Gaussians whose groups change. Poses [G, S, 7]; [N] bool"""
        return (before != after).any(axis=(1, 2))[self._scene.gaussians.motion_ids]

    def _trained(self, row: int) -> scene_player.Frame:
        """Return the frame of a view with the trained motion, relative to its camera."""
        found = self._frames.get(row) or self._frame(self._player, row)
        if (len(self._frames) + 1) * len(found.means) <= KEPT:
            self._frames[row] = found
        return found

    def _frame(self, player: scene_player.Player, row: int) -> scene_player.Frame:
        """Return the frame of a view, relative to its camera."""
        view = self._views[row]
        return player.frame(view.t, view.camera.center)

    def _whole(self, row: int) -> tuple[slice, slice]:
        camera = self._views[row].camera
        return slice(0, camera.height), slice(0, camera.width)

    def _window(
        self, row: int, frames: Sequence[scene_player.Frame], moving: np.ndarray
    ) -> tuple[tuple[slice, slice], np.ndarray | None]:
        """Return the part of a view to draw: its rows and columns, and the Gaussians [n] int that may show there.

        With up to `FEW` bodies, it is all of a small image, and all Gaussians (None).

        Args:
            row: Index of the view.
            frames: Frames to draw.
            moving: Mask of the Gaussians that differ between the frames and the trained motion. [N]
        """
        camera = self._views[row].camera
        if self._bodies <= FEW and camera.width * camera.height <= WHOLE:
            return self._whole(row), None
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for frame in frames:
            first, last = self._boxes(row, frame, moving)
            low = np.minimum(low, first.min(axis=0, initial=np.inf))
            high = np.maximum(high, last.max(axis=0, initial=-np.inf))
        size = np.array([camera.width, camera.height])
        first, last = np.floor(np.clip(low, 0, size - 1)), np.ceil(np.clip(high, 1, size))
        (left, top), (right, bottom) = first.astype(int).tolist(), np.maximum(last, first + 1).astype(int).tolist()
        shown = None
        if self._bodies > FEW:
            found = self._reach.get(row) or self._boxes(row, self._trained(row))
            if row in self._frames:
                self._reach[row] = found
            near = (found[1] >= [left, top]) & (found[0] <= [right, bottom])
            shown = np.flatnonzero(moving | near.all(axis=1))
        return (slice(top, bottom), slice(left, right)), shown

    def _boxes(
        self, row: int, frame: scene_player.Frame, rows: np.ndarray | slice = slice(None)
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest pixels that some Gaussians may show in, x and y. [P, 2] each"""
        camera = self._views[row].camera
        pixels, depth = cameras.project(camera, frame.means[rows].astype(np.float64) + camera.center)
        sizes = np.exp(frame.log_scales[rows].max(axis=1).astype(np.float64))
        slant = np.linalg.norm(pixels - camera.intrinsics[:2, 2], axis=1) / camera.intrinsics[0, 0]
        reach = (REACH * sizes * camera.intrinsics[0, 0] / depth * (1 + slant) + MARGIN)[:, None]
        near = ~(depth > self._scene.near_plane)[:, None]  # close to the camera, it may cover everything
        return np.where(near, -np.inf, pixels - reach), np.where(near, np.inf, pixels + reach)

    def _draw(
        self,
        frame: scene_player.Frame,
        row: int,
        window: tuple[slice, slice] | None = None,
        shown: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the image of a view, sRGB in [0, 1] [H, W, 3], and the patch that each pixel shows [H, W].

        Args:
            frame: Frame of the view. Its object ids are the patches of the Gaussians.
            row: Index of the view.
            window: Rows and columns to draw; None for all.
            shown: Gaussians that may show there; None for all.
        """
        camera, posed = self._views[row].camera, posed_scene.pose_frame(self._scene, frame)
        posed = posed if shown is None else posed_scene.rows_of(posed, shown)
        if window is None or window == self._whole(row):
            output = scene_renderer.render_frame(self._scene, posed, camera)
        else:
            output = scene_renderer.render_window(self._scene, posed, camera, *window)
        return np.clip(output.color, 0, 1), np.where(output.ids < 0, PATCHES, output.ids)

    def _error(
        self,
        frame: scene_player.Frame,
        row: int,
        window: tuple[slice, slice] | None = None,
        shown: np.ndarray | None = None,
    ) -> float:
        """Return the mean squared error of a picture, or of a part of it, over the explained pixels."""
        window, explained = window or self._whole(row), self._explained[row]
        squared = (self._draw(frame, row, window, shown)[0] - self._truths[row][window]) ** 2
        if explained is not None:
            squared = squared[explained[window]]
        return float(np.mean(squared)) if squared.size else 0.0

    def _count(self, row: int, window: tuple[slice, slice]) -> int:
        """Return the number of values of the explained pixels of a view in a window."""
        truth, explained = self._truths[row][window], self._explained[row]
        return truth.size if explained is None else truth.shape[2] * int(explained[window].sum())


def _mean_psnr(errors: Sequence[float]) -> float:
    return float(np.mean([-10 * math.log10(max(error, 1e-10)) for error in errors]))


def gather(scene: Scene, context: Context) -> ImageEvidence | None:
    """Return the evidence of a run's training images on a scene's motion.

    The result is None if nothing moves, or if an image is missing, which is logged as a warning.
    """
    if not np.any(scene.tracks.poses[..., 1:] != 0):
        return None
    try:
        behind = train_views.behind(context.dataset, context.config)
        return ImageEvidence(scene, sample(context.dataset.train), behind, context.explained)
    except DatasetError as error:
        log.warning(
            "the motion is simplified without the training images, so only motion below fixed thresholds is dropped: "
            "%s. Remedy: give the data set with --data",
            error,
        )
        return None


def sample(views: Sequence[datasets.View]) -> list[datasets.View]:
    """Return views spread evenly over the times of each camera, as many as `PIXELS` allows."""
    size = float(np.median([view.camera.width * view.camera.height for view in views]))
    limit = int(np.clip(PIXELS / size, MIN_VIEWS, MAX_VIEWS))
    cameras = motion_support.by_camera(views)
    if 2 * len(cameras) > limit:
        return spread(sorted(views, key=lambda view: (view.t, view.name)), limit)
    return [view for group in cameras.values() for view in spread(group, limit // len(cameras))]


def _between(before: np.ndarray, after: np.ndarray, share: float) -> np.ndarray:
    """Interpolate (or extrapolate) between poses; ``share`` is 0 at ``before`` and 1 at ``after``. [G, S, 7]"""
    quats = rotations.interpolate(before[..., :4], after[..., :4], share)
    poses = np.concatenate([quats, before[..., 4:] + share * (after[..., 4:] - before[..., 4:])], axis=-1)
    return np.where((before != after).any(axis=(1, 2), keepdims=True), poses, before)
