"""Rendering of the other images' votes into a view, to mend the view's mask."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..data import dataset as datasets
from ..playback import scene_player
from ..raster import RasterSettings, rasterize_splats
from ..scene.scene import Scene
from . import associate, mending, render_segments, segment_stack


def mend(
    scene: Scene,
    views: Sequence[datasets.View],
    masks: Sequence[np.ndarray],
    images: Sequence[segment_stack.ImageBags],
    found: associate.Association,
    *,
    backend: str = "auto",
) -> Iterator[np.ndarray]:
    """Mend the masks of views one by one.

    Args:
        scene: The scene that the bags were rendered from.
        masks: Their incoming ids. Sequence of [H, W]

    Yields:
        New ids of the next view, see `mending.mend`. [H, W] int32
    """
    if not mending.trusts(found):
        for image, (mask, bag) in enumerate(zip(masks, images, strict=True)):
            yield mending.relabel(mask, bag.ids, found.ids[image])
        return
    player, shares = scene_player.Player(scene), mending.shares(images, found)
    for image, (view, mask, (seen, part)) in enumerate(zip(views, masks, shares, strict=True)):
        if not mending.lacks(found, image):
            yield mending.relabel(mask, images[image].ids, found.ids[image])
            continue
        posed, camera = render_segments.relative_to_camera(player, view.camera, view.t)
        # Gaussians outside the image's bag cannot occlude.
        drawn = rasterize_splats(
            posed.means[seen],
            posed.quats[seen],
            posed.scales[seen],
            posed.opacities[seen],
            part,
            camera,
            settings=RasterSettings(near_plane=scene.near_plane),
            backend=backend,
        ).image
        yield mending.mend(mask, images[image].ids, drawn, found, image)
