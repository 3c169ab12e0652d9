"""Test Worker operator: start the worker and report its versions, device and speed."""

import time

import bpy

from ..r5dgs_addon import preferences
from ..r5dgs_addon.ui import worker_status
from ..r5dgs_addon.worker import jobs, worker_operator
from ..r5dgs_core import errors

KEY = "check"


class R5DGS_OT_check_worker(worker_operator.WaitsForWorker, bpy.types.Operator):
    """Restart the worker and report versions, device and speed; the first test compiles the rasterizer (10 to 30 s)"""

    bl_idname = "r5dgs.check_worker"
    bl_label = "Test Worker"
    waits_for = "Test Worker"

    @classmethod
    def poll(cls, context):
        if jobs.busy():
            cls.poll_message_set("The worker is rendering; wait for it, or stop it with Esc")
            return False
        return True

    def _begin(self, context):
        self._began = time.monotonic()
        jobs.stop()
        preferences.forget()
        job = jobs.submit(KEY, [("measuring its speed", "check", {})])
        worker_status.begin(job)
        return job

    def modal(self, context, event):
        if event.type == "TIMER":
            worker_status.redraw()
        return worker_operator.WaitsForWorker.modal(self, context, event)

    def cancel(self, context):
        worker_operator.WaitsForWorker.cancel(self, context)
        worker_status.end("Stopped", "CANCEL")

    def _answered(self, context):
        try:
            text = self._summary(self._job.answer())
        except errors.R5dgsError as error:
            worker_status.end(str(error), "ERROR")
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        worker_status.end(text, "CHECKMARK")
        self.report({"INFO"}, text)
        return {"FINISHED"}

    def _summary(self, answer: jobs.Answer) -> str:
        found, _ = answer
        versions = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
        seconds = time.monotonic() - self._began
        compiled = f", rasterizer compiled in {seconds:.0f} s (first use only)" if found["compiled"] else ""
        width, height = found["size"]
        return (
            f"Worker ready: {self._job.python} ({versions}), {found['device']}{compiled}; "
            f"{found['gaussians']:,} Gaussians at {width} x {height} in {found['milliseconds']:.0f} ms"
        )


CLASSES = (R5DGS_OT_check_worker,)
