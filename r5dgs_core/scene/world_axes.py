"""Up axes of world conventions."""

from __future__ import annotations

import numpy as np

UP_AXIS = {"blender": np.array([0.0, 0.0, 1.0]), "opengl": np.array([0.0, 1.0, 0.0])}
"""Unit vector against gravity by world convention; others, such as "colmap", do not define it."""
