"""`run.py` reports failures in its output, its file and its exit code."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

pytestmark = pytest.mark.blender

SCRIPT = Path(__file__).with_name("run.py")
PASSING = "def test_it():\n    import bpy\n    assert bpy.data.objects is not None\n"


def run(*arguments):
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


@pytest.mark.slow
def test_passed_failed_and_torch_dependent_tests_are_distinguished(tmp_path):
    names = "passing", "torch", "numba", "drawing"
    passing, torch, numba, drawing = (tmp_path / f"test_{name}.py" for name in names)
    passing.write_text(PASSING)
    for path, name in ((torch, "torch"), (numba, "numba")):
        path.write_text(f"raise ModuleNotFoundError(\"No module named '{name}'\", name='{name}')\n")
    drawing.write_text("def test_it():\n    raise RuntimeError('cpu: no_such_package is not installed; remedy: pip')\n")
    done = run("--no-figures", passing, torch, numba)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "tests: passed; left out for want of torch: test_numba.py, test_torch.py" in done.stdout
    done = run("--no-figures", "--json", tmp_path / "result.json", passing, drawing)
    assert done.returncode == 1, "a missing package is no excuse if it is not torch or numba"
    assert done.stdout.rstrip().endswith("FAILED: tests")
    assert json.loads((tmp_path / "result.json").read_text())["tests"] == "FAILED with code 1"
