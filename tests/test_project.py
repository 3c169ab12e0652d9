"""Consistency of the project's files: versions, licence, pins, commands, links."""

from __future__ import annotations

import ast
import functools
import importlib
import json
import re
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

import r5dgs_core
from r5dgs_core.cli import parser
from r5dgs_core.formats import registry as export_formats

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MANIFEST = tomllib.loads((ROOT / "blender_manifest.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
NOT_RUN = {"all", "test", "dev", "docs", "blender"}  # extras that bring no package of the core
# Extras that this project does not test; what they bring is not pinned.
UNTESTED_EXTRAS = {"open_clip", "cuda"}


def pins() -> dict[str, Version]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    found = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return {normal(pin.name): Version(next(iter(pin.specifier)).version) for pin in found}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements() -> list[Requirement]:
    tested = [line for name, lines in EXTRAS.items() if name not in UNTESTED_EXTRAS for line in lines]
    found = [Requirement(line) for line in PROJECT["project"]["dependencies"] + tested]
    return [requirement for requirement in found if requirement.name != "r5dgs"]


def test_the_extension_and_the_package_have_one_version_and_licence():
    assert Version(MANIFEST["version"]) == Version(r5dgs_core.__version__)
    assert MANIFEST["license"] == [f"SPDX:{PROJECT['project']['license']}"]
    text = (ROOT / "LICENSE").read_text()
    assert "GNU GENERAL PUBLIC LICENSE" in text and "Version 3, 29 June 2007" in text
    assert "END OF TERMS AND CONDITIONS" in text


def test_requirements_are_pinned_to_versions_in_their_ranges():
    tested = pins()
    for requirement in requirements():
        assert normal(requirement.name) in tested, f"{requirement.name} is not in constraints.txt"
        assert requirement.specifier.contains(tested[normal(requirement.name)]), requirement


def test_the_extra_all_has_every_extra_that_runs_on_a_cpu():
    (own,) = [Requirement(line) for line in EXTRAS["all"]]
    assert own.name == "r5dgs" and own.extras == set(EXTRAS) - UNTESTED_EXTRAS - NOT_RUN


@dataclass(frozen=True)
class Source:
    """Facts about a module.

    Attributes:
        lines: Number of lines.
        writes_extra: True if it contains a pip command with an extra.
        extras: Extras that calls of `r5dgs_core.extras` name literally.
        packages: Packages that it imports at its top.
        late_packages: Packages that it imports anywhere.
        long: Functions of more than 60 lines, with their lengths.
    """

    lines: int
    writes_extra: bool
    extras: set[str]
    packages: set[str]
    late_packages: set[str]
    long: list[str]


@functools.cache
def source(path: Path) -> Source:
    """Parse a module once for all tests."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    lengths = [f.end_lineno - min([f.lineno, *(d.lineno for d in f.decorator_list)]) + 1 for f in functions]
    return Source(
        text.count("\n"),
        "'r5dgs[" in text,
        named_extras(nodes),
        packages(tree.body),
        packages(nodes),
        [f"{f.name}, {length} lines" for f, length in zip(functions, lengths, strict=True) if length > 60],
    )


def named_extras(nodes: list[ast.AST]) -> set[str]:
    """Extras that calls of `r5dgs_core.extras` name literally."""
    position = {"required": 1, "command": 0}
    calls = [
        node
        for node in nodes
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if isinstance(node.func.value, ast.Name) and node.func.value.id == "extras"
    ]
    given = [call.args[position[call.func.attr]] for call in calls]
    return {argument.value for argument in given if isinstance(argument, ast.Constant)}


def packages(nodes: list[ast.AST] | list[ast.stmt]) -> set[str]:
    """Packages that import statements name."""
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add((node.module or "").split(".")[0])
    return found


def test_every_extra_in_a_message_exists_and_only_one_module_writes_the_command():
    named, by_hand = set(), []
    for path in (ROOT / "r5dgs_core").rglob("*.py"):
        named |= source(path).extras
        if source(path).writes_extra and path.name != "extras.py":
            by_hand.append(path)
    named |= {export_formats.get(name).extra for name in export_formats.MODULES} - {None}
    assert {"encoders", "open_clip", "cuda"} <= named <= set(EXTRAS) and not by_hand


def test_every_extra_in_the_documentation_exists_and_the_page_of_the_installation_lists_all():
    text = "\n".join(path.read_text() for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")))
    named = {name for found in re.findall(r"(?:r5dgs|\.)\[([\w,]+)\]['\"]", text) for name in found.split(",")}
    assert {"encoders", "test"} <= named <= set(EXTRAS)
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/user/install.md").read_text(), re.MULTILINE)
    assert sorted(rows) == sorted(EXTRAS)


def dependencies() -> set[str]:
    return {normal(Requirement(line).name) for line in PROJECT["project"]["dependencies"]}


def imported_packages(*, late: bool) -> set[str]:
    """Packages that modules of the core import at their top and, if ``late``, inside functions too."""
    found = set()
    for path in (ROOT / "r5dgs_core").rglob("*.py"):
        found |= source(path).late_packages if late else source(path).packages
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
    known = set(next(a for a in parser.parser()._actions if a.dest == "command").choices)
    assert {"demo", "train", "bake", "evaluate"} <= commands <= known


def anchors_of(text: str) -> set[str]:
    """Anchors of the headings of a page, as GitHub makes them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ +(.*?) *$", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S), re.MULTILINE):
        shown = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", shown.lower()).replace(" ", "-")
        found.add(next(name for name in (slug, *(f"{slug}-{k}" for k in range(1, 99))) if name not in found))
    return found


def broken_links(text: str, document: Path) -> list[str]:
    """Targets of links in a page that lead to no file, or to no heading of a page."""
    broken = []
    for target in re.findall(r"\]\(<?([^)>\s]+)>?\)", text):
        path, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target):  # elsewhere
            continue
        page = document.parent / path
        found = page.exists() and (not anchor or anchor in anchors_of(page.read_text() if path else text))
        if not found:
            broken.append(target)
    return broken


def test_links_between_documents_lead_to_files_and_headings():
    documents = [*ROOT.glob("*.md"), *ROOT.glob("examples/*.md"), *sorted((ROOT / "docs").rglob("*.md"))]
    assert len(documents) > 15
    broken = {str(page.relative_to(ROOT)): broken_links(page.read_text(), page) for page in documents}
    assert not any(broken.values()), {page: links for page, links in broken.items() if links}
    text = "# A & B\n\n## A (b), c-d\n\n[x](#a--b) [x](#a-b-c-d) [x](#nowhere) [x](nothing.md) [x](README.md#licence)"
    assert broken_links(text, ROOT / "x.md") == ["#nowhere", "nothing.md"]


def test_every_page_has_one_row_in_the_list_of_pages():
    docs = ROOT / "docs"
    rows = re.findall(r"^\| \[[^\]]*\]\(([^)]*)\)", (docs / "README.md").read_text(), re.MULTILINE)
    assert sorted(rows) == sorted(path.relative_to(docs).as_posix() for path in docs.glob("*/*.md"))


def test_the_citation_has_the_version_and_the_paper():
    text = (ROOT / "CITATION.cff").read_text()
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text())
    assert text.startswith("cff-version: 1.2.0\n") and f"\nversion: {manifest['version']}\n" in text
    named = re.findall(r"family-names: (\w+)\n +given-names: (\w+)", text)
    title = re.search(r'title: "(R5DGS: [^"]*)"', text)
    assert title is not None and named
    for page in ("README.md", "docs/reference/method.md"):
        plain = " ".join((ROOT / page).read_text().split())
        assert title[1] in plain and all(f"{given} {family}" in plain for family, given in named), page


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
    rooms = "|".join(path.parent.name for path in (ROOT / "r5dgs_core").glob("*/__init__.py"))
    names = re.findall(rf"`((?:{rooms})\.[\w.]+)`", (ROOT / "docs/reference/method.md").read_text())
    assert len(names) > 25
    for name in names:
        parts = name.split(".")
        depth = next((count for count in range(len(parts), 1, -1) if is_module(parts[:count])), 1)
        found = importlib.import_module(".".join(["r5dgs_core", *parts[:depth]]))
        for part in parts[depth:]:
            assert hasattr(found, part), f"docs/reference/method.md names {name}, which does not exist (any more)"
            found = getattr(found, part)
        assert found.__doc__, name


