"""Capture operator: render the scene as a training data set with images, exact masks, cameras, times and poses."""

import dataclasses
import math

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..r5dgs_addon.capture import cameras, capture, captured_objects
from ..r5dgs_addon.capture.settings import CaptureSettings
from ..r5dgs_addon.ui import plural, stepwise_operator


def _items(identifiers, descriptions):
    return [(name, name.replace("_", " ").title(), text) for name, text in zip(identifiers, descriptions, strict=True)]


class R5DGS_OT_capture_dataset(stepwise_operator.Stepwise, bpy.types.Operator):
    """Render this scene from many cameras into a data set for training R5DGS"""

    bl_idname = "r5dgs.capture_dataset"
    bl_label = "Capture R5DGS Data Set"
    bl_options = {"REGISTER"}
    work = "Capture"
    stopped = "nothing was written"

    directory: StringProperty(
        name="Folder", description="New or empty folder of the data set", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    resolution_x: IntProperty(name="Width", description="Image width in pixels", default=256, min=1)
    resolution_y: IntProperty(name="Height", description="Image height in pixels", default=256, min=1)
    samples: IntProperty(name="Samples", description="Cycles samples per pixel", default=64, min=1)
    denoise: BoolProperty(name="Denoise", description="Denoise with OpenImageDenoise", default=True)
    transparent: BoolProperty(name="Transparent Sky", description="Write RGBA images", default=False)
    seed: IntProperty(name="Seed", description="Sampling seed of the first image", default=0, min=0)
    view_transform: StringProperty(
        name="View Transform", description="Standard is plain sRGB; empty keeps the scene's", default="Standard"
    )
    device: EnumProperty(
        name="Device",
        description="Device of Cycles",
        items=[("CPU", "CPU", "Render on the processor"), ("GPU", "GPU", "As set in the preferences")],
    )
    frame_start: IntProperty(name="First Frame", description="Frame of t = 0; the scene's start frame if not set")
    frame_end: IntProperty(name="Last Frame", description="Frame of t = 1; the scene's end frame if not set")
    frame_step: IntProperty(
        name="Frame Step", description="Number of frames from one captured frame to the next", default=1, min=1
    )
    t_max: FloatProperty(name="t_max", description="Last observed time", default=0.75, min=0.0, max=1.0)
    val_every: IntProperty(
        name="Val Every",
        description="Render every n-th observed time from novel views",
        default=4,
        min=1,
    )
    val_between: BoolProperty(
        name="Val Between", description="Render novel views half-way between observed times, too", default=True
    )
    test_every: IntProperty(
        name="Test Every", description="Render every n-th time after the last observed one", default=1, min=1
    )
    test_views: IntProperty(
        name="Test Views",
        description="Number of observed views in the test split, in addition to the novel ones",
        default=4,
        min=0,
    )
    observed: StringProperty(
        name="Observed",
        description="Names of observed cameras (patterns) or their collection; empty for all cameras that are not "
        "novel, or for none if Rig is Arc, Ring or Hemisphere",
    )
    novel: StringProperty(
        name="Novel", description="Names of novel cameras (patterns) or their collection", default="*novel*"
    )
    rig: EnumProperty(
        name="Rig",
        description="Cameras that are added for the capture",
        items=_items(
            cameras.RIGS,
            (
                "An arc around the scene camera if fewer than three cameras are observed",
                "Only the scene's cameras",
                "Cameras on an arc",
                "Cameras on a ring",
                "Cameras on a hemisphere",
            ),
        ),
    )
    rig_observed: IntProperty(name="Rig Observed", description="Generated observed cameras", default=10, min=0)
    rig_novel: IntProperty(name="Rig Novel", description="Generated novel cameras", default=2, min=0)
    rig_target: StringProperty(name="Rig Target", description="Object to look at; empty for the center of all objects")
    rig_radius: FloatProperty(
        name="Rig Radius",
        description="Distance from the target; 0 to fit all objects into view",
        min=0.0,
        subtype="DISTANCE",
    )
    rig_elevation: FloatProperty(
        name="Rig Elevation",
        description="Angle above the target",
        default=math.radians(30.0),
        subtype="ANGLE",
    )
    rig_elevation_spread: FloatProperty(
        name="Rig Elevation Spread", description="Difference in elevation between neighbors", subtype="ANGLE"
    )
    rig_azimuth: FloatProperty(
        name="Rig Azimuth",
        description="Middle of the arc, counter-clockwise from +X",
        default=math.radians(-90.0),
        subtype="ANGLE",
    )
    rig_arc: FloatProperty(
        name="Rig Arc", description="Length of the arc", default=math.radians(120.0), subtype="ANGLE"
    )
    rig_fov: FloatProperty(
        name="Rig Field of View",
        description="Horizontal field of view",
        default=math.radians(45.0),
        min=math.radians(1.0),
        max=math.radians(170.0),
        subtype="ANGLE",
    )
    objects: EnumProperty(
        name="Objects",
        description="Selection of the objects of the data set",
        items=_items(
            captured_objects.CHOICES,
            (
                "By pass index if any is set, otherwise animated objects, otherwise selected ones",
                "Objects with a pass index above 0",
                "Objects in a collection; each child collection is one object",
                "Selected objects",
                "Objects that move or deform in the frame range",
            ),
        ),
    )
    object_collection: StringProperty(name="Object Collection", description="Collection that holds the objects")

    def settings(self) -> CaptureSettings:
        """Return the properties as settings; an unset frame range is that of the scene."""
        values = {}
        for field in dataclasses.fields(CaptureSettings):
            name = field.name.removesuffix("_deg")
            value = getattr(self, name)
            values[field.name] = value if name == field.name else round(math.degrees(value), 4)  # stored in 32 bits
        values["directory"] = self.target_folder()
        for name in ("frame_start", "frame_end"):
            if not self.properties.is_property_set(name):
                values[name] = None
        return CaptureSettings(**values)

    def suggest(self, context):
        return bool(self.directory)

    def steps(self, context):
        result = yield from capture.steps(context, self.settings())
        counts = ", ".join(f"{number} {split}" for split, number in result.images.items())
        unseen = [f"No image shows: {', '.join(result.unseen)}"] if result.unseen else []
        return stepwise_operator.Outcome(
            f"{result.directory}: {counts} images of {plural.of(len(result.objects), 'object')}", unseen
        )


CLASSES = (R5DGS_OT_capture_dataset,)
