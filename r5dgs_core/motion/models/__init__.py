"""Rigid motion past t_max: one module per kind of motion, and their evaluation at any time."""

from .base import BLOCKS, Block, MotionKind, Rates, time_factors
from .evaluation import MotionStack, curve, evaluate, evaluate_all, evaluate_with_rates, kinks, steps_needed
from .motion_model import FIELDS, RATES, SCALARS, VECTORS, MotionModel, Unit
from .registry import KINDS, MENU_NUMBERS

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
    "MotionStack",
    "Rates",
    "Unit",
    "curve",
    "evaluate",
    "evaluate_all",
    "evaluate_with_rates",
    "kinks",
    "steps_needed",
    "time_factors",
]
