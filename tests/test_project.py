"""What the project's files say about each other: versions, licence, pins, commands, links."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import torch
from packaging.requirements import Requirement
from packaging.version import Version

import r5dgs_core
from r5dgs_core import command_line

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MANIFEST = tomllib.loads((ROOT / "blender_manifest.toml").read_text())
# Extras that this project does not test; what they bring is not pinned.
UNTESTED_EXTRAS = {"open_clip", "cuda"}


def pins() -> dict[str, Version]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    found = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return {normal(pin.name): Version(next(iter(pin.specifier)).version) for pin in found}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements() -> list[Requirement]:
    extras = PROJECT["project"]["optional-dependencies"]
    tested = [line for name, lines in extras.items() if name not in UNTESTED_EXTRAS for line in lines]
    return [Requirement(line) for line in PROJECT["project"]["dependencies"] + tested]


def test_the_extension_and_the_package_have_one_version_and_licence():
    assert Version(MANIFEST["version"]) == Version(r5dgs_core.__version__)
    assert MANIFEST["license"] == [f"SPDX:{PROJECT['project']['license']}"]
    text = (ROOT / "LICENSE").read_text()
    assert "GNU GENERAL PUBLIC LICENSE" in text and "Version 3, 29 June 2007" in text
    assert "END OF TERMS AND CONDITIONS" in text


def test_what_was_tested_lies_in_the_ranges_and_everything_needed_is_pinned():
    tested = pins()
    for requirement in requirements():
        assert normal(requirement.name) in tested, f"{requirement.name} is not in constraints.txt"
        assert requirement.specifier.contains(tested[normal(requirement.name)]), requirement


def dependencies() -> set[str]:
    return {normal(Requirement(line).name) for line in PROJECT["project"]["dependencies"]}


def imported_packages(*, late: bool) -> set[str]:
    """Packages that modules of the core import at their top and, if ``late``, inside functions too."""
    found = set()
    for path in (ROOT / "r5dgs_core").rglob("*.py"):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree) if late else tree.body:
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add((node.module or "").split(".")[0])
    return {normal(name) for name in found - sys.stdlib_module_names}


def test_every_package_that_the_core_imports_is_a_dependency():
    missing = imported_packages(late=False) - dependencies()
    assert not missing, f"imported at the top of a module of the core: {sorted(missing)}"


def test_every_dependency_is_imported_by_the_core():
    unused = dependencies() - imported_packages(late=True)
    assert not unused, f"hard dependencies that nothing imports: {sorted(unused)}"


def test_the_commands_of_the_readme_exist():
    text = (ROOT / "README.md").read_text()
    commands = set(re.findall(r"^ {4}(?:.*&& )?r5dgs (\w+)", text, re.MULTILINE))
    known = set(next(a for a in command_line.parser()._actions if a.dest == "command").choices)
    assert {"demo", "train", "bake", "evaluate"} <= commands <= known


def test_the_python_of_the_readme_runs():
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert names["picture"].image.shape == (300, 400, 5) and names["picture"].alpha.max() > 0.1
    for name in ("means", "quats", "scales", "channels"):
        gradient = names[name].grad
        assert torch.isfinite(gradient).all() and gradient.abs().max() > 0


def test_links_between_documents_lead_somewhere():
    documents = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    for document in documents:
        for target in re.findall(r"\]\(([^)#:]+)\)", document.read_text()):
            assert (document.parent / target).exists(), f"{document.relative_to(ROOT)}: {target}"


def tracked_text() -> dict[str, str]:
    """Content of every tracked text file by its path."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    found = {}
    for name in listed.split("\0")[:-1]:
        if (ROOT / name).is_file():  # not removed, and no link into nothing
            content = (ROOT / name).read_bytes()
            if b"\0" not in content:
                found[name] = content.decode()
    return found


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="this is no checkout, so nothing is tracked")
def test_tracked_text_names_no_place_of_a_machine():
    places = [Path.home(), ROOT, Path(sys.prefix)]
    own = [re.escape(str(place)) for place in places if len(place.parts) > 2]  # not /usr, which scripts name rightly
    machine = re.compile("|".join([r"(?<![\w.])/(?:home|root|Users)/[\w.]", r"\b[A-Z]:\\+Users\\+\w", *own]))
    texts = tracked_text()
    assert {"README.md", "pyproject.toml", ".ci/run", "tests/test_project.py"} <= set(texts)
    for name, text in texts.items():
        match = machine.search(text)
        assert match is None, f"{name}: names {match.group()!r}"


def test_every_function_of_the_method_document_exists():
    names = re.findall(
        r"`((?:motion|scene|data|model|raster|train|report)\.[\w.]+)`", (ROOT / "docs/method.md").read_text()
    )
    assert len(names) > 25
    for name in names:
        parts = name.split(".")
        depth = 2 if is_module(parts[:2]) else 1
        found = importlib.import_module(".".join(["r5dgs_core", *parts[:depth]]))
        for part in parts[depth:]:
            assert hasattr(found, part), f"docs/method.md names {name}, which does not exist (any more)"
            found = getattr(found, part)
        assert found.__doc__, name


def is_module(parts: list[str]) -> bool:
    return (ROOT / "r5dgs_core" / Path(*parts)).with_suffix(".py").is_file()
