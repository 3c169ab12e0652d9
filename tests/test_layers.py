"""Directions and circles of imports, read from the sources and tried with packages blocked."""

from __future__ import annotations

import ast
import dataclasses
import functools
import graphlib
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import api
from r5dgs_core.scene import scene_file
from tests.support import scenes

ROOT = Path(__file__).resolve().parents[1]

# Modules without dependencies in the core; every room may import them.
GROUND = {
    "atomic_files",
    "errors",
    "extras",
    "findings",
    "folder_lock",
    "input_paths",
    "shared_frames",
    "strict_json",
    "time_left",
    "timing",
}
# Rooms of the core that a room may import besides itself and `GROUND`, lower rooms first.
ALLOWED = {
    "atomic_files": set(),
    "errors": set(),
    "extras": set(),
    "motion": set(),
    "terminal": set(),
    "time_left": set(),
    "timing": set(),
    "findings": set(),
    "input_paths": set(),
    "strict_json": set(),
    "user_settings": set(),
    "motion_fit": {"motion"},
    "progress": {"terminal"},
    "folder_lock": set(),
    "shared_frames": set(),
    "scene": {"motion"},
    "color": {"scene"},
    "shapes": {"motion", "scene"},
    "data": {"motion", "scene", "color"},
    "raster": {"motion", "scene"},
    "search": {"scene"},
    "capture": {"motion", "scene", "data"},
    "config": {"data"},
    "playback": {"motion", "scene", "color"},
    "formats": {"motion", "scene", "color", "search", "playback", "shapes"},
    "editing": {"motion", "scene", "color", "playback"},
    "protocol": {"scene", "search"},
    "model": {"motion", "scene"},
    "render": {"motion", "scene", "raster", "playback"},
    "contact": {"motion", "motion_fit", "scene", "shapes", "playback", "render"},
    "importing": {"motion", "scene", "data", "formats", "model"},
    "evaluation": {"motion", "terminal", "scene", "data", "playback", "render"},
    "film": {"motion", "scene", "data", "color", "formats", "raster", "playback", "render"},
    "language": {"scene", "data", "search", "playback", "render"},
    "train": {"motion", "motion_fit", "scene", "data", "raster", "config", "model", "render", "shapes"},
    "masks": {"motion", "scene", "data", "language"},
    "worker": {"scene", "raster", "playback", "formats", "editing", "protocol", "render", "language", "contact"},
    "bake": {"motion", "motion_fit", "scene", "data", "config", "playback", "render", "train", "shapes", "contact"},
    "prepare": {"color", "motion", "scene", "data", "capture", "masks"},
    "check": {"motion", "terminal", "scene", "color", "data", "formats", "config", "train", "prepare"},
    "stability": {
        *("motion", "motion_fit", "scene", "data", "raster", "config", "playback", "render", "train", "contact"),
        "shapes",
    },
    "association": {"scene", "data", "raster", "playback", "render", "masks"},
    "bench": {"terminal", "progress", "scene", "data", "config", "playback", "render", "evaluation", "train", "bake"},
    "batch": {"data", "config", "train", "bench"},
    "error_vs_time": {
        "motion",
        "terminal",
        "motion_fit",
        "scene",
        "data",
        "raster",
        "playback",
        "render",
        "evaluation",
        "train",
        "bench",
    },
    "api": {"motion", "scene", "data", "config", "playback", "render", "evaluation", "train", "bake"},
    "cli": {
        "terminal",
        "user_settings",
        "progress",
        "scene",
        "data",
        "raster",
        "search",
        "config",
        "playback",
        "render",
        "formats",
        "importing",
        "evaluation",
        "film",
        "language",
        "train",
        "masks",
        "prepare",
        "contact",
        "bake",
        "check",
        "stability",
        "association",
        "bench",
        "batch",
        "error_vs_time",
    },
}
# Commands that import numpy or torch.
COMMANDS = (
    *(
        "associate",
        "bake",
        "batch",
        "bench",
        "demo",
        "evaluate",
        "export",
        "import_run",
        "info",
        "lookup",
        "masks",
        "name",
    ),
    *("extrapolate", "objects", "prepare", "query", "render", "report", "train", "view", "warm_up"),
)
# Modules that may import modules of the project inside functions: the command line and the public functions, which
# start fast, and the worker, which answers before torch is there and if it is missing.
LATE_MODULES = {
    "api",
    *("cli.inputs", "cli.live_bake", "cli.options", "cli.pictures", *(f"cli.commands.{name}" for name in COMMANDS)),
    *("check", "check.run", "stability.training"),
    *("worker.further_layers", "worker.server", "worker.warming"),
}
# Further modules of the core, and what each may import inside functions.
LATE_IMPORTS = {
    # A layout is detected before numpy is imported.
    "data.layouts.camera_files": {"data.array_file", "data.transforms"},
    "data.layouts.colmap": {"data.colmap_dataset"},
    # numba is optional, and torch is for gradients and odd dtypes.
    "raster.cpu.backend": {
        "raster.torch_backend",
        *("raster.thread_pool", "raster.cpu.autograd", "raster.cpu.forward"),
        *("raster.cpu.sky", "raster.cpu.static_layer"),
    },
    # scipy is slow to import.
    "render.warm_up": {
        *("render.front_layer", "render.mesh_depths", "render.posed_scene", "render.segment_weights"),
    },
    # The stability table is listed without torch.
    "stability.loading": {"raster", "render.warm_up"},
    # OpenImageIO is needed for images alone, not for words.
    "language.encoders.clip_encoder": {"data.images"},
    "language.encoders.open_clip_encoder": {"data.images"},
    # matplotlib is slow to import and may be missing beside Blender; it draws the marker of time.
    "film.film": {"film.time_marker"},
    # A scene at rest loads neither tracks nor networks.
    "bake.point_motion": {"train.representations.residual"},
    "train.representations.registry": {
        "train.representations.field_handover",
        "train.representations.field",
        "train.representations.tracks",
    },
    "train.representations.tracks": {"train.representations.field_handover", "train.representations.field"},
    "train.finish": {"train.object_discovery"},
    "train.run": {"train.object_discovery", "train.pose_repair", "train.residual_trial"},
}
# The same of the add-on: OpenImageIO is optional there.
LATE_ADDON_IMPORTS = {"capture.files": {"data.images"}}
# Packages that rooms of the light tier may import inside functions, for files of other programs and for baking.
LATE_PACKAGES = {"formats": {"fourdgs", "gsply", "pxr"}, "shapes": {"scipy"}}
# Which rooms of the add-on a room may import, itself aside, lower rooms first.
ADDON_ALLOWED = {
    "compat": set(),
    "ui": set(),
    "process_group": set(),
    "find_python": {"process_group"},
    "preferences": {"ui", "find_python"},
    "scene": {"compat", "ui", "preferences"},
    "color": {"compat", "ui", "scene"},
    "worker": {"ui", "process_group", "find_python", "preferences", "scene"},
    "engine": {"compat", "ui", "scene", "color", "worker"},
    "splats": {"compat", "ui", "scene", "engine"},
    "language": {"ui", "preferences", "scene", "worker", "engine"},
    "motion": {"compat", "ui", "scene", "engine"},
    "build_scene": {"compat", "scene", "motion"},
    "export": {"ui", "scene", "worker", "engine", "motion"},
    "clean_up": {"ui", "scene"},
    "panels": {"ui", "scene", "color", "worker", "engine", "splats", "language", "motion", "clean_up"},
    "capture": {"ui", "export"},
}
LIGHT = GROUND | {
    "motion",
    "scene",
    "color",
    "formats",
    "playback",
    "editing",
    "search",
    "protocol",
    "shapes",
    "user_settings",
}
# The extension holds these rooms only: those of Blender itself, and those of the worker.
PICTURE = LIGHT | {"data", "raster", "render", "language", "worker", "contact", "motion_fit"}
BLENDER = {"bpy", "bmesh", "mathutils", "gpu", "bl_ui", "bpy_extras", "addon_utils", "imbuf", "aud"}
HEAVY = {
    *("torch", "numba", "scipy", "OpenImageIO", "trimesh", "matplotlib", "rich", "gsplat", "transformers"),
    *("safetensors", "open_clip"),
}
# Modules of `raster/` and `render/` that compute in torch. All others draw without it.
TORCH_MODULES = {
    "raster.cpu.autograd",
    "raster.cuda",
    "raster.cuda_projection",
    "raster.reference",
    "raster.torch_backend",
}
TORCH_TIER = {"torch", "numba", "gsplat", "transformers", "torchvision", "safetensors", "open_clip"}


