"""The preferences say which Python runs the worker, and why Blender's own does not."""

import sys

import pytest

from tests.support import motions

VERSION = f"Python {sys.version_info[0]}.{sys.version_info[1]}"


@pytest.mark.parametrize(
    ("numba", "found", "expected"),
    [
        ("bundled", "", (f"Blender's own {VERSION} with bundled numba", "CHECKMARK")),
        ("installed", sys.executable, (f"Blender's own {VERSION} with installed numba", "CHECKMARK")),
        ("bundled", "/venv/bin/python", ("Found: /venv/bin/python, which also has torch", "INFO")),
        (
            "",
            "/venv/bin/python",
            (f"Found: /venv/bin/python; this build of the extension has no numba wheel for {VERSION}", "INFO"),
        ),
        (
            "",
            "",
            (
                f"No Python with numba found yet; this build of the extension has no numba wheel for {VERSION}; "
                "the first render searches for one",
                "ERROR",
            ),
        ),
    ],
)
def test_the_preferences_name_the_python_and_the_reason(blender, monkeypatch, numba, found, expected):
    preferences = motions.addon("preferences")
    monkeypatch.setattr(preferences.find_python, "own_numba", lambda: numba)
    assert preferences._search_result(found) == expected


@pytest.mark.parametrize(
    ("place", "expected"),
    [("extensions/.local/lib/python3.11/site-packages", "bundled"), ("site-packages", "installed"), (None, "")],
)
def test_numba_of_the_extension_and_of_the_python_are_told_apart(blender, monkeypatch, tmp_path, place, expected):
    find_python = motions.addon("find_python")
    monkeypatch.setattr(sys, "path", [])
    if place is not None:
        (tmp_path / place / "numba").mkdir(parents=True)
        (tmp_path / place / "numba" / "__init__.py").touch()
        monkeypatch.setattr(sys, "path", [str(tmp_path / place)])
    assert find_python.own_numba() == expected
