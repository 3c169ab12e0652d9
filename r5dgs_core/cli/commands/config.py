"""The command ``r5dgs config``: print the training keys or the user's settings."""

from __future__ import annotations

import argparse
import dataclasses
import json
import textwrap
from pathlib import Path

from ... import errors, input_paths, strict_json, user_settings
from ...config import config as configs
from ...config import config_keys

WIDTH = 80  # columns


NAME = "config"
SHORT = "print all training keys, or the user's settings"
LONG = (
    "Print every training key with its meaning, unit, default and value, for a run, a TOML file or the defaults.\n"
    "With --user, print the user's settings (paths of weights), or change one of them."
)
EXAMPLE = "RUN\n  r5dgs config --user set encoder ~/models/clip"
PAGE = "reference/command_line.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    where = p.add_mutually_exclusive_group()
    where.add_argument("target", type=Path, nargs="?", metavar="RUN|FILE.toml", help="run folder or TOML file")
    user = "print the user's settings; 'set KEY VALUE' changes one, 'set KEY \"\"' removes it"
    where.add_argument("--user", nargs="*", metavar="set KEY VALUE", help=user)
    p.add_argument("--json", action="store_true", help="print JSON instead of text")


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    if args.user is not None:
        run_user_config(args.user, as_json=args.json)
    else:
        run_config(args.target, as_json=args.json)


def run_config(target: Path | None, *, as_json: bool = False) -> configs.Config:
    """Print every training key with its meaning, unit, default and value in force.

    Args:
        target: Run folder, TOML file, or None for the defaults.
        as_json: Print JSON instead of text.

    Returns:
        The configuration.

    Raises:
        CheckpointError, ConfigError: The run or file cannot be read.
    """
    config = _of_run(target) if target is not None and target.is_dir() else configs.load(target)
    keys = config_keys.keys(config)
    if as_json:
        print(json.dumps([dataclasses.asdict(key) for key in keys], indent=1))
        return config
    section = ""
    for key in keys:
        if key.name.partition(".")[0] != section:
            section = key.name.partition(".")[0]
            print(f"\n[{section}]")
        changed = "" if key.value == key.default else f"; default {_toml(key.default)}"
        print(f"{key.name.partition('.')[2]} = {_toml(key.value)}  # {key.unit}{changed}")
        print(textwrap.fill(key.meaning, WIDTH, initial_indent="    # ", subsequent_indent="    # "))
    return config


def _of_run(folder: Path) -> configs.Config:
    input_paths.check_run(folder)
    path = folder / input_paths.RUN_FILE
    content = strict_json.read(path, errors.CheckpointError, "train again with --overwrite")
    if not isinstance(content, dict) or not isinstance(content.get("config"), dict):
        raise errors.CheckpointError(f"{path}: expected the configuration of a run, found none")
    return configs.from_dict(content["config"])


def run_user_config(arguments: list[str], *, as_json: bool = False) -> dict[str, str]:
    """Print the user's settings, or change one of them.

    Args:
        arguments: Empty, or "set", key and value; an empty value removes the key.
        as_json: Print JSON instead of text.

    Returns:
        The settings.

    Raises:
        UsageError: The arguments have another form.
        ConfigError: The settings file cannot be read or written.
    """
    if arguments:
        if len(arguments) != 3 or arguments[0] != "set":
            raise errors.UsageError(f"--user {' '.join(arguments)}: expected nothing, or 'set KEY VALUE'")
        user_settings.write(*arguments[1:])
    settings, place = user_settings.read(), user_settings.path()
    if as_json:
        print(json.dumps({"path": str(place), "settings": settings}, indent=1))
        return settings
    print(f"{place}{'' if place.exists() else ' (does not exist yet)'}")
    for key, meaning in user_settings.MEANINGS.items():
        print(f"{key} = {_toml(settings[key]) if key in settings else '(not set)'}")
        print(textwrap.fill(meaning, WIDTH, initial_indent="    # ", subsequent_indent="    # "))
    return settings


def _toml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)
