"""Search for a Python that can run the worker: candidate paths, and a check for the required packages."""

import importlib.machinery
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from .process_group import ProcessGroup

NEEDED = ("numpy", "numba")  # for pictures
WANTED = ("torch",)  # for text encoders and GPUs
OLDEST = (3, 11)
TIMEOUT_S = 20.0
POLL_S = 0.05  # polling interval of the stop callback
# `find_spec` takes milliseconds; importing torch would take seconds.
CHECK = f"""
import importlib.util, sys
if sys.version_info < {OLDEST}:
    sys.exit("Python {OLDEST[0]}.{OLDEST[1]} or newer is needed")
missing = [name for name in sys.argv[1:] if importlib.util.find_spec(name) is None]
sys.exit("lacks " + ", ".join(missing) if missing else 0)
"""
FOLDERS = (".venv", "venv", "env")
HOMES = ("r5dgs", "R5DGS", ".r5dgs", "venvs/r5dgs", ".virtualenvs/r5dgs", ".venvs/r5dgs", "r5dgs-venv")
CONDAS = ("miniconda3", "anaconda3", "miniforge3", "mambaforge", "micromamba")

log = logging.getLogger(__name__)


def environment(python: str = "") -> dict[str, str]:
    """Environment for a Python: this process's, without the variables that Blender sets for its own.

    Blender's own Python gets the folder of numba as ``PYTHONPATH``, because Blender adds the packages of extensions to
    its search path only while it runs.

    Args:
        python: Path of the executable.
    """
    result = dict(os.environ)
    for name in ("PYTHONHOME", "__PYVENV_LAUNCHER__"):
        result.pop(name, None)
    spec = importlib.machinery.PathFinder.find_spec("numba") if is_own(python) else None
    if spec is not None and spec.origin:
        known = result.get("PYTHONPATH", "")
        result["PYTHONPATH"] = str(Path(spec.origin).parents[1]) + (os.pathsep + known if known else "")
    return result


def own_numba() -> str:
    """Return the origin of numba in Blender's own Python: "bundled" with the zip, "installed", or "" if missing."""
    spec = importlib.machinery.PathFinder.find_spec("numba")
    if spec is None or not spec.origin:
        return ""
    return "bundled" if ".local" in Path(spec.origin).parts else "installed"


def is_own(python: str) -> bool:
    """Return True for the path of Blender's own Python."""
    return bool(python and sys.executable) and Path(python) == Path(sys.executable)


def candidates(beside: list[Path], home: Path | None = None) -> Iterator[str]:
    """Existing Python executables, most likely first, each once.

    The order is: Blender's own; active virtual environments; environments with usual names beside the extension or in
    the home folder; the Python of the ``r5dgs`` command; the system's Python.

    Args:
        beside: Folders that belong to the extension.
        home: Home folder; the user's if None.
    """
    seen = set()
    for path in _places(beside, home or Path.home()):
        # Links are not resolved: a virtual environment's Python often links to the system's, which is another
        # environment.
        if path is not None and str(path) not in seen and path.is_file() and os.access(path, os.X_OK):
            seen.add(str(path))
            yield str(path)


def find(beside: list[Path], home: Path | None = None, stopped: Callable[[], bool] = lambda: False) -> str | None:
    """Return the first of `candidates` with all packages, else the first one with those for pictures, else None.

    Args:
        beside: As for `candidates`.
        home: As for `candidates`.
        stopped: Callback that returns True to abort the search; polled repeatedly.
    """
    able = None
    for python in candidates(beside, home):
        reason = lacking(python, (*NEEDED, *WANTED), stopped)
        if reason is None:
            return python
        log.info("worker: %s is passed over: %s", python, reason)
        if able is None and lacking(python, NEEDED, stopped) is None:
            able = python
        if stopped():
            break
    return able


def lacking(python: str, packages: Sequence[str] = NEEDED, stopped: Callable[[], bool] = lambda: False) -> str | None:
    """Return a short reason why a Python cannot run the worker, or None if it can.

    Args:
        python: Path of the executable.
        packages: Required packages.
        stopped: As for `find`.
    """
    with tempfile.TemporaryFile() as said:  # a file, because child processes of a wrapper script would keep a pipe open
        try:
            group = ProcessGroup(
                [python, "-c", CHECK, *packages],
                env=environment(python),
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
            time.sleep(POLL_S)
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
    """Python executable of a virtual or conda environment."""
    if os.name != "nt":
        return environment_folder / "bin" / "python"
    scripts = environment_folder / "Scripts" / "python.exe"
    return scripts if scripts.is_file() else environment_folder / "python.exe"


def _of_command(command: str | None) -> Path | None:
    """Python of an installed command: the one beside it, or the interpreter of its shebang line."""
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
