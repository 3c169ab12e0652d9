"""A copy of the program with the motion model that the developer pages show."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from r5dgs_core.motion.models import MENU_NUMBERS
from tests.support import pages

ROOT = Path(__file__).resolve().parents[2]
NAME = "rolling"
NUMBER = max(MENU_NUMBERS.values()) + 1


def add(folder: Path) -> Path:
    """Copy core, add-on and operators to a folder, with one more kind and one more rate. Returns the folder."""
    for name in ("r5dgs_core", "r5dgs_addon", "operators"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("__init__.py", "blender_manifest.toml"):
        shutil.copy(ROOT / name, folder / name)
    shown = pages.blocks(pages.EXTENDING, "Motion model")
    if len(shown) != 2:
        raise ValueError(f"{pages.EXTENDING}, Motion model: expected 2 blocks of Python, found {len(shown)}")
    kind, rate = shown
    models = folder / "r5dgs_core/motion/models"
    (models / f"{NAME}.py").write_text(kind)
    _insert(models / "registry.py", r"MENU_NUMBERS = \{\n(?:    .*\n)*", f'    "{NAME}": {NUMBER},\n')
    _insert(models / "motion_model.py", r"class MotionModel:\n(?:.*\n)*?(?=    inertia: )", rate)
    return folder


def _insert(path: Path, after: str, text: str) -> None:
    """Insert text after the only match of a pattern."""
    source = path.read_text()
    (match,) = re.finditer(after, source)
    path.write_text(source[: match.end()] + text + source[match.end() :])
