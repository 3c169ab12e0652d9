"""Finding a Python that can run the worker: likely places, and whether the one there has what rendering needs."""

import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from .process_group import ProcessGroup

NEEDED = ("numpy", "torch", "numba")
OLDEST = (3, 11)
TIMEOUT_S = 20.0
LOOK_S = 0.05  # between two looks at whether a search is to stop
# Nothing is imported: finding a module's place takes milliseconds, importing torch takes seconds.
CHECK = f"""
import importlib.util, sys
if sys.version_info < {OLDEST}:
    sys.exit("Python {OLDEST[0]}.{OLDEST[1]} or newer is needed")
missing = [name for name in {NEEDED} if importlib.util.find_spec(name) is None]
sys.exit("lacks " + ", ".join(missing) if missing else 0)
"""
FOLDERS = (".venv", "venv", "env")
HOMES = ("r5dgs", "R5DGS", ".r5dgs", "venvs/r5dgs", ".virtualenvs/r5dgs", ".venvs/r5dgs", "r5dgs-venv")
CONDAS = ("miniconda3", "anaconda3", "miniforge3", "mambaforge", "micromamba")

log = logging.getLogger(__name__)


def environment() -> dict[str, str]:
    """Environment for another Python: this process's, without what Blender set for its own."""
    result = dict(os.environ)
    for name in ("PYTHONHOME", "__PYVENV_LAUNCHER__"):
        result.pop(name, None)
    return result


def candidates(beside: list[Path], home: Path | None = None) -> Iterator[str]:
    """Pythons that are there, likeliest first, each once.

    Blender's own; those of virtual environments that are active, or lie beside the extension or in the home folder
    under the usual names; that of the command ``r5dgs``; what the system calls Python.

    Args:
        beside: Folders that the extension calls its own.
        home: The home folder; the user's where None.
    """
    seen = set()
    for path in _places(beside, home or Path.home()):
        # A virtual environment's Python is often a link to the system's: what it links to is another one.
        if path is not None and str(path) not in seen and path.is_file() and os.access(path, os.X_OK):
            seen.add(str(path))
            yield str(path)


def find(beside: list[Path], home: Path | None = None, stopped: Callable[[], bool] = lambda: False) -> str | None:
    """The first of `candidates` that has what rendering needs, or None.

    Args:
        beside: As for `candidates`.
        home: As for `candidates`.
        stopped: Whether to give up; asked again and again.
    """
    for python in candidates(beside, home):
        reason = lacking(python, stopped)
        if reason is None:
            return python
        log.info("worker: %s is passed over: %s", python, reason)
        if stopped():
            break
    return None


def lacking(python: str, stopped: Callable[[], bool] = lambda: False) -> str | None:
    """Why a Python cannot run the worker, in a few words; None where it can."""
    with tempfile.TemporaryFile() as said:  # the children of a wrapper script would hold a pipe open
        try:
            group = ProcessGroup(
                [python, "-c", CHECK],
                env=environment(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=said,
            )
        except OSError as error:
            return error.strerror or str(error)
        deadline = time.monotonic() + TIMEOUT_S
        while group.alive:
            late = time.monotonic() > deadline
            if late or stopped():
                group.end()
                return f"no answer within {TIMEOUT_S:g} s" if late else "the search was stopped"
            time.sleep(LOOK_S)
        group.end()
        if group.process.returncode == 0:
            return None
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"exit code {group.process.returncode}"


def _places(beside: list[Path], home: Path) -> Iterator[Path | None]:
    yield Path(sys.executable) if sys.executable else None
    for name in ("VIRTUAL_ENV", "CONDA_PREFIX"):
        if os.environ.get(name):
            yield _inside(Path(os.environ[name]))
    for folder in beside:
        yield from (_inside(folder / name) for name in FOLDERS)
    for name in HOMES:
        yield _inside(home / name)
        yield from (_inside(home / name / folder) for folder in FOLDERS)
    yield from (_inside(home / name / "envs" / "r5dgs") for name in CONDAS)
    yield _of_command(shutil.which("r5dgs"))
    for name in ("python3", "python"):
        found = shutil.which(name)
        yield Path(found) if found else None


def _inside(environment_folder: Path) -> Path:
    """The Python of a virtual or conda environment."""
    if os.name != "nt":
        return environment_folder / "bin" / "python"
    scripts = environment_folder / "Scripts" / "python.exe"
    return scripts if scripts.is_file() else environment_folder / "python.exe"


def _of_command(command: str | None) -> Path | None:
    """The Python that an installed command runs with: beside it, or what its first line names."""
    if command is None:
        return None
    beside = Path(command).parent / ("python.exe" if os.name == "nt" else "python")
    if beside.is_file():
        return beside
    try:
        with open(command, "rb") as file:
            first = file.readline(512).decode(errors="replace").strip()
    except OSError:
        return None
    return Path(first[2:].strip()) if first.startswith("#!") else None
