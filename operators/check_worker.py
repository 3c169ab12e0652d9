"""Test Worker: start the worker's Python, say what it has and how fast it is."""

import time

import bpy

from ..r5dgs_addon import preferences, waiting, worker

KEY = "check"


class R5DGS_OT_check_worker(waiting.Waiting, bpy.types.Operator):
    """Start the worker anew, with the Python chosen above or found, and say its versions, device and speed (the \
first time it compiles, 10 s)"""

    bl_idname = "r5dgs.check_worker"
    bl_label = "Test Worker"
    waits_for = "Test Worker"

    @classmethod
    def poll(cls, context):
        if worker.busy():
            cls.poll_message_set("The worker is rendering; wait for it, or stop it with Esc")
            return False
        return True

    def _begin(self, context):
        self._began = time.monotonic()
        worker.stop()
        preferences.forget()
        return worker.submit(KEY, [("testing", "check", {})])

    def _finish(self, context, answer):
        found, _ = answer
        versions = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
        seconds = time.monotonic() - self._began
        compiled = f", rasterizer compiled in {seconds:.0f} s, once" if found["compiled"] else ""
        width, height = found["size"]
        self.report(
            {"INFO"},
            f"Worker ready: {self._job.python} ({versions}), {found['device']}{compiled}; "
            f"{found['gaussians']:,} Gaussians at {width} x {height} in {found['milliseconds']:.0f} ms",
        )
        return {"FINISHED"}


CLASSES = (R5DGS_OT_check_worker,)
