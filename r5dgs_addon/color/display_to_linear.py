"""Conversion of worker images to Blender's scene-linear colours, so that the view transform restores them.

Images of the core are display-referred sRGB. Blender's view transform *Standard* is the sRGB transfer function, so a
render result must hold its inverse. For other transforms (AgX, Filmic), looks, exposure or curves, the inverse is a
table of `view_transform`. If that is disabled or too inaccurate, `objections` lists the reasons.
"""

from collections.abc import Callable

import bpy
import numpy as np

from ...r5dgs_core.color import srgb, view_inverse
from .. import compat
from ..scene import render_settings
from . import view_transform

STANDARD = "Standard"
FAIR = view_inverse.VISIBLE / view_inverse.STEP
WIDE = 0.9  # minimum share of displayable colours reached by the view; below it, saturated colours look pale
POOR = 25.0  # maximum error in steps of 1/255; worse inverses (*False Color*) are not used


def scene_linear(
    color: np.ndarray,  # [H, W, 3]
    alpha: np.ndarray | None = None,  # [H, W]
    inverse: view_inverse.Inverse | None = None,
) -> np.ndarray:  # [H, W, 4]
    """Convert an image to Blender's *Combined* pass, with premultiplied alpha.

    Without an inverse, colours above 1 stay above 1. Images are blended in display space. Therefore the straight colour
    is linearised and then premultiplied; an image saved with straight alpha has its original bytes again.

    Args:
        color: Display-referred sRGB, >= 0, premultiplied if ``alpha`` is given. [H, W, 3]
        alpha: Coverage, or None for an opaque image. [H, W]
        inverse: Inverse of the view transform, or None for *Standard*.

    Returns:
        Scene-linear RGBA, float32, in the same row order. [H, W, 4]
    """
    result = np.ones((*color.shape[:2], 4), np.float32)
    straight = np.maximum(np.asarray(color, np.float32), 0)
    if alpha is not None:
        result[..., 3] = np.clip(alpha, 0, 1)
        straight = straight / np.maximum(result[..., 3:], 1e-6)
    linear = srgb.to_linear(straight) if inverse is None else inverse.scene_linear(straight)
    linear = view_transform.in_space(linear, compat.working_space())
    result[..., :3] = linear if alpha is None else linear * result[..., 3:]
    return result


def inverts(scene: bpy.types.Scene) -> bool:
    """True if the scene's view transform is inverted by a table."""
    return render_settings.of(scene).as_trained and view_transform.is_supported(scene) and bool(differences(scene))


def inverse(scene: bpy.types.Scene) -> view_inverse.Inverse | None:
    """Inverse of the scene's view transform, or None if not needed, unusable, or not yet computed (then scheduled)."""
    found = view_transform.cached_or_requested(scene) if inverts(scene) else None
    return found if found is not None and found.error <= POOR else None


def wait_for_inverse(scene: bpy.types.Scene, stopped: Callable[[], bool]) -> view_inverse.Inverse | None:
    """Like `inverse`, but compute a missing table or wait for it until ``stopped`` returns True."""
    if inverts(scene):
        view_transform.wait(scene, stopped)
    return inverse(scene)


def objections(scene: bpy.types.Scene) -> list[str]:
    """Reasons why a scene's colour management does not reproduce the trained colours; empty if it does.

    Until the inverse of a view transform has been computed, the view transform is listed.
    """
    found, made = differences(scene), inverse(scene)
    if made is not None:
        found = [*found, f"off by {made.error:.0f} of 255 steps"] if made.error > FAIR else []
    return found + (["the output's own color management"] if _saves_otherwise(scene) else [])


def _saves_otherwise(scene: bpy.types.Scene) -> bool:
    """True if files are saved with another view than the scene's (Output > Color Management > Override)."""
    output, view = scene.render.image_settings, scene.view_settings
    if output.color_management != "OVERRIDE":
        return False
    names = ("view_transform", "look", "exposure", "gamma", "use_curve_mapping")
    return any(getattr(output.view_settings, name) != getattr(view, name) for name in names)


def differences(scene: bpy.types.Scene) -> list[str]:
    """Settings of a scene's colour management that differ from plain *Standard*, as short phrases."""
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
    """Change a scene's colour management so that `objections` is empty."""
    view = scene.view_settings
    scene.render.image_settings.color_management = "FOLLOW_SCENE"
    view.view_transform, view.exposure, view.gamma, view.use_curve_mapping = STANDARD, 0.0, 1.0, False
    view.look = "None"  # after the view transform, which determines the available looks
    if hasattr(view, "use_white_balance"):
        view.use_white_balance = False
