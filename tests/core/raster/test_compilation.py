"""The cache of compiled kernels: its folder, its notices and its validity."""

import ast
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from r5dgs_core.raster import compilation, kernel_cache

pytestmark = pytest.mark.heavy

CORE = Path(__file__).resolve().parents[3] / "r5dgs_core"
TOY = """
from r5dgs_core.raster.compilation import kernel

@kernel
def double(x):
    return 2 * x

@kernel
def triple(x):
    return 3 * x

triple(14)
print(double(21), sum(double.stats.cache_hits.values()), sum(double.stats.cache_misses.values()))
"""


@pytest.fixture(autouse=True)
def forget():
    kernel_cache.folder_of.cache_clear()
    yield
    kernel_cache.folder_of.cache_clear()


def blocked(tmp_path: Path) -> Path:
    """Path in which nobody, not even root, can create a folder."""
    path = tmp_path / "a file"
    path.write_text("")
    return path


def run_toy(tmp_path, script=TOY, **environment):
    (tmp_path / "toy.py").write_text(script)
    os.utime(tmp_path / "toy.py", (0, 0))
    dropped = "HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT", "TMPDIR"
    kept = {k: v for k, v in os.environ.items() if k not in dropped}
    root = str(Path(__file__).resolve().parents[3])
    return subprocess.run(
        [sys.executable, "toy.py"],
        cwd=tmp_path,
        env={**kept, "PYTHONPATH": root, **{k: str(v) for k, v in environment.items()}},
        capture_output=True,
        text=True,
        check=True,
    )


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the other systems' user caches follow other variables")
def test_a_home_that_cannot_be_written_moves_the_cache_to_an_own_temporary_folder(tmp_path):
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    first, second = (run_toy(tmp_path, HOME=blocked(tmp_path), TMPDIR=temporary).stdout.split() for _ in range(2))
    assert first == ["42", "0", "1"] and second == ["42", "1", "0"]  # compiled by one process, found by the next
    (folder,) = temporary.iterdir()
    assert folder.name == f"r5dgs-{os.getuid()}" and folder.stat().st_mode & 0o077 == 0


def test_the_users_choice_and_the_users_cache_come_first(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, "_user_cache", lambda: tmp_path / "user")
    assert Path(kernel_cache.folder_of("")).parent == tmp_path / "user"
    assert Path(kernel_cache.folder_of(str(tmp_path / "chosen"))).parent == tmp_path / "chosen"
    assert Path(kernel_cache.folder_of(str(blocked(tmp_path) / "deeper"))).parent == tmp_path / "user"


@pytest.mark.slow
def test_the_first_compilation_is_announced_once_and_loading_is_never_announced(tmp_path):
    first, second = (run_toy(tmp_path, NUMBA_CACHE_DIR=tmp_path / "cache") for _ in range(2))
    assert first.stderr.splitlines() == [compilation.NOTICE] and second.stderr == ""


TOLD = """
import gc, threading, numba
from r5dgs_core.raster import compilation, kernel_cache
from r5dgs_core.raster.compilation import helper, kernel

told = []
gc_inside = []

@numba.njit
def other(x):
    return x + 1

@helper
def inner(x):
    return x + 1

@kernel
def outer(x):
    return inner(x)

def tell(text):
    told.append(text)
    gc_inside.append(gc.isenabled())

with compilation.announcing(tell):
    other(1)
    assert not told and compilation.compiled() == 0
    threads = [threading.Thread(target=outer, args=(x,)) for x in (1, 1, 1.0)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
assert told == [compilation.NOTICE] and compilation.compiled() == 2  # two kinds of argument
assert gc_inside == [False] and gc.isenabled()
gc.disable()
outer(1j)
assert not gc.isenabled() and compilation.compiled() == 3 and len(told) == 1
"""


@pytest.mark.slow
def test_only_kernel_compilations_are_announced(tmp_path):
    assert run_toy(tmp_path, TOLD, NUMBA_CACHE_DIR=tmp_path / "cache").stderr == ""


