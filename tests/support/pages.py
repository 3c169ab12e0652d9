"""Python code blocks of the documentation, run as the modules that they show."""

import re
import sys
import types
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"


def module_of(page: str, heading: str, name: str) -> types.ModuleType:
    """Run the first Python block under a heading of a page as the module ``name``, which stays importable."""
    text = (DOCS / page).read_text(encoding="utf-8")
    section = re.split(r"^## ", text.split(f"\n## {heading}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]
    code = re.search(r"^```python\n(.*?)^```", section, re.DOTALL | re.MULTILINE)
    assert code, f"{page}: no Python block under '{heading}'"
    module = types.ModuleType(name)
    module.__package__ = name.rpartition(".")[0]
    sys.modules[name] = module
    exec(compile(code[1], f"{page}: {heading}", "exec"), module.__dict__)
    return module
