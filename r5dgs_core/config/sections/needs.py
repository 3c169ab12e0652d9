"""Section of the needs of a scene."""

from __future__ import annotations

from dataclasses import dataclass

NEEDS = ("auto", "on", "off")


@dataclass(frozen=True)
class NeedsSection:
    """User's overrides of the decisions in the needs table (`bake/needs.py`).

    "auto" decides from measurements, "on" keeps the feature, "off" leaves it out.

    Attributes:
        tracks: Motion of the objects.
        rotation: Rotation of the objects; without it, they only translate.
        shading: Colours that change as objects turn.
        shadows: Shadow Gaussians.
        view_dependent_colour: Harmonics of the colour up to ``train.sh_degree`` ("on" raises it to at least 1).
        sky_gradient: Harmonics of the sky; without them, the sky has one colour.
        classifier: Identity encodings and their classifier.
        residuals: Residual motion of non-rigid objects.
        regrouping: Assignment of a field's Gaussians to the group that explains their motion best, instead of the group
            of their object.
        camera_poses: Refinement of the cameras' poses.
        focal_lengths: Refinement of their focal lengths.
        time_offsets: Refinement of the offsets of their clocks.
        camera_colours: Refinement of the gain and offset of their colours.
        unexplained_regions: Leaving out of regions that move although no mask names them.
        contact: Contacts between bodies past t_max; needs the extra "contact". "on" equals "auto".
    """

    tracks: str = "auto"
    rotation: str = "auto"
    shading: str = "auto"
    shadows: str = "auto"
    view_dependent_colour: str = "auto"
    sky_gradient: str = "auto"
    classifier: str = "auto"
    residuals: str = "auto"
    regrouping: str = "auto"
    camera_poses: str = "auto"
    focal_lengths: str = "auto"
    time_offsets: str = "auto"
    camera_colours: str = "auto"
    unexplained_regions: str = "auto"
    contact: str = "auto"
