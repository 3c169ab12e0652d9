"""Re-Extrapolate with Contacts operator: the worker simulates the objects of the active scene."""

import bpy

from ..r5dgs_addon.motion import contact
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_addon.worker import jobs, worker_operator
from ..r5dgs_core import errors

KEY = "contact"


class R5DGS_OT_predict_contacts(worker_operator.WaitsForWorker, polls.NeedsScene, bpy.types.Operator):
    """Simulate the objects of the active scene in the worker, and rewrite the keys of those that touch something"""

    bl_idname = "r5dgs.predict_contacts"
    bl_label = "Re-Extrapolate with Contacts"
    bl_options = {"REGISTER", "UNDO"}
    waits_for = "Contacts"

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if jobs.simulates() is False:
            cls.poll_message_set("The worker's Python lacks MuJoCo: pip install 'r5dgs[contact]' there")
            return False
        return worker_operator.is_free(cls, KEY)

    def _begin(self, context):
        collection = loaded_scenes.active_collection(context)
        self._name = collection.name
        asked = contact.request(context, collection).to_json()
        return jobs.submit(KEY, [("simulating contacts", "contact", asked)])

    def _finish(self, context, answer):
        collection = bpy.data.collections.get(self._name)
        if collection is None or not collection.r5dgs.is_scene:
            raise errors.ConfigError(f"{self._name}: the scene was removed while it was simulated")
        contact.apply(collection, answer[0])
        self.report({"INFO"}, collection.r5dgs_contact.result)
        return {"FINISHED"}


CLASSES = (R5DGS_OT_predict_contacts,)
