"""Colours of the worker as Blender's scene-linear ones, such that the view transform gives back what was trained.

A picture of the core is display-referred sRGB. Blender's view transform *Standard* is sRGB's transfer function, so its
inverse is what a render result has to hold. Under others (AgX, Filmic), or with a look, an exposure or curves, the
inverse is a table of `view_transform`; where it is switched off or too coarse, `objections` says so.
"""

from collections.abc import Callable

import bpy
import numpy as np

from ...r5dgs_core.color import view_inverse
from .. import compat
from ..scene import render_settings
from . import view_transform

STANDARD = "Standard"
FAIR = view_inverse.VISIBLE / view_inverse.STEP
WIDE = 0.9  # a view that reaches less of the table leaves saturated colours pale
POOR = 25.0  # a view with such an inverse (*False Color*) has none worth the name


def scene_linear(
    color: np.ndarray,  # [H, W, 3]
    alpha: np.ndarray | None = None,  # [H, W]
    inverse: view_inverse.Inverse | None = None,
) -> np.ndarray:  # [H, W, 4]
    """A picture as Blender's *Combined* pass, alpha premultiplied.

    Colours over 1 stay over 1, without an inverse. The picture was blended as it is displayed; so the colour that is
    made linear is that of the pixel without its alpha, which then saves as straight alpha with the picture's own bytes.

    Args:
        color: Display-referred sRGB, >= 0; multiplied by alpha where there is one. [H, W, 3]
        alpha: Coverage, or None for an opaque picture. [H, W]
        inverse: Of the view transform; of *Standard* where None.

    Returns:
        Scene-linear RGBA, float32, rows as they came. [H, W, 4]
    """
    result = np.ones((*color.shape[:2], 4), np.float32)
    straight = np.maximum(np.asarray(color, np.float32), 0)
    if alpha is not None:
        result[..., 3] = np.clip(alpha, 0, 1)
        straight = straight / np.maximum(result[..., 3:], 1e-6)
    if inverse is not None:
        linear = inverse.scene_linear(straight)
    else:
        linear = np.where(straight <= 0.04045, straight / 12.92, ((straight + 0.055) / 1.055) ** 2.4)
    linear = view_transform.in_space(linear, compat.working_space())
    result[..., :3] = linear if alpha is None else linear * result[..., 3:]
    return result


def inverts(scene: bpy.types.Scene) -> bool:
    """Whether a scene's view is to be inverted by a table."""
    return render_settings.of(scene).as_trained and view_transform.can(scene) and bool(differences(scene))


def inverse(scene: bpy.types.Scene) -> view_inverse.Inverse | None:
    """The inverse of a scene's view, or None: it needs none, has none, or has none yet, and then gets it soon."""
    found = view_transform.want(scene) if inverts(scene) else None
    return found if found is not None and found.error <= POOR else None


def wait_for_inverse(scene: bpy.types.Scene, stopped: Callable[[], bool]) -> view_inverse.Inverse | None:
    """As `inverse`, and one that it has not yet is made or waited for, unless ``stopped`` says that nobody does."""
    if inverts(scene):
        view_transform.wait(scene, stopped)
    return inverse(scene)


def objections(scene: bpy.types.Scene) -> list[str]:
    """Why colours do not come out as trained under a scene's colour management, in a few words each; else empty.

    While the inverse of a view is still to be made, the view is objected to.
    """
    found, made = differences(scene), inverse(scene)
    if made is not None:
        found = [*found, f"off by {made.error:.0f} of 255 steps"] if made.error > FAIR else []
    return found + (["the output's own color management"] if _saves_otherwise(scene) else [])


def _saves_otherwise(scene: bpy.types.Scene) -> bool:
    """Whether files are written with another view than the scene's (Output > Color Management > Override)."""
    output, view = scene.render.image_settings, scene.view_settings
    if output.color_management != "OVERRIDE":
        return False
    names = ("view_transform", "look", "exposure", "gamma", "use_curve_mapping")
    return any(getattr(output.view_settings, name) != getattr(view, name) for name in names)


def differences(scene: bpy.types.Scene) -> list[str]:
    """What in a scene's colour management is not as *Standard* is by itself, in a few words each; else empty."""
    view, found = scene.view_settings, []
    if view.view_transform != STANDARD:
        found.append(f"view transform {view.view_transform}")
    if view.look != "None":
        found.append(f"look {view.look}")
    if view.exposure != 0:
        found.append(f"exposure {view.exposure:.3g}")
    if view.gamma != 1:
        found.append(f"gamma {view.gamma:.3g}")
    if view.use_curve_mapping:
        found.append("curves")
    if getattr(view, "use_white_balance", False):
        found.append("white balance")
    return found


def show_as_trained(scene: bpy.types.Scene) -> None:
    """Set a scene's colour management such that it has no `objections`."""
    view = scene.view_settings
    scene.render.image_settings.color_management = "FOLLOW_SCENE"
    view.view_transform, view.exposure, view.gamma, view.use_curve_mapping = STANDARD, 0.0, 1.0, False
    view.look = "None"  # after the view transform, which decides what looks there are
    if hasattr(view, "use_white_balance"):
        view.use_white_balance = False
