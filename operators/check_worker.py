"""Test Worker: start the worker's Python and say what it has."""

import time

import bpy

from ..r5dgs_addon import preferences, worker
from ..r5dgs_core import errors


class R5DGS_OT_check_worker(bpy.types.Operator):
    """Start the worker with the Python chosen above and say whether it can render (the first time it compiles, 10 s)"""

    bl_idname = "r5dgs.check_worker"
    bl_label = "Test Worker"

    @classmethod
    def poll(cls, context):
        if worker.busy():
            cls.poll_message_set("A preview is being rendered; Esc stops it")
            return False
        return True

    def execute(self, context):
        began = time.monotonic()
        _wait(context, True)
        try:
            worker.stop()
            hello = worker.current().hello
            warm, _ = worker.request("warm_up")
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        finally:
            _wait(context, False)
        seconds = time.monotonic() - began
        rasterizer = f"rasterizer compiled in {seconds:.0f} s, once" if warm["compiled"] else "rasterizer ready"
        self.report({"INFO"}, f"Worker ready: {preferences.worker_python()} (Python {hello['python']}), {rasterizer}")
        return {"FINISHED"}


def _wait(context, busy):
    """Show by the pointer that Blender waits."""
    if context.window is not None:
        if busy:
            context.window.cursor_modal_set("WAIT")
        else:
            context.window.cursor_modal_restore()


CLASSES = (R5DGS_OT_check_worker,)
