"""User settings: paths of weights and of the worker's Python, in the platform's configuration folder.

The file is TOML with one ``key = "value"`` per line. Needs only the standard library.
"""

from __future__ import annotations

import json
import os
import sys
import tomllib
from pathlib import Path
from typing import Any

from . import atomic_files
from .errors import ConfigError, UsageError

LPIPS = "metrics.lpips_weights"
MEANINGS = {
    "encoder": "folder of the text and image encoder, or 'text' (lookup and query --encoder)",
    "sam2": "folder of the SAM2 weights (masks --model)",
    LPIPS: f"files of the LPIPS weights, separated by {os.pathsep!r} (evaluate, bench and report --lpips)",
    "worker_python": "Python program with r5dgs_core that Blender starts as worker",
}


def path() -> Path:
    """Return the path of the settings file, which may not exist.

    Raises:
        ConfigError: The user has no home folder.
    """
    try:
        if sys.platform == "win32":
            base = os.environ.get("APPDATA") or Path.home() / "AppData" / "Roaming"
        elif sys.platform == "darwin":
            base = Path.home() / "Library" / "Application Support"
        else:
            base = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    except RuntimeError as error:
        raise ConfigError(f"user settings: no home folder: {error}; set XDG_CONFIG_HOME") from None
    return Path(base) / "r5dgs" / "settings.toml"


def read() -> dict[str, str]:
    """Return the settings; empty if the file is missing.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or has an unknown key or a value that is not text.
    """
    place = path()
    try:
        text = place.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{place}: cannot be read: {error}; correct or remove the file") from None
    try:
        found = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:  # the message has line and column
        raise ConfigError(f"{place}: not valid TOML: {error}; correct or remove the file") from None
    found = _flat(found)
    for key, value in found.items():
        if key not in MEANINGS or not isinstance(value, str):
            expected = "text in quotes" if key in MEANINGS else f"one of the keys {', '.join(MEANINGS)}"
            shown = f"{key} = {value!r}" if key in MEANINGS else repr(key)
            raise ConfigError(f"{place}: line {_line(text, key)}: expected {expected}, found {shown:.80}")
    return found


def write(key: str, value: str) -> Path:
    """Set a key, or remove it with an empty value; returns the path of the file. Paths are stored absolute.

    Raises:
        UsageError: The key is unknown.
        ConfigError: The value is a path that does not exist, or the file cannot be read or written.
    """
    if key not in MEANINGS:
        raise UsageError(f"config --user set {key}: expected one of the keys {', '.join(MEANINGS)}")
    settings = read()
    settings.pop(key, None)
    if value:
        settings[key] = _checked(key, value)
    place = path()
    lines = [f"{name} = {_quoted(settings[name])}\n" for name in MEANINGS if name in settings]
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        atomic_files.write(place, "".join(lines).encode())
    except UnicodeEncodeError as error:
        raise ConfigError(f"config --user set {key}: expected a path in UTF-8; rename the folder") from error
    except OSError as error:
        raise ConfigError(f"{place}: cannot be written: {error}") from error
    return place


def _flat(content: dict[str, Any]) -> dict[str, Any]:
    """Return a table with keys "section.key" for the tables in it."""
    found: dict[str, Any] = {}
    for key, value in content.items():
        found |= {f"{key}.{name}": one for name, one in value.items()} if isinstance(value, dict) else {key: value}
    return found


def _quoted(text: str) -> str:
    """Return a TOML string, which unlike JSON also escapes DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _checked(key: str, value: str) -> str:
    if (key, value) == ("encoder", "text"):
        return value
    if key == LPIPS:
        files = [Path(name).expanduser().absolute() for name in value.split(os.pathsep)]
        missing = next((file for file in files if not file.is_file()), None)
        if missing is not None:
            raise ConfigError(f"config --user set {key}: {missing}: expected a file, found none")
        return os.pathsep.join(map(str, files))
    # absolute(), not resolve(): the Python of a virtual environment is a link that must not be followed.
    place = Path(value).expanduser().absolute()
    wanted = place.is_file() if key == "worker_python" else place.is_dir()
    if not wanted:
        expected = "a program" if key == "worker_python" else "a folder"
        found = "nothing" if not place.exists() else "a folder" if place.is_dir() else "a file"
        raise ConfigError(f"config --user set {key} {value}: expected {expected}, found {found}")
    return str(place)


def _line(text: str, key: str) -> int:
    """Return the number of the line that sets a key or opens the table of that name; 1 if not found."""
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip(" \t[\"'").startswith(key.partition(".")[0]):
            return number
    return 1
