"""Rigid motion past t_max: one module per kind of motion, and their evaluation at any time."""

import importlib

from .base import BLOCKS, Block, MotionKind, Rates, clocks
from .evaluation import MotionStack, curve, evaluate, evaluate_all, evaluate_with_rates, kinks, steps_needed
from .motion_model import FIELDS, KINDS, RATES, SCALARS, VECTORS, MotionModel, Unit

MENU_NUMBERS = {
    "static": 0,
    "translation": 1,
    "ballistic_spin": 2,
    "constant_twist": 3,
    "world_twist": 4,
    "free_top": 5,
    "drag": 6,
    "friction": 7,
    "precession": 8,
    "bounce": 9,
    "two_oscillations": 10,
}
"""Kinds in the order of Blender's menu, each the module of its name.

.blend files store the numbers: do not change one.
"""
KINDS.update({name: importlib.import_module(f"{__name__}.{name}").KIND for name in MENU_NUMBERS})
STATIC = MotionModel()

__all__ = [
    "BLOCKS",
    "FIELDS",
    "KINDS",
    "MENU_NUMBERS",
    "RATES",
    "SCALARS",
    "STATIC",
    "VECTORS",
    "Block",
    "MotionKind",
    "MotionModel",
    "Rates",
    "MotionStack",
    "Unit",
    "clocks",
    "curve",
    "evaluate",
    "evaluate_all",
    "evaluate_with_rates",
    "kinks",
    "steps_needed",
]