@pytest.mark.slow
def test_without_a_cache_folder_every_process_announces_compilation(tmp_path):
    script = TOY.replace(
        "from r5dgs_core",
        "import r5dgs_core.raster.kernel_cache as c\nc._bases = lambda _: iter(())\nfrom r5dgs_core",
        1,
    )
    complaints = [run_toy(tmp_path, script).stderr.splitlines() for _ in range(2)]
    assert complaints[0] == complaints[1] and complaints[0][1:] == [compilation.NOTICE_UNKEPT]
    assert "no place to keep compiled code" in complaints[0][0]


def modules_with_kernels():
    """Modules of the core that define a kernel or a helper, with their syntax trees."""
    for path in sorted(CORE.rglob("*.py")):
        tree = ast.parse(path.read_text())
        decorators = [
            decorator.attr if isinstance(decorator, ast.Attribute) else getattr(decorator, "id", "")
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
            for decorator in node.decorator_list
        ]
        if {"kernel", "helper", "operation"} & set(decorators):
            yield path, tree


def imported_from_the_core(path, tree):
    """Files of the core that a module imports values from at its top, unless only its annotations name them."""
    annotations = {
        name.id
        for node in ast.walk(tree)
        for part in (getattr(node, "annotation", None), getattr(node, "returns", None))
        if isinstance(part, ast.AST)
        for name in ast.walk(part)
        if isinstance(name, ast.Name)
    }
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.level:
            folder = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
            for alias in node.names:
                if (alias.asname or alias.name) in annotations:
                    continue
                inside = (folder / alias.name).with_suffix(".py")
                yield inside if inside.exists() else folder.with_suffix(".py")


def test_kernels_depend_only_on_their_own_file_and_the_shared_sources():
    shared = set(kernel_cache.shared_sources())
    found = dict(modules_with_kernels())
    assert len(found) > 8 and CORE / "train" / "losses.py" in found
    for path, tree in found.items():
        strange = set(imported_from_the_core(path, tree)) - shared
        assert not strange, f"{path.name} imports {strange}, which kernel_cache._SHARED lacks"
    # Constants of `scene.spherical_harmonics`.
    assert CORE / "scene" / "spherical_harmonics.py" in shared


def test_a_kernel_is_compiled_again_after_a_change_of_its_file(tmp_path):
    """Also if time and size of the file, which numba compares, are the same."""
    printed = []
    for script in (TOY, TOY.replace("return 2 * x", "return 5 * x"), TOY):
        printed.append(run_toy(tmp_path, script, NUMBA_CACHE_DIR=tmp_path / "cache").stdout.split())
    assert printed == [["42", "0", "1"], ["105", "0", "1"], ["42", "1", "0"]]


def test_a_changed_source_has_another_cache_folder(tmp_path, monkeypatch):
    source = tmp_path / "constants.py"
    monkeypatch.setattr(kernel_cache, "shared_sources", lambda: [source])
    folders = []
    for text in ("C0 = 1", "C0 = 2", "C0 = 1"):
        source.write_text(text)
        kernel_cache.folder_of.cache_clear()
        folders.append(kernel_cache.folder_of(str(tmp_path)))
    assert folders[0] == folders[2] != folders[1]


def test_a_new_cache_folder_replaces_old_unused_ones(tmp_path):
    week = 7 * 24 * 3600
    ages = {
        **{"r5dgs-0123456789ab": 5, "r5dgs-ffffffffffff": 3, "r5dgs-mine": 5, "r5dgs-0123456789abc": 5},
        **{"elsewhere-0123456789ab": 5, "r5dgs-aaaaaaaaaaaa": 5, "r5dgs-bbbbbbbbbbbb": 5},
    }
    for name, weeks in ages.items():
        if name == "r5dgs-aaaaaaaaaaaa":
            (tmp_path / name).write_text("a file")
        else:
            (tmp_path / name).mkdir()
            (tmp_path / name / "code.nbc").write_text("")
        os.utime(tmp_path / name, 2 * (time.time() - weeks * week,))
    used = tmp_path / "r5dgs-bbbbbbbbbbbb"
    os.utime(used)
    folder = Path(kernel_cache.folder_of(str(tmp_path)))
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {*ages, folder.name} - {"r5dgs-0123456789ab"}


