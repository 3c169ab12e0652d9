"""Options shared by several commands: their arguments, converters and values."""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import errors, input_paths, user_settings
from ..config import config
from ..config.sections.training import DEVICES

if TYPE_CHECKING:
    from ..evaluation.lpips import Lpips

_KEYS = {  # options that set one key of the configuration
    "iterations": "train.iterations",
    "seed": "train.seed",
    "max_gaussians": "densify.max_gaussians",
}


def add_training(p: argparse.ArgumentParser) -> None:
    """Add the options of commands that train one run."""
    p.add_argument("--seed", type=at_least(0), metavar="N", help="random seed; same as train.seed (default: 0)")
    add_settings(p)
    again = p.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="continue from the last checkpoint")
    again.add_argument("--overwrite", action="store_true", help="replace an existing run in the output folder")


def add_settings(p: argparse.ArgumentParser) -> None:
    """Add the options that configure training."""
    named = "named settings: fast (a first look), cpu or paper (deformation field); --config and --set override them"
    p.add_argument("--preset", metavar="NAME", help=named)
    shown = "TOML configuration file; 'r5dgs config' lists all keys"
    p.add_argument("--config", type=Path, metavar="FILE", help=shown)
    add_overrides(p, "SECTION.KEY=VALUE", "override a key")
    steps = "optimisation steps; same as train.iterations (default: 6000)"
    p.add_argument("--iterations", type=at_least(1), metavar="N", help=steps)
    cap = "maximum number of Gaussians, from the first step on; same as densify.max_gaussians"
    p.add_argument("--max-gaussians", type=at_least(0), metavar="N", help=cap)
    device = "device for training: cpu, cuda, cuda:N or auto; same as train.device (default: auto)"
    p.add_argument("--device", type=device_name, metavar="NAME", help=device)
    add_threads(p)
    add_progress(p)


def add_lpips(p: argparse.ArgumentParser) -> None:
    """Add ``--lpips``."""
    shown = (
        "files of features and heads for LPIPS, after all other arguments (default: the user's setting "
        "metrics.lpips_weights)"
    )
    p.add_argument("--lpips", type=Path, nargs="+", metavar="FILE", help=shown)


def lpips_files(given: Sequence[Path] | None) -> tuple[Path, ...]:
    """Return the files of ``--lpips`` or of the user's settings; empty if neither names some.

    Raises:
        ConfigError: A file does not exist.
    """
    stored = "" if given else user_settings.read().get(user_settings.LPIPS, "")
    files = tuple(given or map(Path, filter(None, stored.split(os.pathsep))))
    for path in files:
        if not path.is_file():
            place = "--lpips" if given else user_settings.LPIPS
            raise errors.ConfigError(f"{place} {path}: expected a file with weights, found none")
    return files


def lpips_network(files: Sequence[Path]) -> Lpips | None:
    """Return the network of `lpips_files`, or None without files. Raises `BackendError` if a file cannot be used."""
    from ..evaluation import lpips

    return lpips.load(files) if files else None


def device_name(text: str) -> str:
    """Convert an argument to the name of a device."""
    if not re.fullmatch(DEVICES, text):
        raise argparse.ArgumentTypeError(f"expected auto, cpu, cuda or cuda:N, got {text!r}")
    return text


def add_overrides(p: argparse.ArgumentParser, form: str, meaning: str) -> None:
    """Add ``--set``."""
    p.add_argument("--set", action="append", default=[], metavar=form, help=f"{meaning}; may be repeated")


def add_threads(p: argparse.ArgumentParser) -> None:
    """Add ``--threads``."""
    shown = "kernel threads (default: NUMBA_NUM_THREADS, or all cores); the number does not affect results"
    p.add_argument("--threads", type=at_least(1), metavar="N", help=shown)


def add_progress(p: argparse.ArgumentParser) -> None:
    """Add ``--progress``."""
    shown = "progress output (default: auto, which is bars in a terminal and plain lines elsewhere)"
    p.add_argument("--progress", choices=("auto", "json", "none"), default="auto", help=shown)


def at_least(least: int) -> Callable[[str], int]:
    """Return a converter of arguments to integers of at least ``least``."""

    def integer(text: str) -> int:
        if not (text.strip().isdecimal() and least <= int(text) < 2**31):
            raise argparse.ArgumentTypeError(f"expected an integer of at least {least}, got {text!r}")
        return int(text)

    return integer


def positive(text: str) -> float:
    """Convert an argument to a finite number above 0."""
    return _number(text, lambda value: value > 0, "more than 0")


def frame_rate(text: str) -> float:
    """Convert an argument to a number of frames per second that cameras may have."""
    return _number(text, lambda value: 1e-6 <= value <= 1e6, "from 1e-6 to 1e6")


def not_negative(text: str) -> float:
    """Convert an argument to a finite number of at least 0."""
    return _number(text, lambda value: value >= 0, "0 or more")


def _number(text: str, good: Callable[[float], bool], expected: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and good(value)):
        raise argparse.ArgumentTypeError(f"expected a number, {expected}, got {text!r}")
    return value


def overrides(args: argparse.Namespace) -> list[str]:
    """Return ``section.key=value`` of ``--set`` and of the options that set one key; the latter win."""
    found = list(args.set)
    for option, key in _KEYS.items():
        value = getattr(args, option, None)
        if value is not None:
            found.append(f"{key}={value}")
    return found


def training(args: argparse.Namespace) -> dict[str, Any]:
    """Return the values of the options of `add_training`, by the names of the arguments of `run_train`."""
    return {
        "config_path": args.config,
        "overrides": overrides(args),
        "preset": args.preset,
        "resume": args.resume,
        "overwrite": args.overwrite,
        "device": args.device,
        "threads": args.threads,
        "progress_kind": args.progress,
    }


def training_settings(
    folder: Path,
    config_path: Path | None,
    overrides: Sequence[str],
    *,
    preset: str | None,
    resume: bool,
    processes: int = 1,
) -> config.Config:
    """Return the configuration of a new run; a resumed run keeps its own.

    Args:
        folder: The run folder.
        config_path: Value of ``--config``.
        overrides: Values of ``--set``.
        preset: Value of ``--preset``.
        resume: True if a run in the folder is resumed.
        processes: Number of processes; by default, each draws one view per step.

    Raises:
        UsageError: A run is resumed with options that differ from its configuration.
        ConfigError: A key or value is invalid.
    """
    given = config.load(config_path, tuple(overrides), preset)
    if given.train.batch == 1 and processes > 1:
        given = given.replace(**{"train.batch": processes})
    if resume and (config_path or overrides or preset) and (Path(folder) / input_paths.RUN_FILE).exists():
        _refuse_changes(folder, given, overrides)
    return given


def _refuse_changes(folder: Path, given: config.Config, overrides: Sequence[str]) -> None:
    """Raise UsageError if a configuration differs from that of a run; a run may be resumed on another device."""
    from ..train import run_folder

    own = run_folder.open_run(folder).config
    if not any(text.startswith("train.device=") for text in overrides):
        given = given.replace(**{"train.device": own.train.device})
    changed = own.differences(given)
    if changed:
        raise errors.UsageError(
            f"--resume continues with the configuration of the run, which has other values of {', '.join(changed)}; "
            "leave out --preset, --config, --set, --iterations, --seed and --max-gaussians"
        )


def use_threads(count: int | None) -> None:
    """Set the number of threads of the kernels; None keeps NUMBA_NUM_THREADS, or else all usable cores."""
    if count is not None:
        from ..raster import thread_pool

        thread_pool.set_threads(count)