@dataclass(frozen=True)
class Import:
    """One import: of a module by absolute name, whether relative in the source, whether inside a function."""

    target: str
    relative: bool
    late: bool
    line: int


@functools.cache
def imports_of(source: str, package: str) -> tuple[Import, ...]:
    """All imports of a module that lives in ``package``; ``from a import b`` counts as a.b, as b may be a module."""

    def visit(node: ast.AST, late: bool) -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            inside = late or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            if isinstance(child, ast.Import):
                for alias in child.names:
                    yield Import(alias.name, False, late, child.lineno)
            elif isinstance(child, ast.ImportFrom):
                base = child.module or ""
                if child.level:
                    parents = package.split(".")[: len(package.split(".")) - child.level + 1]
                    base = ".".join([*parents, *([base] if base else [])])
                for alias in child.names:
                    yield Import(f"{base}.{alias.name}", bool(child.level), late, child.lineno)
            yield from visit(child, inside)

    return tuple(visit(ast.parse(source), False))


def modules_in(folder: str) -> Iterator[tuple[Path, str]]:
    """Source files under a folder of the root and the package that each lives in."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        yield path, ".".join(path.relative_to(ROOT).parent.parts)


def room(module: str) -> str | None:
    """Room of the core that a module belongs to: r5dgs_core.scene.cameras -> scene."""
    parts = module.split(".")
    return parts[1] if parts[0] == "r5dgs_core" and len(parts) > 1 and parts[1] in ALLOWED else None


@functools.cache
def project_sources() -> dict[str, tuple[str, str]]:
    """Source and package of each module of core, add-on and operators, by its name inside the extension."""
    found = {}
    for folder in ("r5dgs_core", "r5dgs_addon", "operators"):
        for path, package in modules_in(folder):
            name = f"r5dgs.{package}" if path.stem == "__init__" else f"r5dgs.{package}.{path.stem}"
            found[name] = path.read_text(), f"r5dgs.{package}"
    return found


def project_imports(sources: Mapping[str, tuple[str, str]]) -> Iterator[tuple[str, str, Import]]:
    """All imports between modules, those inside functions and for types included: importer, imported, import."""
    for name, (source, package) in sources.items():
        for item in imports_of(source, package):
            for target in (item.target, item.target.rpartition(".")[0]):  # a module, or a name in a module
                if target in sources and target != name:
                    yield name, target, item
                    break


def circle(sources: Mapping[str, tuple[str, str]]) -> list[str]:
    """Modules of a circle of imports, in its order; empty if there is none."""
    graph: dict[str, set[str]] = {name: set() for name in sources}
    for name, target, _ in project_imports(sources):
        graph[name].add(target)
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def late_imports(sources: Mapping[str, tuple[str, str]]) -> dict[str, set[str]]:
    """Modules that each module imports inside functions."""
    found: dict[str, set[str]] = {}
    for name, target, item in project_imports(sources):
        if item.late:
            found.setdefault(name, set()).add(target)
    return found


def core_problems(source: str, package: str, own: str) -> list[str]:
    """Imports of a module of a room that go against the directions."""
    problems = []
    for item in imports_of(source, package):
        top, other = item.target.split(".")[0], room(item.target)
        if top in BLENDER or top in ("r5dgs_addon", "operators", "r5dgs"):
            problems.append(f"line {item.line}: the core imports {item.target}")
        if top == "r5dgs_core" and not item.relative:
            problems.append(f"line {item.line}: {item.target} is not relative, so it breaks inside the extension")
        if other and other not in ALLOWED[own] | {own} | GROUND:
            problems.append(f"line {item.line}: {own} imports {item.target}")
        permitted = LATE_PACKAGES.get(own, set()) if item.late else set()
        if own in LIGHT and not item.relative and top not in sys.stdlib_module_names | {"numpy"} | permitted:
            problems.append(f"line {item.line}: the light tier imports {item.target}")
    return problems


def addon_problems(source: str, package: str) -> list[str]:
    """Imports of a module of the extension that go against the directions."""
    problems = []
    for item in imports_of(source, package):
        top = item.target.split(".")[0]
        inside = item.target.removeprefix("r5dgs.")
        if top in TORCH_TIER:
            problems.append(f"line {item.line}: the add-on imports {item.target}")
        if top in HEAVY and not item.late:
            problems.append(f"line {item.line}: {item.target} is imported before it is needed")
        if not item.relative and top in ("r5dgs_core", "r5dgs_addon", "operators", "r5dgs"):
            problems.append(f"line {item.line}: {item.target} is not relative")
        if item.relative and room(inside) not in LIGHT | {None} and not (item.late and room(inside) == "data"):
            problems.append(f"line {item.line}: the add-on imports {item.target}, which is not of the light tier")
        if package.startswith("r5dgs.r5dgs_addon") and inside.startswith("operators"):
            problems.append(f"line {item.line}: a service imports an operator, {item.target}")
    return problems


def test_every_room_of_the_core_has_its_place():
    found = {path.stem for path in (ROOT / "r5dgs_core").iterdir() if path.suffix == ".py" and path.stem != "__init__"}
    found |= {path.parent.name for path in (ROOT / "r5dgs_core").glob("*/__init__.py")}
    assert found - {"__main__"} <= set(ALLOWED)
    assert {"motion", "scene", "data", "model", "raster", "train", "cli"} <= found


def test_the_allowed_directions_have_no_circle():
    settled: set[str] = set()
    while len(settled) < len(ALLOWED):
        ready = {name for name, needs in ALLOWED.items() if name not in settled and needs <= settled}
        assert ready, f"circle among {set(ALLOWED) - settled}"
        settled |= ready


@pytest.mark.parametrize("own", sorted(ALLOWED))
def test_no_room_of_the_core_imports_upward(own):
    problems = []
    for path, package in modules_in("r5dgs_core"):
        module = f"{package}.{path.stem}" if path.stem != "__init__" else package
        if room(module) == own:
            problems += [f"{path.relative_to(ROOT)}: {text}" for text in core_problems(path.read_text(), package, own)]
    assert not problems, "\n".join(problems)


def test_the_rooms_of_the_core_use_all_their_permissions():
    used: dict[str, set[str]] = {name: set() for name in ALLOWED}
    for importer, imported, _ in project_imports(project_sources()):
        own, other = (room(name.removeprefix("r5dgs.")) for name in (importer, imported))
        if own and other and other not in GROUND | {own}:
            used[own].add(other)
    assert used == ALLOWED


def reached(arrows: Mapping[str, set[str]], start: str) -> set[str]:
    """Names that the arrows reach from a name, itself included."""
    found, rest = set(), [start]
    while rest:
        if (name := rest.pop()) not in found:
            found.add(name)
            rest += arrows.get(name, ())
    return found


def test_the_picture_of_the_rooms_shows_the_allowed_imports():
    page = (ROOT / "docs/developer/architecture.md").read_text()
    picture: dict[str, set[str]] = {}
    for start, ends in re.findall(r"^ +(\w+)(?:\[.*\])? --> (.+)$", page, re.MULTILINE):
        picture.setdefault(start, set()).update(ends.split(" & "))
    shown = set(picture).union(*picture.values())
    arrows = dict(ALLOWED, addon=set(), operators={"addon"})
    for importer, imported, item in project_imports(project_sources()):
        own = {"r5dgs_addon": "addon", "operators": "operators"}.get(importer.split(".")[1])
        if own and not item.late:
            arrows[own] = arrows[own] | {room(imported.removeprefix("r5dgs."))} - {None}
    assert {"motion", "cli", "addon", "operators"} <= shown
    for name in shown:
        assert reached(picture, name) == reached(arrows, name) & shown, name


def test_no_module_imports_itself_on_a_detour():
    assert circle(project_sources()) == []


def test_modules_are_imported_inside_functions_only_for_the_listed_reasons():
    allowed = {f"r5dgs.r5dgs_core.{name}": targets for name, targets in LATE_IMPORTS.items()}
    allowed |= {f"r5dgs.r5dgs_addon.{name}": targets for name, targets in LATE_ADDON_IMPORTS.items()}
    found = late_imports(project_sources())
    for name in LATE_MODULES:
        assert found.pop(f"r5dgs.r5dgs_core.{name}", None), f"{name} does not need its place in LATE_MODULES"
    assert found == {name: {f"r5dgs.r5dgs_core.{target}" for target in targets} for name, targets in allowed.items()}, (
        "imports inside functions differ from LATE_IMPORTS"
    )


@pytest.mark.parametrize(
    "back",
    [
        "from . import a",
        "from .a import f",
        "def f():\n    from . import a",
        "class C:\n    def f(self):\n        from .a import g",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .a import A",
    ],
)
def test_the_scan_sees_a_circle(back):
    sources = {"x.a": ("from . import b", "x"), "x.b": ("from .c import d", "x"), "x.c": ("import math", "x")}
    assert circle(sources) == []
    assert set(circle(sources | {"x.c": (back, "x")})) == {"x.a", "x.b", "x.c"}


def test_the_scan_sees_imports_inside_functions():
    sources = {"x.a": ("from . import b\ndef f():\n    from .c import d", "x"), "x.b": ("", "x"), "x.c": ("", "x")}
    assert late_imports(sources) == {"x.a": {"x.c"}}


@pytest.mark.parametrize("own", sorted(ADDON_ALLOWED))
def test_no_room_of_the_addon_imports_upward(own):
    problems = []
    for importer, imported, item in project_imports(project_sources()):
        rooms = [name.split(".")[2] for name in (importer, imported) if name.startswith("r5dgs.r5dgs_addon.")]
        if len(rooms) == 2 and rooms[0] == own and rooms[1] not in ADDON_ALLOWED[own] | {own}:
            problems.append(f"{importer}, line {item.line}: {own} imports {imported}")
    assert not problems, "\n".join(problems)


def test_the_directions_of_the_addon_have_no_circle():
    found = {path.stem for path in (ROOT / "r5dgs_addon").iterdir() if path.suffix == ".py" and path.stem != "__init__"}
    found |= {path.parent.name for path in (ROOT / "r5dgs_addon").glob("*/__init__.py")}
    assert found == set(ADDON_ALLOWED)
    graphlib.TopologicalSorter(ADDON_ALLOWED).prepare()


@pytest.mark.parametrize("folder", ["r5dgs_addon", "operators"])
def test_the_extension_imports_only_the_light_tier(folder):
    files = list(modules_in(folder))
    assert files
    problems = []
    for path, package in files:
        found = addon_problems(path.read_text(), f"r5dgs.{package}")
        problems += [f"{path.relative_to(ROOT)}: {text}" for text in found]
    assert not problems, "\n".join(problems)


def test_the_root_imports_nothing_before_it_registers():
    early = [item for item in imports_of((ROOT / "__init__.py").read_text(), "r5dgs") if not item.late]
    assert [item.target for item in early if item.target.split(".")[0] != "__future__"] == []


@pytest.mark.parametrize(
    ("source", "package", "own"),
    [
        ("import bpy", "r5dgs_core.train", "train"),
        ("def f():\n    from mathutils import Vector", "r5dgs_core.cli", "cli"),
        ("from ..train import trainer", "r5dgs_core.evaluation", "evaluation"),
        ("from ..bake import bake", "r5dgs_core.train", "train"),
        ("from ..scene.scene import Scene", "r5dgs_core.motion", "motion"),
        ("from r5dgs_core.motion import models", "r5dgs_core.train", "train"),
        ("def f():\n    import torch", "r5dgs_core.motion", "motion"),
        ("from scipy.spatial import cKDTree", "r5dgs_core.scene", "scene"),
        ("from ..cli import main", "r5dgs_core.worker", "worker"),
    ],
)
def test_the_scan_of_the_core_sees_a_wrong_import(source, package, own):
    assert core_problems(source, package, own)


@pytest.mark.parametrize(
    ("source", "package"),
    [
        ("import torch", "r5dgs.r5dgs_addon"),
        ("def f():\n    import numba", "r5dgs.operators"),
        ("import OpenImageIO", "r5dgs.r5dgs_addon"),
        ("from ..r5dgs_core.raster import rasterize", "r5dgs.r5dgs_addon"),
        ("def f():\n    from ..r5dgs_core import train", "r5dgs.operators"),
        ("from r5dgs_core.scene import scene_file", "r5dgs.operators"),
        ("from ..operators import load_scene", "r5dgs.r5dgs_addon"),
        ("from .. import operators", "r5dgs.r5dgs_addon"),
    ],
)
def test_the_scan_of_the_extension_sees_a_wrong_import(source, package):
    assert addon_problems(source, package)


@pytest.mark.parametrize(
    ("source", "package", "own"),
    [
        ("from . import rotations\nimport numpy as np\nimport math", "r5dgs_core.motion", "motion"),
        ("from .. import errors\nfrom ..motion import models", "r5dgs_core.scene", "scene"),
        ("import torch\nfrom ..raster import rasterize", "r5dgs_core.train", "train"),
    ],
)
def test_the_scan_of_the_core_lets_right_imports_pass(source, package, own):
    assert core_problems(source, package, own) == []


BLOCKER = """
import importlib, importlib.util, json, pkgutil, sys

