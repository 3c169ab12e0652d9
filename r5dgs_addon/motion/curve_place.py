"""F-curves that move an anchor: in its active action, or in an NLA strip."""

from dataclasses import dataclass

import bpy

from ...r5dgs_core import errors
from .. import compat

COMPONENTS = (("location", 3), ("rotation_quaternion", 4))


@dataclass(frozen=True)
class Place:
    """Location of the F-curves that move an anchor.

    Attributes:
        action: Action with the curves, or None.
        slot: Slot of the action, or None if actions have no slots.
        strip: NLA strip that plays the action, or None for the active action.
    """

    action: bpy.types.Action | None
    slot: object
    strip: bpy.types.NlaStrip | None = None

    def curves(self) -> dict[tuple[str, int], bpy.types.FCurve]:
        """Location and rotation curves by data path and component."""
        if self.action is None:
            return {}
        paths = {path for path, _ in COMPONENTS}
        found = compat.channels(self.action, self.slot)
        return {(c.data_path, c.array_index): c for c in found if c.data_path in paths}


def find(anchor: bpy.types.Object) -> Place:
    """Find the curves that currently move an anchor.

    Raises:
        ConfigError: The curves cannot be written; the message gives the reason and the remedy.
    """
    name = anchor.name
    check_local(anchor)
    if anchor.rotation_mode != "QUATERNION":
        raise errors.ConfigError(
            f"{name}: expected the rotation mode Quaternion (WXYZ), found {anchor.rotation_mode}; switch it back under "
            "Transform"
        )
    animation = anchor.animation_data
    if animation is None:
        return Place(None, None)
    if animation.use_tweak_mode:
        raise errors.ConfigError(f"{name}: one of its NLA strips is being edited; leave tweak mode (Tab) first")
    if animation.action is not None:
        found = Place(animation.action, compat.slot_of(animation))
    else:
        strips = [s for track in animation.nla_tracks for s in track.strips if _moves(s)]
        if not strips:
            return Place(None, None)
        strip = strips[0]
        if len(strips) > 1:
            raise errors.ConfigError(
                f"{name}: its motion is {len(strips)} NLA strips; keep one, or make its action the active one again"
            )
        found = Place(strip.action, compat.slot_of(strip), strip)
    if found.action is not None and found.action.library is not None:
        raise errors.ConfigError(f"{name}: its action comes from another .blend file; make it local first")
    return found


def refusal(anchor: bpy.types.Object) -> str:
    """Message of the error that `find` raises for an anchor, or ""."""
    try:
        find(anchor)
    except errors.ConfigError as error:
        return str(error)
    return ""


def check_local(anchor: bpy.types.Object) -> None:
    """Raise a ConfigError if an anchor belongs to another .blend file."""
    if anchor.library is not None or anchor.override_library is not None:
        raise errors.ConfigError(f"{anchor.name}: comes from another .blend file; open that one, or append it here")


def _moves(strip: bpy.types.NlaStrip) -> bool:
    """True if an NLA strip plays location or rotation curves."""
    return strip.type == "CLIP" and bool(Place(strip.action, compat.slot_of(strip)).curves())


def make_own(anchor: bpy.types.Object) -> None:
    """Give an anchor a copy of its action if other objects use the same one."""
    animation = anchor.animation_data
    action = animation.action if animation is not None else None
    if action is None or action.users - action.use_fake_user <= 1:
        return
    slot = compat.slot_of(animation)
    for other in bpy.data.objects:
        theirs = other.animation_data
        if other != anchor and theirs is not None and theirs.action == action and compat.slot_of(theirs) == slot:
            compat.play(anchor, action.copy(), slot)
            return
