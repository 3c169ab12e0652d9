"""Kernels for machines with shorter vectors draw the same pictures."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = """
import torch
from tests.support.agreement import assert_within_bars
from tests.support.splats import camera, splats
for n_channels in (3, 19):
    background = torch.rand(40, 48, n_channels, generator=torch.Generator().manual_seed(1)).double()
    assert_within_bars(splats(400, n_channels, seed=n_channels), camera(), background)
"""


@pytest.mark.nightly
@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="these are kinds of x86")
@pytest.mark.parametrize("kind", ["haswell", "x86-64-v2"])
def test_machines_with_shorter_vectors_draw_as_the_reference_does(kind, tmp_path):
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": kind,
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": str(ROOT),
    }
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