class Blocker:
    def __init__(self, names): self.names = set(names)
    def find_spec(self, fullname, path=None, target=None):
        if fullname.split(".")[0] in self.names:
            raise ModuleNotFoundError(f"{fullname} is blocked", name=fullname)

root, blocked = sys.argv[1], json.loads(sys.argv[2])
sys.meta_path.insert(0, Blocker(blocked))
"""

IMPORT_LIGHT_TIER = """
sys.path.insert(0, root)
import r5dgs_core.errors, r5dgs_core.strict_json, r5dgs_core.user_settings
seen = []
for name in ("motion", "scene", "color", "formats", "playback", "editing", "search", "shapes", "protocol"):
    package = importlib.import_module(f"r5dgs_core.{name}")
    for info in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(info.name)
        seen.append(info.name)
assert not set(sys.modules) & set(blocked)
print(len(seen))
"""

IMPORT_RENDERER = """
sys.path.insert(0, root)
import r5dgs_core
for name in ("raster", "render"):
    package = importlib.import_module(f"r5dgs_core.{name}")
    for info in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        try:
            importlib.import_module(info.name)
        except ModuleNotFoundError as error:
            assert error.name == "torch", error
            print(info.name.removeprefix("r5dgs_core."))
"""

DRAW = """
sys.path.insert(0, root)
import numpy, r5dgs_core
from r5dgs_core import errors
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer, warm_up
scene = r5dgs_core.load("scene.r5dgs")
numpy.save("picture.npy", r5dgs_core.picture(scene, 0.9))
warm_up.warm_up(gradients=False)
for backend in ("reference", "cuda"):
    try:
        scene_renderer.render_frame(scene, scene_player.Player(scene).frame(0.9), scene.cameras[0], backend=backend)
    except errors.BackendError as error:
        print(error)
