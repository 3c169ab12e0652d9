"""Test of contacts by held-out poses, for bodies whose observed motion no smooth law explains.

A body that a hand moves over a table also has such a motion. Contacts are accepted only if, fitted to the poses before
the last ones, they predict these better than the best smooth law does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..motion import models, rotations, se3
from ..motion_fit import model_selection
from ..scene.scene import Scene
from . import scene_bodies, world
from .identify import Fitter
from .observed_track import Track
from .scene_bodies import SceneBody
from .world import Plane

UNEXPLAINED = 3.0  # root mean square residual of the last poses, in units of the noise, above which a law is wrong
BETTER = 1.0  # difference of such residuals of held-out poses that counts
_LAST = 6  # poses that a law must explain
_HELD, _LEAST_HELD = 0.2, 2  # share and number of held-out poses
_CLOSE = 0.05  # height over the lowest of the last places, in sizes, of a body in contact
_STANDS = 0.15  # the same over the plane of the lowest place


@dataclass(frozen=True)
class Comparison:
    """Root mean square residuals of held-out poses, in units of the noise.

    Attributes:
        smooth: Residual of the best smooth law.
        contact: Residual of a simulation with contacts.
    """

    smooth: float
    contact: float

    @property
    def better(self) -> bool:
        """True if contacts predict the poses better by more than the noise."""
        return self.contact + BETTER < self.smooth

    @property
    def good(self) -> bool:
        """True if contacts explain the poses, or not worse than the smooth law by more than the noise."""
        return self.contact < max(UNEXPLAINED, self.smooth + BETTER)

    def text(self) -> str:
        """Residuals in words."""
        return (
            f"held-out poses are predicted with errors of {self.contact:.2g} times their noise, without contacts "
            f"{self.smooth:.2g} times"
        )


def is_possible(scene: Scene, body: SceneBody) -> bool:
    """Return True if a body moves by itself, and poses can be held out."""
    group = body.group
    if not body.moves or group.joint is not None or group.parent is not None or group.follows is not None:
        return False
    return len(scene_bodies.track(scene, body)) >= _LAST + _LEAST_HELD


def is_unexplained(scene: Scene, body: SceneBody) -> bool:
    """Return True if the smooth law of a body does not fit its last poses."""
    group, last = body.group, scene_bodies.track(scene, body).rows(slice(-_LAST, None))
    quats, moved, _, _ = models.curve(body.smooth, last.times - scene.t_max)
    arms = rotations.rotate(quats, np.broadcast_to(body.solid.center - group.pivot, moved.shape))
    return _residual((quats, group.pivot + moved + arms), last) > UNEXPLAINED


def in_contact(scene: Scene, body: SceneBody, plane: Plane | None) -> bool:
    """Return True if most of a body's last poses are close to a plane."""
    if plane is None:
        return False
    track = scene_bodies.track(scene, body)
    heights = world.gaps(world.Body(body.solid), plane, track.places, track.quats)[-_LAST:]
    size, lowest = body.solid.size, float(heights.min())
    return abs(lowest) < _STANDS * size and bool(np.median(heights) - lowest < _CLOSE * size)


def compare(fitter: Fitter, up: np.ndarray) -> Comparison:
    """Fit contacts and smooth laws to the poses of a fitter before the last ones, and predict these.

    Args:
        fitter: The fitter of the body.
        up: Unit vector against gravity. [3]
    """
    track = fitter.observed
    held = max(_LEAST_HELD, round(_HELD * len(track)))
    before, last = track.rows(slice(0, -held)), track.rows(slice(-held, None))
    estimate = (again := Fitter(fitter.simulation, before, fitter.body)).run()
    simulated = again.poses(estimate.state, estimate.material, last.times - estimate.time)
    end = before.quats[-1], before.places[-1]
    law = model_selection.fit(
        before.times,
        rotations.multiply(before.quats, rotations.conjugate(end[0])),
        before.places - end[1],
        radius=0.5 * fitter.size,
        weights=1 / before.place_noise**2,
        least_noise=(float(np.median(before.place_noise)), float(np.median(before.turn_noise))),
        up=up,
    )
    turns, moved = models.evaluate(law.model, last.times - before.times[-1])
    smooth = rotations.multiply(turns, end[0]), end[1] + moved
    return Comparison(_residual(smooth, last), _residual(simulated, last))


def _residual(poses: se3.Pose, track: Track) -> float:
    """Root mean square difference per component in units of the noise; infinite if a pose is not a number."""
    missed = se3.differences(poses, (track.quats, track.places), 1.0, 1.0)
    missed[:, :3] /= track.place_noise[:, None]
    missed[:, 3:] /= track.turn_noise[:, None]
    found = float(np.sqrt((missed**2).mean()))
    return found if np.isfinite(found) else np.inf
