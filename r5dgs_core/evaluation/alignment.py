"""Alignment of held-out cameras to a scene before it is measured.

A run that refines its cameras fits the scene to the refined cameras. A held-out camera still has the errors that the
others had. It is therefore corrected by the same parameters (pose, focal length, time, colours), which are fitted to
its own images while the scene is fixed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data import dataset as datasets
from ..data.explained_pixels import ExplainedPixels
from ..playback import scene_player
from ..render import camera_fit, scene_renderer
from ..scene import camera_correction, cameras
from ..scene.camera_correction import Correction
from ..scene.cameras import Camera
from ..scene.sampling import spacing, spread
from ..scene.scene import Scene

IMAGES = 6  # maximum number of images of a camera for the fit
TIME = 0.1  # change of time in the fit, as a share of the spacing of the observed times


def corrections(
    scene: Scene,
    views: Sequence[datasets.View],
    background: np.ndarray | None,
    backend: str = "auto",
    explained: ExplainedPixels | None = None,
) -> dict[str, Correction]:
    """Return a correction for each camera of some views by its name.

    Cameras that training has refined keep their correction. Others are fitted to images up to ``t_max``, because later
    images also contain errors of the prediction. Later images are used only if there are no others.

    Args:
        scene: The scene.
        views: Held-out views.
        background: Colour behind transparent pixels. [3]
        backend: Rasterizer.
        explained: Pixels to which cameras are fitted; None for all.
    """
    stored = scene.provenance.get("cameras", {}).get("corrections", {})
    found = {name: camera_correction.from_dict(values) for name, values in stored.items()}
    player = scene_player.Player(scene)

    def draw(camera: Camera, t: float) -> np.ndarray:
        frame = player.frame(t, camera.center)
        return scene_renderer.render_frame(scene, frame, camera, backend=backend).color

    for name in dict.fromkeys(view.camera.name for view in views):
        if name not in found:
            mine = [view for view in views if view.camera.name == name]
            early = [view for view in mine if view.t <= scene.t_max] or mine
            found[name] = _fitted(scene, spread(early, IMAGES), background, draw, explained)
    return found


def _fitted(
    scene: Scene,
    views: Sequence[datasets.View],
    background: np.ndarray | None,
    draw: camera_fit.Draw,
    explained: ExplainedPixels | None,
) -> Correction:
    """Return the correction that explains the images of a camera best."""
    shots = []
    for view in views:
        image = datasets.load_image(view, background)
        valid = None if explained is None else explained.of(view, image, datasets.load_mask(view))
        shots.append(camera_fit.Shot(view.camera, view.t, image, valid))
    times = scene.tracks.times
    units = camera_fit.Units(_depth(scene, views[0].camera), TIME * spacing(times))
    which = camera_fit.columns(pose=True, focal=True, time=len(times) > 1, color=True)
    return camera_fit.fit(draw, shots, units, which, Correction())


def _depth(scene: Scene, camera: Camera) -> float:
    """Return the median depth of the Gaussians in front of a camera."""
    _, depth = cameras.project(camera, scene.gaussians.means.astype(np.float64))
    return float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
