"""Cases of a benchmark, one training run each, and their files.

A case of scene S, variant V and seed K has the run folder ``S/V_seedK`` in the benchmark's folder, and beside it the
files ``.r5dgs`` (scene), ``.log`` (stderr of training) and ``.json`` (record).
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import atomic_files, strict_json
from ..config import config as configs
from ..data import dataset as datasets
from ..errors import CheckpointError, ConfigError
from ..playback import modes
from ..train import checkpoint, run_folder
from . import variants as kinds

# Evaluating held-out views during training would add to its time. The user's settings override these.
QUIET = ("train.probe_every=0",)
COSTS = ("cpu_seconds", "wall_seconds", "peak_mb", "peak_gpu_mb")  # of a session; seconds are summed, peaks maximised


@dataclass(frozen=True)
class BenchmarkRequest:
    """Request of a benchmark.

    Attributes:
        scenes: Data sets.
        out: Folder of the benchmark.
        variants: Names from `variants.VARIANTS`.
        seeds: Seeds of training.
        modes: Playback modes from `modes.every`; modes without data in a scene are skipped.
        preset: Named training settings.
        config_path: TOML configuration; overrides the preset.
        overrides: ``section.key=value``; override both.
        lpips: Files of the weights of LPIPS; empty to leave it out.
    """

    scenes: tuple[Path, ...]
    out: Path
    variants: tuple[str, ...] = kinds.DEFAULT_VARIANTS
    seeds: tuple[int, ...] = (0,)
    modes: tuple[str, ...] = modes.MODES
    preset: str | None = None
    config_path: Path | None = None
    overrides: tuple[str, ...] = ()
    lpips: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Case:
    """One training run and its measurement.

    Attributes:
        scene: Name of the data set.
        root: Folder of the data set.
        variant: Name from `variants.VARIANTS`.
        seed: Seed of training.
        run: Run folder.
        overrides: All ``section.key=value`` of its configuration.
    """

    scene: str
    root: Path
    variant: str
    seed: int
    run: Path
    overrides: tuple[str, ...]

    @property
    def title(self) -> str:
        """Short description of the case."""
        return f"{self.scene}, {self.variant}, seed {self.seed}"

    @property
    def names(self) -> dict[str, Any]:
        """Fields that identify the case in its records."""
        representation = kinds.VARIANTS[self.variant]["train.representation"]
        return {"scene": self.scene, "representation": representation, "variant": self.variant, "seed": self.seed}

    def beside(self, suffix: str) -> Path:
        """Return the path of a file beside the run folder, with the folder's name and a suffix."""
        return self.run.with_name(self.run.name + suffix)


def make(plan: BenchmarkRequest) -> list[Case]:
    """Return the cases of a plan, ordered by seed, scene and variant, so that complete tables are available early.

    All checks that are possible before hours of training are made here.

    Raises:
        ConfigError: A variant, mode or setting is unknown, or a case was started with other settings.
        DatasetError: A data set cannot be read, or two have the same name.
        CheckpointError: A run folder is damaged, or its run was trained on other data.
    """
    every_mode = modes.every()
    for name, given, known in (("--variants", plan.variants, kinds.VARIANTS), ("--modes", plan.modes, every_mode)):
        if not given:
            raise ConfigError(f"{name}: expected at least one of {', '.join(known)}")
        for item in given:
            if item not in known:
                raise ConfigError(f"{name} {item}: expected one or more of {', '.join(known)}")
    if plan.out.exists() and not plan.out.is_dir():
        raise ConfigError(f"--out {plan.out}: is a file; name a folder")
    roots: dict[str, Path] = {}
    digests: dict[str, str] = {}
    chosen = configs.load(plan.config_path, plan.overrides, plan.preset).data
    for root in plan.scenes:
        dataset = datasets.read(root, chosen.masks, chosen.min_registered)
        name = Path(dataset.root).resolve().name
        if name in roots:
            raise ConfigError(f"{roots[name]} and {root}: are both called {name}; give one of them another name")
        roots[name], digests[name] = root, dataset.digest
    cases = []
    for seed in dict.fromkeys(plan.seeds):
        for scene, root in roots.items():
            for variant in dict.fromkeys(plan.variants):
                suited = kinds.suited(variant, plan.preset)
                settings = {**kinds.settings(variant, plan.preset), "train.seed": str(seed)}
                overrides = (*QUIET, *_texts(suited), *plan.overrides, *_texts(settings))
                case = Case(scene, root, variant, seed, plan.out / scene / f"{variant}_seed{seed}", overrides)
                _check_settings(case, configs.load(plan.config_path, overrides, plan.preset))
                _check_data(case, digests[scene])
                cases.append(case)
    return cases


