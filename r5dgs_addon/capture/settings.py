"""Settings of a capture, and the splits of the data set that it writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of a capture. The defaults suit scenes that were not made for capturing.

    Attributes:
        directory: Folder of the data set; missing or empty.
        resolution_x: Image width in pixels.
        resolution_y: Image height in pixels.
        samples: Cycles samples per pixel.
        denoise: True to denoise with OpenImageDenoise.
        transparent: True to write RGBA images with a transparent sky.
        seed: Sampling seed of the first image, incremented for each image.
        view_transform: Blender's view transform; "Standard" is plain sRGB, "" keeps the scene's.
        device: Cycles device, "CPU" or "GPU".
        frame_start: Frame of t = 0; None for the scene's.
        frame_end: Frame of t = 1; None for the scene's.
        frame_step: Number of frames from one captured frame to the next.
        t_max: Last observed time; earlier frames are train and val, later ones test.
        val_every: Stride of the observed times that are rendered from novel views.
        val_between: True to render novel views half-way between observed times, too.
        test_every: Stride of the times after t_max that are rendered.
        test_views: Number of observed views in test, in addition to all novel ones.
        observed: Names of the observed cameras: patterns such as "cam*, left", or a collection; "" for all that are not
            novel, or for none if ``rig`` is "ARC", "RING" or "HEMISPHERE".
        novel: Names of the novel cameras, likewise; "" for none.
        rig: Generated cameras: "NONE", "ARC", "RING", "HEMISPHERE", or "AUTO", which is an arc around the scene
            camera if fewer than three cameras are observed; it replaces them if ``observed`` is "".
        rig_observed: Number of generated observed cameras.
        rig_novel: Number of generated novel cameras.
        rig_target: Point, or name of the object, that the rig looks at; "" for the centre of the objects.
        rig_radius: Distance of the rig from its target; 0 to fit all objects into view.
        rig_elevation_deg: Elevation of the rig above its target.
        rig_elevation_spread_deg: Difference in elevation between neighbours on an arc or ring.
        rig_azimuth_deg: Direction of the middle of the arc, counter-clockwise from +X; -90 is Blender's front.
        rig_arc_deg: Length of the arc.
        rig_fov_deg: Horizontal field of view of the rig.
        objects: Selection of objects: "PASS_INDEX", "COLLECTION", "SELECTED", "ANIMATED", or "AUTO": by pass index if
            any is set, else animated objects, else selected ones.
        object_collection: Collection for "COLLECTION".
    """

    directory: Path
    resolution_x: int = 256
    resolution_y: int = 256
    samples: int = 64
    denoise: bool = True
    transparent: bool = False
    seed: int = 0
    view_transform: str = "Standard"
    device: str = "CPU"
    frame_start: int | None = None
    frame_end: int | None = None
    frame_step: int = 1
    t_max: float = 0.75
    val_every: int = 4
    val_between: bool = True
    test_every: int = 1
    test_views: int = 4
    observed: str = ""
    novel: str = "*novel*"
    rig: str = "AUTO"
    rig_observed: int = 10
    rig_novel: int = 2
    rig_target: str | tuple[float, float, float] = ""
    rig_radius: float = 0.0
    rig_elevation_deg: float = 30.0
    rig_elevation_spread_deg: float = 0.0
    rig_azimuth_deg: float = -90.0
    rig_arc_deg: float = 120.0
    rig_fov_deg: float = 45.0
    objects: str = "AUTO"
    object_collection: str = ""
