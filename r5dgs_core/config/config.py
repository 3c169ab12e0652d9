"""Configuration of a run: sections read from TOML, presets and ``--set section.key=value`` overrides."""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

from .. import findings
from ..errors import ConfigError, UsageError
from . import rules
from .presets import PRESETS
from .sections.densification import DensifyDefaultSection, DensifyMcmcSection, DensifySection
from .sections.identity import IdentitySection
from .sections.motion import DiscoverySection, FieldSection, ResidualSection
from .sections.needs import NeedsSection
from .sections.training import (
    CurriculumSection,
    DataSection,
    InitSection,
    LossSection,
    RatesSection,
    RefineSection,
    TrainSection,
)

_MAX_BYTES = 1 << 20  # maximum size of a configuration file


@dataclass(frozen=True)
class Config:
    """All sections of a run's configuration."""

    train: TrainSection = dataclasses.field(default_factory=TrainSection)
    data: DataSection = dataclasses.field(default_factory=DataSection)
    init: InitSection = dataclasses.field(default_factory=InitSection)
    rates: RatesSection = dataclasses.field(default_factory=RatesSection)
    losses: LossSection = dataclasses.field(default_factory=LossSection)
    field: FieldSection = dataclasses.field(default_factory=FieldSection)
    refine: RefineSection = dataclasses.field(default_factory=RefineSection)
    curriculum: CurriculumSection = dataclasses.field(default_factory=CurriculumSection)
    densify: DensifySection = dataclasses.field(default_factory=DensifySection)
    densify_default: DensifyDefaultSection = dataclasses.field(default_factory=DensifyDefaultSection)
    densify_mcmc: DensifyMcmcSection = dataclasses.field(default_factory=DensifyMcmcSection)
    discovery: DiscoverySection = dataclasses.field(default_factory=DiscoverySection)
    residual: ResidualSection = dataclasses.field(default_factory=ResidualSection)
    identity: IdentitySection = dataclasses.field(default_factory=IdentitySection)
    needs: NeedsSection = dataclasses.field(default_factory=NeedsSection)

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration as nested dictionaries, ready for JSON."""
        return dataclasses.asdict(self)

    def replace(self, **changes: Any) -> Config:
        """Return a copy with some keys changed: ``replace(**{"train.iterations": 100})``."""
        return from_dict(_merge(self.to_dict(), changes))

    def differences(self, other: Config) -> list[str]:
        """Return the keys whose values differ from those of another configuration, as ``section.key``."""
        own, others = self.to_dict(), other.to_dict()
        return [f"{name}.{key}" for name, keys in own.items() for key in keys if others[name][key] != keys[key]]

    def override(self, overrides: Sequence[str]) -> Config:
        """Return a copy with ``section.key=value`` overrides applied, as given to ``--set``."""
        return self.replace(**_parsed(overrides))


def from_dict(values: dict[str, Any], guard: findings.Guard = findings.STRICT) -> Config:
    """Build a configuration from nested dictionaries; omitted keys keep their defaults.

    Args:
        values: Keys by section.
        guard: Context manager around the check of each key and rule. A guard that collects errors instead of raising
            them (`findings`) leaves `findings.UNREAD` as the value of a faulty key.

    Raises:
        ConfigError: A section or key is unknown (the message suggests the nearest name), a value is invalid, or keys
            contradict each other.
    """
    config = _built(values, guard)
    rules.check_contradictions(config, guard)
    return config


def _built(values: dict[str, Any], guard: findings.Guard = findings.STRICT) -> Config:
    """Build a configuration with each key checked by itself, without the rules between keys."""
    sections = {f.name: f for f in dataclasses.fields(Config)}
    hints = get_type_hints(Config)
    built: dict[str, Any] = {}
    for section, keys in values.items():
        with guard():
            if section not in sections:
                raise ConfigError(f"[{section}]: unknown section{_suggest(section, sections)}")
            if not isinstance(keys, dict):
                raise ConfigError(f"{section}: expected a section with keys, got {keys!r}")
            built[section] = _section(section, keys, hints[section], guard)
    return Config(**built)


def _section(section: str, keys: dict[str, Any], kind: type, guard: findings.Guard) -> Any:
    types = get_type_hints(kind)
    known = {f.name for f in dataclasses.fields(kind)}
    for key in keys:
        with guard():
            if key not in known:
                raise ConfigError(f"{section}.{key}: unknown key{_suggest(key, known)}")
    found = {}
    for key in [key for key in keys if key in known]:
        found[key] = findings.UNREAD
        with guard():
            found[key] = rules.check_key(f"{section}.{key}", keys[key], types[key])
    return kind(**found)


def require_needs(overrides: Sequence[str]) -> None:
    """Raise `UsageError` if an override for a finished run names a key outside of ``needs``."""
    for text in overrides:
        if not text.strip().startswith("needs."):
            raise UsageError(f"--set {text}: the run keeps its configuration; bake accepts only needs.NAME=on|off")
    _parsed(overrides)


def load(
    path: Path | None,
    overrides: Sequence[str] = (),
    preset: str | None = None,
    guard: findings.Guard = findings.STRICT,
) -> Config:
    """Read a TOML file and apply a preset and ``section.key=value`` overrides.

    Args:
        path: The file; None for the defaults.
        overrides: Overrides with values written as in TOML; they take precedence over the file.
        preset: Name of one of `PRESETS`; the file and the overrides take precedence over it.
        guard: See `from_dict`.

    Raises:
        ConfigError: The file is missing, too large or not valid TOML, or a key or value is invalid.
        UsageError: The preset is unknown, or an override is invalid.
    """
    if preset is not None and preset not in PRESETS:
        raise UsageError(f"--preset {preset}: unknown preset{_suggest(preset, PRESETS)}")
    values: dict[str, Any] = {}
    if path is not None:
        try:
            with open(path, "rb") as stream:
                data = stream.read(_MAX_BYTES + 1)
        except FileNotFoundError:
            raise ConfigError(f"{path}: no such configuration file") from None
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error}") from error
        if len(data) > _MAX_BYTES:
            raise ConfigError(f"{path}: expected at most {_MAX_BYTES >> 10} KiB, found more")
        try:
            values = tomllib.loads(data.decode("utf-8"))
        except (ValueError, RecursionError) as error:  # ValueError: not TOML or UTF-8, or a number with too many digits
            raise ConfigError(f"{path}: not valid TOML in UTF-8: {error}; write the file again") from None
    if preset is not None:
        values = _merge_under(values, PRESETS[preset])
    merged = _merge(values, _parsed(overrides))
    try:
        return from_dict(merged, guard)
    except ConfigError as error:
        raise (ConfigError(f"{path}: {error}") if path is not None else error) from None


def _parsed(overrides: Sequence[str]) -> dict[str, Any]:
    """Parse overrides into values by ``section.key``. Raises `UsageError` if one of them is invalid."""
    found: dict[str, Any] = {}
    for text in overrides:
        name, value = _parse_override(text)
        try:
            _built(_merge({}, {name: value}))
        except ConfigError as error:
            raise UsageError(f"--set {error}") from None
        found[name] = value
    return found


def _merge_under(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Add the changes whose keys have no value yet. Values that are not sections stay for `from_dict` to reject."""
    missing = {}
    for name, value in changes.items():
        section, _, key = name.partition(".")
        keys = values.get(section, {})
        if isinstance(keys, dict) and key not in keys:
            missing[name] = value
    return _merge(values, missing)


def _parse_override(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition("=")
    if not separator or name.count(".") != 1:
        raise UsageError(f"--set {text}: expected SECTION.KEY=VALUE, for example losses.ssim=0.1")
    try:
        return name.strip(), tomllib.loads(f"x = {value}")["x"]
    except (ValueError, RecursionError):  # not TOML: text without quotes
        return name.strip(), value.strip()


def _merge(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = {section: dict(keys) if isinstance(keys, dict) else keys for section, keys in values.items()}
    for name, value in changes.items():
        section, _, key = name.partition(".")
        if not isinstance(merged.setdefault(section, {}), dict):
            raise ConfigError(f"{section}: expected a section with keys, got {merged[section]!r}")
        merged[section][key] = value
    return merged


def _suggest(name: str, known: Any) -> str:
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}'?" if close else f"; known are {', '.join(sorted(known))}"
