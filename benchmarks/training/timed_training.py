"""Training of a scene in a temporary folder, timed."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from r5dgs_core.bake import bake
from r5dgs_core.config import config
from r5dgs_core.scene.scene import Scene
from r5dgs_core.train import run


def train(data: Path, settings: config.Config) -> tuple[Scene, float]:
    """Train a scene on a data set. Returns it and the processor seconds of training."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        trained = run.train(data, Path(folder) / "run", settings)
        seconds = time.process_time() - began
        return bake.bake(trained), seconds
