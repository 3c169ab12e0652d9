"""Set up all tests: report the available Blender, and run Hypothesis without deadlines (first calls compile)."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import itertools
import os
import sys
from pathlib import Path

import hypothesis
import pytest

if sys.dont_write_bytecode:  # else each process that a test starts compiles all modules
    sys.dont_write_bytecode = False
    sys.pycache_prefix = str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "bytecode")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ.setdefault("PYTHONPYCACHEPREFIX", sys.pycache_prefix)

if "PYTEST_XDIST_WORKER" in os.environ:  # one process per core, so each gets one thread
    for variable in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

BPY_PYTHON = (3, 11)
STATUS = pytest.StashKey[int]()
NOT_QUICK = ("blender", "heavy", "slow", "nightly", "gpu", "browser", "cluster")

# Files in the order in which two processes take them: the first one compiles kernels in test_warm_up.
FIRST_FILES = ("test_warm_up.py", "test_breaks.py", "test_compilation.py", "test_model_selection.py")

hypothesis.settings.register_profile("r5dgs", deadline=None, max_examples=50)
hypothesis.settings.load_profile("r5dgs")


@pytest.fixture(scope="session")
def settings_folders(tmp_path_factory):
    """Iterator over new folders of user settings, which do not exist yet."""
    base = tmp_path_factory.mktemp("settings")
    return (base / str(number) for number in itertools.count())


@pytest.fixture(autouse=True)
def no_user_settings(monkeypatch, settings_folders):
    """Give every test an empty folder of user settings, so that those of the tester are neither read nor changed."""
    folder = next(settings_folders)
    for variable in ("XDG_CONFIG_HOME", "APPDATA"):
        monkeypatch.setenv(variable, str(folder))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add options for `--quick` and for the number of random draws."""
    group = parser.getgroup("r5dgs")
    group.addoption("--bit-flips", type=int, default=200, metavar="N", help="flipped bits of each checkpoint")
    group.addoption("--kills", type=int, default=30, metavar="N", help="killed runs of the nightly test")
    left_out = f"leave out tests marked {', '.join(NOT_QUICK)}, whatever -m chooses"
    group.addoption("--quick", action="store_true", help=left_out)


def pytest_configure(config: pytest.Config) -> None:
    """Let pytest-xdist hand out files in the order of collection, not by their number of tests."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


@pytest.hookimpl(wrapper=True)
def pytest_pycollect_makeitem(collector: pytest.Collector) -> object:
    """Mark the cases of a test as slow that its marker `default_cases` does not name.

    Raises:
        pytest.Collector.CollectError: The marker names a case that does not exist.
    """
    made = yield
    for item in made if isinstance(made, list) else ():
        marker = item.get_closest_marker("default_cases")
        if marker is None:
            continue
        unknown = set(marker.args) - {other.callspec.id for other in made}
        if unknown:
            raise collector.CollectError(f"{item.originalname}: default_cases names unknown cases: {sorted(unknown)}")
        if item.callspec.id not in marker.args:
            item.add_marker("slow")
    return made


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect long tests with ``--quick``, and begin with the longest files if several processes share them.

    The first process compiles all kernels while the second one runs files that need none, so that no two compile them.

    Tests with the fixture `blender` count as marked.
    """
    long = [
        item
        for item in items
        if any(item.get_closest_marker(name) for name in NOT_QUICK) or "blender" in getattr(item, "fixturenames", ())
    ]
    if config.getoption("--quick"):
        config.hook.pytest_deselected(items=long)
        items[:] = [item for item in items if item not in set(long)]
    elif hasattr(config, "workerinput"):
        heavy = {item.path for item in items if item.get_closest_marker("heavy")}
        longer = {item.path for item in long}
        rank = {name: place for place, name in enumerate(FIRST_FILES)}
        items.sort(
            key=lambda item: (rank.get(item.path.name, len(rank)), item.path not in heavy, item.path not in longer)
        )


def pytest_report_header(config: pytest.Config) -> str:
    """Report the version of bpy, or the reason for skipping Blender tests."""
    if importlib.util.find_spec("bpy") is not None:
        try:
            return f"blender: bpy {importlib.metadata.version('bpy')}"
        except importlib.metadata.PackageNotFoundError:
            return "blender: this is one"
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    if sys.version_info[:2] != BPY_PYTHON:
        wanted = ".".join(map(str, BPY_PYTHON))
        return f"blender: ABSENT, its tests are skipped: the bpy module exists for Python {wanted}, this is {here}"
    remedy = "pip install -c constraints.txt -e '.[test]'"
    return f"blender: ABSENT, its tests are skipped: bpy is not installed, {remedy}"


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Store the exit status for `pytest_unconfigure`."""
    session.config.stash[STATUS] = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """End the process at once if the bpy module is loaded and pytest is the program.

    Blender 4.2 crashes at the end of Python if a reference to the module is left, and the crash would replace pytest's
    exit status. A test run leaves two: pytest's import hook keeps the session and the tracebacks of failures alive, and
    a timer that is registered while another file is opened is freed only by an event loop, which the module lacks.
    `addon/test_life.py` checks that the extension itself leaves no reference.
    """
    bpy = sys.modules.get("bpy")
    if bpy is None or bpy.app.binary_path or config.invocation_params.plugins or STATUS not in config.stash:
        return
    config.get_terminal_writer().flush()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(config.stash[STATUS])