assert not set(sys.modules) & set(blocked)
"""

REGISTER_EXTENSION = """
spec = importlib.util.spec_from_file_location("r5dgs", root + "/__init__.py", submodule_search_locations=[root])
extension = importlib.util.module_from_spec(spec)
sys.modules["r5dgs"] = extension
spec.loader.exec_module(extension)
import bpy
for _ in range(2):
    extension.register()
    assert bpy.ops.r5dgs.load_scene.get_rna_type().identifier == "R5DGS_OT_load_scene"
    extension.unregister()
seen = [name for name in sys.modules if name.startswith("r5dgs.")]
for package in ("r5dgs_addon", "operators"):
    for info in pkgutil.walk_packages([f"{root}/{package}"], f"r5dgs.{package}."):
        importlib.import_module(info.name)
assert not set(sys.modules) & set(blocked)
print(len(seen))
"""


def run_blocked(code: str, blocked: set[str], tmp_path: Path) -> str:
    """Run code in a fresh Python in which importing ``blocked`` packages fails."""
    command = [sys.executable, "-c", BLOCKER + code, str(ROOT), json.dumps(sorted(blocked))]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_light_tier_imports_with_numpy_alone(tmp_path):
    assert int(run_blocked(IMPORT_LIGHT_TIER, HEAVY | BLENDER, tmp_path).split()[-1]) >= 8


def test_only_gradients_and_the_torch_backends_import_torch(tmp_path):
    assert set(run_blocked(IMPORT_RENDERER, {"torch"}, tmp_path).split()) == TORCH_MODULES


def test_a_scene_is_drawn_without_torch_to_the_same_bits(tmp_path):
    scene = scenes.make_scene(200, sh_degree=2)
    scene = dataclasses.replace(scene, cameras=(scenes.orbit_camera(0.3, 40, 30),))
    scene_file.write(scene, tmp_path / "scene.r5dgs")
    complaints = run_blocked(DRAW, {"torch"}, tmp_path).splitlines()
    assert complaints == [
        f"rasterizer '{name}': torch is not installed; remedy: pip install torch" for name in ("reference", "cuda")
    ]
    expected = api.picture(scene_file.read(tmp_path / "scene.r5dgs"), 0.9)
    assert np.array_equal(np.load(tmp_path / "picture.npy"), expected)


def test_blocked_modules_cannot_be_imported(tmp_path):
    with pytest.raises(AssertionError, match="torch is blocked"):
        run_blocked("import torch", HEAVY, tmp_path)


@pytest.mark.blender
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed (see the report's header)")
def test_the_extension_registers_twice_without_the_torch_tier(tmp_path):
    assert int(run_blocked(REGISTER_EXTENSION, HEAVY, tmp_path).split()[-1]) > 10
