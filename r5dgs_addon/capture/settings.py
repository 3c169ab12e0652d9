"""Settings of a capture, and the splits of the data set that it writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class CaptureSettings:
    """What to capture; every default suits a scene that was never meant for it.

    Attributes:
        directory: Folder of the data set; absent or empty.
        resolution_x: Image width in pixels.
        resolution_y: Image height in pixels.
        samples: Cycles samples per pixel.
        denoise: Denoise with OpenImageDenoise.
        transparent: Write RGBA images with a transparent sky.
        seed: Sampling seed of the first image; later ones count on from it.
        view_transform: Blender's view transform; "Standard" is plain sRGB, "" keeps the scene's.
        device: Cycles device, "CPU" or "GPU".
        frame_start: Frame of t = 0; None for the scene's.
        frame_end: Frame of t = 1; None for the scene's.
        frame_step: Captured frames are this far apart.
        t_max: Frames up to this time are observed (train and val), later ones are test.
        val_every: Novel views are rendered at every n-th observed time.
        val_between: Novel views are also rendered half-way between observed times.
        test_every: Every n-th later time is rendered.
        test_views: Number of observed views in test, beside all novel ones.
        observed: Names of the observed cameras: patterns such as "cam*, left", or a collection; "" for all.
        novel: The same for the novel cameras.
        rig: Generated cameras: "NONE", "ARC", "RING", "HEMISPHERE", or "AUTO": an arc about the scene camera where
            the scene has fewer than three observed cameras of its own.
        rig_observed: Number of generated observed cameras.
        rig_novel: Number of generated novel cameras.
        rig_target: Point, or name of the object, that the rig looks at; "" for the middle of the objects.
        rig_radius: Distance of the rig from its target; 0 for one that sees all objects.
        rig_elevation_deg: Elevation of the rig above its target.
        rig_elevation_spread_deg: Neighbours on an arc or ring differ by this much in elevation.
        rig_azimuth_deg: Direction of the middle of the arc, counter-clockwise from +X; -90 is Blender's front.
        rig_arc_deg: Length of the arc.
        rig_fov_deg: Horizontal field of view of the rig.
        objects: What counts as an object: "PASS_INDEX", "COLLECTION", "SELECTED", "ANIMATED", or "AUTO": by pass index
            where any is set, else what is animated or selected.
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