def is_module(parts: list[str]) -> bool:
    return (ROOT / "r5dgs_core" / Path(*parts)).with_suffix(".py").is_file()


def test_the_first_five_minutes_in_blender_name_objects_of_the_demo():
    text = (ROOT / "docs/user/blender.md").read_text().partition("## First five minutes")[2].partition("\n## ")[0]
    names = json.loads((ROOT / "examples" / "tabletop" / "objects.json").read_text())
    objects = [entry["name"] if isinstance(entry, dict) else entry for entry in names.values()]
    prompt = re.search(r"Type `([^`]*)` into \*\*Select by Prompt", text)
    assert prompt is not None and objects and all(name in text for name in objects)
    assert all(phrase.removeprefix("the ") in objects for phrase in prompt[1].split(" and "))


@pytest.mark.slow
@pytest.mark.heavy
def test_quick_leaves_out_long_tests_whatever_markers_are_chosen():
    files = [
        f"tests/{name}.py" for name in ("core/scene/test_archive", "addon/ui/test_plural", "core/test_strict_json")
    ]
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-m", "", "--quick", *files]
    quick = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "test_strict_json" in quick and "test_plural" not in quick and "remain_readable" not in quick
    collected, found, left_out = map(
        int, re.search(r"(\d+)/(\d+) tests collected \((\d+) deselected\)", quick).groups()
    )
    assert 0 < collected == found - left_out < found


def test_files_and_functions_of_the_product_stay_short():
    """At most 350 lines per file and 60 per function; kernels (`raster/cpu`) are exempt."""
    kernels = ROOT / "r5dgs_core" / "raster" / "cpu"
    files = [p for room in ("r5dgs_core", "r5dgs_addon", "operators") for p in (ROOT / room).rglob("*.py")]
    long = []
    for path in (p for p in files if kernels not in p.parents):
        name, facts = path.relative_to(ROOT), source(path)
        long += [f"{name}: {facts.lines} lines"] * (facts.lines > 350) + [f"{name}: {text}" for text in facts.long]
    assert len(files) > 500 and long == []
