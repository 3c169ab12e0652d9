"""Notes about unsupported features of a render, for its report (once per render) and the render properties."""

import bpy
from bpy.app.handlers import persistent

from ..scene import evaluated_points, loaded_scenes
from . import mesh_merge, visible_clouds

_reported: set[str] = set()  # since the start of the render; an animation is one render


def of(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> list[str]:
    """Features of a Blender scene that the engine does not render, as sentences without a period.

    Args:
        depsgraph: Evaluated depsgraph, or None to skip the check for hold-outs other than point clouds.
    """
    notes = []
    solid = ("MESH", "CURVE", "CURVES", "SURFACE", "META", "FONT", "VOLUME")
    others = [obj.original for obj in depsgraph.objects if obj.type in solid] if depsgraph is not None else []
    held = sorted({obj.name for obj in others if visible_clouds.is_held_out(obj, None, depsgraph)})
    if held:
        notes.append(
            f"{', '.join(held)}: only hold-out point clouds cut Gaussians; to let these objects hide Gaussians, use "
            "Merge with Meshes"
        )
    notes += mesh_merge.notes(scene)
    return notes + [note for one in loaded_scenes.shown(scene) for note in evaluated_points.notes(one)]


def report(engine: bpy.types.RenderEngine, notes: list[str]) -> None:
    """Report notes as warnings, each once per render."""
    for note in notes:
        if note not in _reported:
            _reported.add(note)
            engine.report({"WARNING"}, f"R5DGS: {note}")


@persistent
def _begin(*_):
    _reported.clear()


def register():
    """Register the handler of the start of renders."""
    bpy.app.handlers.render_init.append(_begin)


def unregister():
    """Undo `register`."""
    if _begin in bpy.app.handlers.render_init:
        bpy.app.handlers.render_init.remove(_begin)