def test_using_a_cache_folder_renews_it_and_removes_nothing(tmp_path):
    folder = Path(kernel_cache.folder_of(str(tmp_path)))
    old = tmp_path / "r5dgs-0123456789ab"
    old.mkdir()
    for path in (old, folder):
        os.utime(path, (0, 0))
    kernel_cache.folder_of.cache_clear()
    assert kernel_cache.folder_of(str(tmp_path)) == str(folder)
    assert old.exists() and time.time() - folder.stat().st_mtime < 3600


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="owners of files are a POSIX matter")
@pytest.mark.parametrize("kind", ["writable by others", "a link", "a file"])
def test_a_temporary_folder_that_others_could_fill_is_not_used(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    folder = tmp_path / f"r5dgs-{os.getuid()}"
    if kind == "a link":
        (tmp_path / "elsewhere").mkdir()
        folder.symlink_to(tmp_path / "elsewhere")
    elif kind == "a file":
        folder.write_text("")
    else:
        folder.mkdir()
        folder.chmod(0o777)
    assert kernel_cache._own_temporary() is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="owners of files are a POSIX matter")
@pytest.mark.parametrize("kind", ["of another user", "writable by others", "a link", "below a folder of another user"])
def test_compiled_code_that_others_can_replace_is_not_used(tmp_path, monkeypatch, caplog, kind):
    chosen, own = tmp_path / "chosen", tmp_path / "own"
    folder = Path(kernel_cache.folder_of(str(chosen)))
    assert folder.parent == chosen and folder.stat().st_mode & 0o077 == 0
    stranger = folder if kind == "of another user" else chosen if kind.startswith("below") else None
    if kind == "writable by others":
        folder.chmod(0o777)
    elif kind == "a link":
        folder.rename(tmp_path / "elsewhere")
        folder.symlink_to(tmp_path / "elsewhere")

    def owned(found, path):
        return os.stat_result([*found[:4], 4711 if Path(path) == stranger else os.getuid(), *found[5:]])

    monkeypatch.setattr(Path, "lstat", lambda path: owned(os.lstat(path), path))
    monkeypatch.setattr(Path, "stat", lambda path, **_: owned(os.stat(path), path))
    monkeypatch.setattr(kernel_cache, "_user_cache", lambda: own)
    kernel_cache.folder_of.cache_clear()
    assert Path(kernel_cache.folder_of(str(chosen))).parent == own
    (told,) = [record.getMessage() for record in caplog.records]
    assert str(folder) in told and "\n" not in told


@pytest.mark.parametrize("value", ["0", "100000", "2.5", "٣", "9" * 5000, " 2"])
def test_an_invalid_number_of_threads_is_an_error_of_one_line(tmp_path, value):
    code = "import sys; from r5dgs_core.cli import main as cli; sys.exit(cli.main(['warm-up']))"
    environment = {**os.environ, "NUMBA_NUM_THREADS": value, "PYTHONPATH": str(CORE.parent)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 3 and done.stdout == ""
    assert done.stderr.startswith("r5dgs: NUMBA_NUM_THREADS=") and done.stderr.count("\n") == 1


def test_without_a_cache_folder_nothing_is_cached_and_one_warning_is_logged(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(kernel_cache, "_user_cache", lambda: blocked(tmp_path))
    monkeypatch.setattr(kernel_cache, "_own_temporary", lambda: None)
    with caplog.at_level("WARNING"):
        kernels = [compilation.kernel(function) for function in (lambda x: 2 * x, lambda x: 3 * x)]
    assert [kernel(21) for kernel in kernels] == [42, 63]
    (record,) = [record for record in caplog.records if "NUMBA_CACHE_DIR" in record.getMessage()]
    assert "a file" in record.getMessage()


def test_a_missing_home_folder_is_no_error(tmp_path, monkeypatch):
    def unknown():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    monkeypatch.setattr(kernel_cache.Path, "home", staticmethod(unknown))
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    assert kernel_cache._user_cache() is None
    assert Path(kernel_cache.folder_of("")).is_relative_to(tmp_path)
