"""Python blocks of docs/developer/extending.md, run as the module that the page tells a developer to add."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "developer" / "extending.md"


def blocks(heading: str) -> list[str]:
    """Return the Python blocks of a section, in order.

    Args:
        heading: Text of the section's heading, without the number signs.
    """
    sections = re.split(r"^#+ (.*)\n", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    text = dict(zip(sections[1::2], sections[2::2], strict=True))[heading]
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def load(heading: str, name: str, monkeypatch: pytest.MonkeyPatch, number: int = 0) -> ModuleType:
    """Execute a Python block of a section as a module, which can be imported until the test ends.

    Args:
        heading: Text of the section's heading.
        name: Full name of the module, for example ``r5dgs_core.formats.example``; it resolves relative imports.
        monkeypatch: Fixture of the test.
        number: Index of the block in the section.
    """
    module = ModuleType(name)
    package, _, last = name.rpartition(".")
    module.__package__ = package
    monkeypatch.setitem(sys.modules, name, module)
    if package in sys.modules:
        monkeypatch.setattr(sys.modules[package], last, module, raising=False)
    exec(compile(blocks(heading)[number], f"{PAGE}: {heading}", "exec"), module.__dict__)
    return module
