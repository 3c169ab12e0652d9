"""Names of the tasks of the report, in its order. Needs only the standard library, for the command line."""

from __future__ import annotations

TASKS = ("dynamics", "poses", "family", "images", "raster", "training")
