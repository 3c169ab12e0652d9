"""Names of the playback modes: BASE or BASE/VARIANT. Imports only the standard library.

Without a variant, the first one of the base applies. `scene_player` describes the modes.
"""

from __future__ import annotations

SOURCES = ("fitted", "representative", "median", "least_squares", "kabsch")  # sources of a group's motion past t_max
MODES = ("rigid", "hybrid", "standard", "rigid_paper")
VARIANTS: dict[str, tuple[str, ...]] = {
    "rigid": SOURCES,
    "hybrid": SOURCES,
    "standard": (),
    "rigid_paper": ("pinned", "anchored"),
}


def split(mode: str) -> tuple[str, str]:
    """Return base and variant of a mode. The variant defaults to the first one, or "" if the base has none.

    Raises:
        ValueError: The mode is unknown.
    """
    base, slash, variant = mode.partition("/") if isinstance(mode, str) else ("", "", "")
    if base not in MODES:
        raise ValueError(f"mode: expected one of {', '.join(MODES)}, got {mode!r}")
    variants = VARIANTS[base]
    if slash and variant not in variants:
        known = ", ".join(f"{base}/{name}" for name in variants) or base
        raise ValueError(f"mode: expected one of {known}, got {mode!r}")
    return base, variant or next(iter(variants), "")


def every() -> tuple[str, ...]:
    """Return all modes, each once; the first variant of a base has the name of the base."""
    return tuple(mode for base in MODES for mode in (base, *(f"{base}/{variant}" for variant in VARIANTS[base][1:])))
