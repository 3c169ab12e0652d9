"""Rigid motion past t_max: one module per kind of motion, and their evaluation at any time."""

import importlib

from .base import BLOCKS, Block, MotionKind, Rates, clocks
from .evaluation import Stack, curve, evaluate, evaluate_all, evaluate_with_rates, kinks, steps_needed
from .motion_model import EXTRA_RATES, KINDS, RATES, SCALARS, VECTORS, MotionModel

# Each kind is the module of its name. Append new ones: .blend files store the position in Blender's menu.
_NAMES = (
    "static",
    "translation",
    "ballistic_spin",
    "constant_twist",
    "world_twist",
    "free_top",
    "drag",
    "friction",
    "precession",
    "bounce",
    "two_oscillations",
)
KINDS.update({name: importlib.import_module(f"{__name__}.{name}").KIND for name in _NAMES})
STATIC = MotionModel()

__all__ = [
    "EXTRA_RATES",
    "BLOCKS",
    "KINDS",
    "RATES",
    "SCALARS",
    "STATIC",
    "VECTORS",
    "Block",
    "MotionKind",
    "MotionModel",
    "Rates",
    "Stack",
    "clocks",
    "curve",
    "evaluate",
    "evaluate_all",
    "evaluate_with_rates",
    "kinks",
    "steps_needed",
]