def _check_settings(case: Case, wanted: configs.Config) -> None:
    """Raise ConfigError if the case's run was started with other settings; CheckpointError if it is damaged."""
    if not (case.run / run_folder.RUN_FILE).exists():
        return
    found = run_folder.open_run(case.run).config.to_dict()
    for section, keys in wanted.to_dict().items():
        for key, value in keys.items():
            if found[section][key] != value:
                raise ConfigError(
                    f"{case.run}: was started with {section}.{key} = {found[section][key]}, expected {value}; "
                    "use the settings it was started with, or choose another --out"
                )


def _check_data(case: Case, digest: str) -> None:
    """Raise CheckpointError if the case was trained on other data than the current data set."""
    if checkpoint.newest_file(case.run) is None:
        return  # no checkpoint depends on the data yet
    if run_folder.open_run(case.run).digest != digest:
        raise CheckpointError(
            f"{case.run}: was trained on other data than {case.root} now holds; restore the data, choose another "
            f"--out, or remove {case.run} and {case.beside('.json').name} beside it to train it again"
        )


def _texts(settings: dict[str, str]) -> tuple[str, ...]:
    """Return settings in the form of ``--set``."""
    return tuple(f"{key}={value}" for key, value in settings.items())


def read_record(case: Case) -> dict[str, Any]:
    """Return the record of a case: ``sittings``, the sessions of its training, and, once measured, ``measured``.

    Raises:
        CheckpointError: The file is damaged.
    """
    path = case.beside(".json")
    if not path.exists():
        return {"sittings": []}
    record = strict_json.read(path, CheckpointError, "remove it to measure this run again")
    if not isinstance(record, dict) or not isinstance(record.get("sittings"), list):
        raise CheckpointError(f"{path}: expected an object with 'sittings'; remove it to measure this run again")
    return record


def write_record(case: Case, record: dict[str, Any]) -> None:
    """Replace the record of a case.

    Raises:
        CheckpointError: The record cannot be written.
    """
    write(case.beside(".json"), json.dumps(record, indent=2))


def write(path: Path, text: str) -> None:
    """Replace a file of the benchmark; creates its folder.

    Raises:
        CheckpointError: The file cannot be written.
    """
    try:
        os.makedirs(path.parent, exist_ok=True)
        atomic_files.write(path, text.encode())
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be written: {error}; free disk space and repeat the command") from error


def is_finished(case: Case) -> bool:
    """Return True if the case's training has finished.

    Raises:
        CheckpointError: The checkpoint is damaged.
    """
    return checkpoint.newest_file(case.run) is not None and checkpoint.load(case.run).finished


def cost(sittings: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Return the cost of training over all sessions: ``cpu_seconds``, ``wall_seconds``, ``peak_mb``, ``peak_gpu_mb``.

    A sum is None if the cost of a session is unknown (the benchmark was killed); a peak is None if it is unknown for
    all sessions.
    """
    result: dict[str, float | None] = {}
    for key in COSTS[:2]:
        values = [sitting.get(key) for sitting in sittings]
        known = [value for value in values if value is not None]
        result[key] = round(sum(known), 3) if known and len(known) == len(values) else None
    for key in COSTS[2:]:
        known = [sitting[key] for sitting in sittings if sitting.get(key) is not None]
        result[key] = max(known) if known else None
    return result
