"""The player's folder, and the programs of its tests, which need Node and the packages of its package-lock.json."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "player"
MODULES = FOLDER / "node_modules"


def node_alone() -> str:
    """Path of Node; skips the test if it is missing."""
    found = shutil.which("node")
    if found is None:
        pytest.skip("Node is not installed; it is a package of Debian and Ubuntu, nodejs")
    return found


def node() -> str:
    """Path of Node; skips the test if it or the player's packages are missing."""
    found = node_alone()
    if not (MODULES / "puppeteer-core").is_dir():
        pytest.skip("the player's packages are not installed; remedy: npm --prefix player ci --ignore-scripts")
    return found


def validate(*paths: Path) -> list[dict[str, Any]]:
    """Reports of the Khronos validator on glTF files."""
    command = [node(), FOLDER / "tests" / "validate.mjs", *paths]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    return [json.loads(line) for line in lines]


def splat_transform() -> Path:
    """Folder of the program splat-transform; skips the test without the player's packages."""
    node()
    if not (MODULES / ".bin" / "splat-transform").exists():
        pytest.skip("splat-transform is not installed; remedy: npm --prefix player ci --ignore-scripts")
    return MODULES / ".bin"


def put_splat_transform_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the folder of splat-transform to the PATH; skips the test without the player's packages."""
    monkeypatch.setenv("PATH", f"{splat_transform()}{os.pathsep}{os.environ['PATH']}")


class Browser:
    """Headless Chromium with software WebGL, driven by ``player/tests/drive.mjs``."""

    def __init__(self):
        program = next((found for name in ("chromium", "chromium-browser") if (found := shutil.which(name))), None)
        if program is None:
            pytest.skip("Chromium is not installed; it is a package of Debian and Ubuntu, chromium")
        command = [node(), str(FOLDER / "tests" / "drive.mjs"), program]
        environment = {name: value for name, value in os.environ.items() if not name.lower().endswith("_proxy")}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment}
        self._process = subprocess.Popen(command, **pipes)

    def send(self, **command: Any) -> Any:
        """Send a command and return its result."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        assert "error" not in answer, answer["error"]
        return answer["result"]

    def open(self, url: str, width: int = 640, height: int = 400, **options: float) -> None:
        """Open an address in a window of a size in CSS pixels, and wait until the player is ready or has failed."""
        self.send(open=url, width=width, height=height, **options)

    def eval(self, code: str) -> Any:
        """Return the value of an expression of the page; ``r5dgs`` is the player."""
        return self.send(eval=code)

    def close(self) -> None:
        """End the browser."""
        self._process.communicate(timeout=60)
