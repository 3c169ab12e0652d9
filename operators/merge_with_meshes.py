"""Merge with Meshes operator: meshes by EEVEE or Cycles among the Gaussians of the R5DGS engine."""

import bpy
from bpy.props import EnumProperty

from ..r5dgs_addon import compat
from ..r5dgs_addon.engine import engine, mesh_merge, mesh_shadows
from ..r5dgs_addon.scene import polls

ENGINES = (
    ("CYCLES", "Cycles", "Render meshes with Cycles"),
    (compat.EEVEE, "EEVEE", "Render meshes with EEVEE"),
)


class R5DGS_OT_merge_with_meshes(polls.NeedsScene, bpy.types.Operator):
    """Render the meshes of this scene together with the Gaussians; makes a scene for them and compositor nodes"""

    bl_idname = "r5dgs.merge_with_meshes"
    bl_label = "Merge with Meshes"
    bl_options = {"REGISTER", "UNDO"}

    engine: EnumProperty(name="Meshes by", description="Render engine of the meshes", items=ENGINES)

    def execute(self, context):
        scene = context.scene
        if mesh_merge.of(scene) is not None:
            mesh_shadows.remove(scene)
            mesh_merge.remove(scene)
        scene.render.engine = engine.ENGINE
        meshes = mesh_merge.add(scene, self.engine)
        self.report(
            {"INFO"}, f"F12 adds the meshes of the scene '{meshes.name}', which has the meshes' render settings"
        )
        return {"FINISHED"}


CLASSES = (R5DGS_OT_merge_with_meshes,)
