"""Python code blocks of the documentation, and their execution as the modules that they show."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXTENDING = "docs/developer/extending.md"


def blocks(page: str, heading: str | None = None) -> list[str]:
    """Return the Python blocks of a page in order.

    Args:
        page: Path of the page, relative to the root of the repository.
        heading: Text of a section's heading, without the number signs; None for the whole page.
    """
    text = (ROOT / page).read_text(encoding="utf-8")
    if heading is not None:
        sections = re.split(r"^#+ (.*)\n", text, flags=re.MULTILINE)
        text = dict(zip(sections[1::2], sections[2::2], strict=True))[heading]
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def load(heading: str, name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Execute the first block of a section of `EXTENDING` as a module, which can be imported until the test ends.

    Args:
        heading: Text of the section's heading.
        name: Full name of the module, for example ``r5dgs_core.formats.example``; it resolves relative imports.
        monkeypatch: Fixture of the test.
    """
    module = ModuleType(name)
    package, _, last = name.rpartition(".")
    module.__package__ = package
    monkeypatch.setitem(sys.modules, name, module)
    if package in sys.modules:
        monkeypatch.setattr(sys.modules[package], last, module, raising=False)
    exec(compile(blocks(EXTENDING, heading)[0], f"{EXTENDING}: {heading}", "exec"), module.__dict__)
    return module
