"""Add Shadows operator: shadows between Gaussians and the meshes that are merged with them."""

import bpy

from ..r5dgs_addon.engine import mesh_merge, mesh_shadows, visible_clouds
from ..r5dgs_addon.scene import presence_keys
from ..r5dgs_addon.ui import plural
from ..r5dgs_addon.worker import worker_operator


class R5DGS_OT_add_shadows(worker_operator.WaitsForWorker, bpy.types.Operator):
    """Let meshes and Gaussians cast shadows on each other; adds proxies of the Gaussians to the scene of the meshes"""

    bl_idname = "r5dgs.add_shadows"
    bl_label = "Add Shadows"
    bl_options = {"REGISTER", "UNDO"}
    waits_for = "Add Shadows"

    @classmethod
    def poll(cls, context):
        meshes = mesh_merge.of(context.scene)
        if meshes is None or meshes.render.engine != "CYCLES":
            cls.poll_message_set("Merge with meshes by Cycles first; other engines have no shadow catcher")
            return False
        return True

    def _begin(self, context):
        self._background = mesh_shadows.views(context)
        return mesh_shadows.start_depths(self._background)

    def _finish(self, context, answer):
        pictures = [arrays for _, arrays in self._job.answers() if "depth" in arrays]
        everything = [obj for obj in bpy.data.objects if obj.r5dgs.role == "CLOUD"]
        with presence_keys.ignored(everything):  # objects that enter later cast shadows then
            _, clouds = visible_clouds.instances(context.evaluated_depsgraph_get())
        proxies = mesh_shadows.add(context.scene, clouds, self._background, pictures)
        self.report({"INFO"}, f"{plural.of(len(proxies.objects), 'object')} added in '{proxies.name}'")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_add_shadows,)
