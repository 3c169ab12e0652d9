"""Files ``captures.toml``: data sets, the settings of their training, and the resources of their jobs."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..config import config as configs
from ..errors import ConfigError

RESULT_FILE, TABLE_FILE, JOBS_FOLDER = "batch.json", "table.md", "jobs"  # in the output folder
SUFFIXES = ("", ".r5dgs", ".json", ".evaluation.json", ".log")  # of the files of a capture, beside them
_KEYS: dict[str, type] = {"data": str, "name": str, "preset": str, "config": str, "set": list, "device": str}
# Parameters of submitit that are at most 1.
_ONE_PER_JOB = ("gpus_per_node", "gpus_per_task", "num_gpus", "tasks_per_node", "ntasks_per_node", "nodes")
_DEFAULTS = tuple(key for key in _KEYS if key not in ("data", "name"))


@dataclass(frozen=True)
class Capture:
    """One data set of a batch.

    Attributes:
        name: Name in the table; also that of its files in the output folder.
        data: The data set.
        arguments: Arguments of ``r5dgs train`` that choose its settings.
        config: The settings, with the device of training.
    """

    name: str
    data: Path
    arguments: tuple[str, ...]
    config: configs.Config


@dataclass(frozen=True)
class Batch:
    """Content of a file.

    Attributes:
        captures: The captures; no two of them have a file of the same name, even without regard to case.
        resources: Parameters of submitit, such as ``slurm_partition``.
    """

    captures: tuple[Capture, ...]
    resources: dict[str, Any]


def read(path: Path) -> Batch:
    """Read a file; relative paths in it are relative to its folder.

    Raises:
        ConfigError: The file cannot be read, or a key or value is invalid.
    """
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML in UTF-8: {error}") from None
    _check_keys(f"{path}", found, {"capture": list, "defaults": dict, "cluster": dict})
    _check_keys(f"{path}: defaults", found.get("defaults", {}), {key: _KEYS[key] for key in _DEFAULTS})
    tables = found.get("capture", [])
    if not tables:
        raise ConfigError(f"{path}: expected a table [[capture]] with 'data' for each capture, found none")
    captures: list[Capture] = []
    owners: dict[str, str] = dict.fromkeys((RESULT_FILE, TABLE_FILE, JOBS_FOLDER), "the batch itself")
    for number, table in enumerate(tables, 1):
        place = f"{path}: capture {number}"
        if not isinstance(table, dict):
            raise ConfigError(f"{place}: expected a table [[capture]], found {table!r}")
        _check_keys(place, table, _KEYS)
        one = _capture(place, path.parent, found.get("defaults", {}), table)
        files = [one.name + suffix for suffix in SUFFIXES]
        for file in files:
            if owner := owners.get(file.casefold()):  # some file systems ignore case
                taken = f"{file} in the output folder belongs to {owner}"
                raise ConfigError(f"{place}: name: {one.name!r}: {taken}; give the capture another 'name'")
        owners.update(dict.fromkeys(map(str.casefold, files), f"capture {number}, {one.name!r}"))
        captures.append(one)
    return Batch(tuple(captures), found.get("cluster", {}))


def check_resources(path: Path, resources: dict[str, Any], cluster: str) -> None:
    """Raise `ConfigError` if jobs of a file request several GPUs, processes or machines, of which they use only one.

    Args:
        path: The file.
        resources: Its parameters of submitit.
        cluster: "local" or "slurm"; parameters that begin with it apply to it alone, instead of the general ones.
    """
    for name in _ONE_PER_JOB:
        own = f"{cluster}_{name}"
        key = own if own in resources else name
        number = resources.get(key)
        if isinstance(number, int) and number > 1:
            raise ConfigError(
                f"{path}: cluster: {key} = {number}: expected at most 1, as a job is one process, which trains on one "
                f"GPU. Remedy: {key} = 1, or train the capture on several GPUs with torchrun (docs/user/training.md)"
            )


def _check_keys(place: str, table: dict[str, Any], kinds: dict[str, type]) -> None:
    for key, value in table.items():
        if key not in kinds:
            raise ConfigError(f"{place}: unknown key {key!r}; expected one of {', '.join(kinds)}")
        if not isinstance(value, kinds[key]):
            expected = {str: "text", list: "a list", dict: "a table"}[kinds[key]]
            raise ConfigError(f"{place}: {key}: expected {expected}, found {value!r}")


def _capture(place: str, folder: Path, defaults: dict[str, Any], table: dict[str, Any]) -> Capture:
    """Return the capture of a table; its settings are added to the defaults."""
    if "data" not in table:
        raise ConfigError(f"{place}: expected the key 'data', the folder of a data set")
    data = folder / table["data"]
    if not data.is_dir():
        raise ConfigError(f"{place}: data: {data} is not a folder")
    given = {**defaults, **table}
    settings = [*defaults.get("set", []), *table.get("set", [])]
    if not all(isinstance(text, str) for text in settings):
        raise ConfigError(f"{place}: set: expected texts such as 'train.iterations=6000', found {settings!r}")
    config = folder / given["config"] if "config" in given else None
    try:
        loaded = configs.load(config, tuple(settings), given.get("preset"))
        loaded = loaded.replace(**{"train.device": given.get("device", loaded.train.device)})
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from None
    name = table.get("name", data.resolve().name)
    if not re.fullmatch(r"[\w.-]*\w[\w.-]*", name):
        raise ConfigError(f"{place}: name: expected letters, digits, '_', '-' and '.', found {name!r}")
    arguments = ["--preset", given["preset"]] if "preset" in given else []
    arguments += ["--config", str(config.resolve())] if config is not None else []
    arguments += [text for setting in settings for text in ("--set", setting)]
    return Capture(name, data.resolve(), tuple(arguments), loaded)
