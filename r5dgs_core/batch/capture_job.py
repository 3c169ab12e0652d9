"""Job of one capture: train, bake, evaluate. A job that starts again continues."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import atomic_files, strict_json
from ..bench import process
from ..data import dataset as datasets
from ..errors import CheckpointError, ConfigError, R5dgsError, TrainingError
from ..train import checkpoint, run_folder
from .captures import Capture

VISIBLE_GPUS, ALL_GPUS = "CUDA_VISIBLE_DEVICES", "all"


class CrashedError(TrainingError):
    """A command was killed or has crashed, so that a repetition may succeed."""


@dataclass(frozen=True)
class CaptureJob:
    """Callable that a job executes. Its files are ``NAME`` (run folder), ``NAME.r5dgs``, ``NAME.json``, ``NAME.log``.

    Attributes:
        capture: The capture.
        out: Output folder.
        threads: Threads of the kernels; None for all cores of the job.
        gpus: GPUs that its commands see, as `visible_gpus` returns them.
        selectable_gpus: GPUs from `separate_gpus`, of which `with_least_used_gpu` selects one.
    """

    capture: Capture
    out: Path
    threads: int | None = None
    gpus: str | None = None
    selectable_gpus: tuple[str, ...] = ()

    def __call__(self) -> dict[str, Any]:
        """Finish the capture; return its ``evaluation``, or ``failure`` and ``repeat`` (True after a crash)."""
        if self.gpus == ALL_GPUS:
            os.environ.pop(VISIBLE_GPUS, None)
        elif self.gpus is not None:
            os.environ[VISIBLE_GPUS] = self.gpus
        try:
            return {"evaluation": self._finish()}
        except (R5dgsError, OSError) as error:
            return {"failure": str(error), "repeat": isinstance(error, CrashedError)}

    def _finish(self) -> dict[str, Any]:
        run, scene = self.path(""), self.path(".r5dgs")
        if self.is_trained():
            self._refuse_changes()
        else:
            given = [*self.capture.arguments, "--device", self.capture.config.train.device]
            if (run / run_folder.RUN_FILE).exists():
                given.append("--resume")
            self._command("train", str(self.capture.data), "--out", str(run), *given)
        made = self._stamp()
        if self.result().get("checkpoint") != made:
            self._command("bake", str(run), "--out", str(scene))
            evaluation = self.path(".evaluation.json")
            self._command("evaluate", str(scene), "--data", str(self.capture.data), "--json", str(evaluation))
            found = strict_json.read(evaluation, CheckpointError, "repeat the command")
            content = json.dumps({"checkpoint": made, "evaluation": found}, indent=2)
            atomic_files.write(self.path(".json"), content.encode())
        return self.result()["evaluation"]

    def checkpoint(self) -> Any:
        """Return the job that continues after preemption; submitit calls it. Training resumes from its checkpoint."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(dataclasses.replace(self))

    def with_least_used_gpu(self, others: Sequence[CaptureJob]) -> CaptureJob:
        """Return this job with the GPU that the fewest other jobs have; unchanged if there is no choice."""
        device = self.capture.config.train.device
        if len(self.selectable_gpus) < 2 or device == "cpu" or ":" in device:  # such as cuda:1, the user's choice
            return self
        return dataclasses.replace(self, gpus=min(self.selectable_gpus, key=[job.gpus for job in others].count))

    def path(self, suffix: str) -> Path:
        """Return the path of a file of the capture."""
        return self.out / (self.capture.name + suffix)

    def is_trained(self) -> bool:
        """Return True if the training is finished."""
        run = self.path("")
        return checkpoint.newest_file(run) is not None and checkpoint.load(run).finished

    def result(self) -> dict[str, Any]:
        """Return the content of the result file; empty if there is none."""
        path = self.path(".json")
        return strict_json.read(path, CheckpointError, "remove it to evaluate again") if path.exists() else {}

    def _refuse_changes(self) -> None:
        """Raise an error if the capture was trained with other settings, except for the device, or on other data."""
        run = run_folder.open_run(self.path(""))
        changed = run.config.differences(self.capture.config.replace(**{"train.device": run.config.train.device}))
        if changed:
            raise ConfigError(
                f"{self.path('')}: was trained with other values of {', '.join(changed)}; choose another --out for "
                "other settings"
            )
        data = run.config.data
        if datasets.read(self.capture.data, data.masks, data.min_registered).digest != run.digest:
            raise CheckpointError(
                f"{self.path('')}: was trained on other data than {self.capture.data} now holds; restore the data, or "
                "give the capture another 'name'"
            )

    def _stamp(self) -> list[int]:
        """Return size and time of the checkpoint, which identify it."""
        newest = checkpoint.newest_file(self.path(""))
        assert newest is not None  # the run is trained
        return [newest.stat().st_size, newest.stat().st_mtime_ns]

    def _command(self, *arguments: str) -> None:
        threads = () if self.threads is None else ("--threads", str(self.threads))
        ended = process.run([*arguments, *threads], self.path(".log"), lambda event: None, lambda ended: None)
        if ended.status == process.STOPPED:  # stopped from outside: without a result, the job is repeated
            raise SystemExit(process.STOPPED)
        if ended.status != 0:
            kind = TrainingError if ended.status in process.REFUSED else CrashedError
            raise kind(f"r5dgs {arguments[0]}: {process.reason(ended)}")


def visible_gpus(cluster: str, resources: dict[str, Any]) -> str | None:
    """Return the GPUs of a job as a value of `VISIBLE_GPUS`; None for those that the cluster gives it.

    submitit hides all GPUs from local jobs that request none. They get those of this process, `ALL_GPUS` by default.
    """
    requested = {"gpus_per_node", "local_gpus_per_node"} & resources.keys()
    return None if cluster != "local" or requested else os.environ.get(VISIBLE_GPUS, ALL_GPUS)


def separate_gpus(cluster: str, resources: dict[str, Any]) -> tuple[str, ...]:
    """Return the GPUs of this machine if each job may get one of them; empty if the jobs or the cluster decide."""
    requested = resources.get("local_gpus_per_node", resources.get("gpus_per_node", 1))
    if cluster != "local" or requested != 1:
        return ()
    visible = os.environ.get(VISIBLE_GPUS)
    if visible is not None:
        return tuple(filter(None, visible.split(",")))
    try:
        listed = subprocess.run(["nvidia-smi", "--list-gpus"], capture_output=True, text=True, timeout=60).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ()
    return tuple(map(str, range(sum(line.startswith("GPU ") for line in listed.splitlines()))))
