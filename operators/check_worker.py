"""Test Worker: start the worker's Python and say what it has."""

import bpy

from ..r5dgs_addon import preferences, worker
from ..r5dgs_core import errors


class R5DGS_OT_check_worker(bpy.types.Operator):
    """Start the worker with the Python chosen above and say whether it can render"""

    bl_idname = "r5dgs.check_worker"
    bl_label = "Test Worker"

    @classmethod
    def poll(cls, context):
        if worker.busy():
            cls.poll_message_set("A preview is being rendered; Esc stops it")
            return False
        return True

    def execute(self, context):
        try:
            worker.stop()
            hello = worker.current().hello
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Worker ready: {preferences.worker_python()} (Python {hello['python']})")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_check_worker,)
