"""The configuration of a run: dataclasses by section, read from TOML, changed by ``--set section.key=value``.

Lengths in this file are relative: training runs in normalised coordinates in which the cameras stand about four units
from what they look at (`normalization.py`), and iterations are for ``train.iterations`` = 6000 unless said.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

from ..errors import ConfigError

REPRESENTATIONS = ("tracks",)
BACKGROUNDS = ("auto", "learned", "white", "black")


@dataclass(frozen=True)
class TrainSection:
    """What is trained and for how long.

    Attributes:
        iterations: Optimisation steps; one view each.
        seed: Seed of all random draws.
        representation: ``tracks`` (one SE(3) track per object).
        background: ``learned`` sky, ``white`` or ``black``; ``auto`` is white where images carry alpha, else learned.
        sh_degree: Degree of the view-dependent colour, 0 to 3.
        threads: Threads of torch; the small arrays of this trainer gain nothing from more than one.
        checkpoint_every: Steps between checkpoints.
        log_every: Steps between log lines.
        shading: Learn how colours change as objects turn in fixed light.
        shadows: Learn shadow Gaussians that follow their caster on the plane that supports the objects.
    """

    iterations: int = 6000
    seed: int = 0
    representation: str = "tracks"
    background: str = "auto"
    sh_degree: int = 0
    threads: int = 1
    checkpoint_every: int = 500
    log_every: int = 50
    shading: bool = True
    shadows: bool = True


@dataclass(frozen=True)
class InitSection:
    """How Gaussians are placed before training.

    Attributes:
        object_points: Gaussians of each object.
        background_points: Gaussians of the background.
        shadow_points: Gaussians of each shadow.
        sweep_depths: Depths tried per ray when the background is placed.
        opacity: Initial opacity of bodies and background.
        min_mask_pixels: Smaller masks do not vote on an object's place, as a share of the image.
    """

    object_points: int = 500
    background_points: int = 5000
    shadow_points: int = 60
    sweep_depths: int = 96
    opacity: float = 0.25
    min_mask_pixels: float = 5e-4


@dataclass(frozen=True)
class RatesSection:
    """Learning rates of Adam, in normalised units per step.

    Attributes:
        means: Centres.
        log_scales: Logarithms of the standard deviations.
        sh: Constant colour, as harmonics.
        sh_rest: Colour that depends on the view.
        opacity_logits: Opacities before the sigmoid.
        quats: Orientations.
        shading: How colours change as objects turn.
        light: Direction of the light that they turn in.
        translations: Displacements of the tracks.
        rotvecs: Rotations of the tracks, rad.
        slope: How shadows follow their casters.
        background: Harmonics of the sky.
        decay: Factor by which rates have fallen at the end of the run.
        decay_floor_appearance: Appearance falls no lower than this factor.
        decay_from: Share of the run before the rates begin to fall.
    """

    means: float = 1e-3
    log_scales: float = 1e-2
    sh: float = 5e-3
    sh_rest: float = 2.5e-4
    opacity_logits: float = 0.05
    quats: float = 2e-3
    shading: float = 1e-2
    light: float = 1e-2
    translations: float = 3e-3
    rotvecs: float = 6e-3
    slope: float = 1e-2
    background: float = 2e-3
    decay: float = 0.02
    decay_floor_appearance: float = 0.1
    decay_from: float = 0.1


@dataclass(frozen=True)
class LossSection:
    """Weights of the losses.

    Attributes:
        ssim: Share of 1 - SSIM in the photometric loss; the rest is L1.
        roughness: Weight of the mean squared second difference of the tracks.
    """

    ssim: float = 0.2
    roughness: float = 0.02


@dataclass(frozen=True)
class CurriculumSection:
    """When observed times enter training, as steps.

    Attributes:
        first: Steps on the first time alone.
        grow: Steps over which the other times enter, from the first one outwards.
        newest: Share of draws on the newest times while they enter.
    """

    first: int = 200
    grow: int = 400
    newest: float = 0.4


@dataclass(frozen=True)
class DensifySection:
    """When Gaussians are split, cloned and removed.

    Attributes:
        start: First step.
        stop: Last step, as a share of the run.
        every: Steps between two rounds.
        gradient: Mean screen gradient above which a Gaussian grows, per half image width (the measure of 3DGS).
        share: Largest share of Gaussians that grow in a round.
        split_pixels: Larger ones (standard deviation in pixels) are split, smaller ones cloned.
        max_gaussians: Cap; 0 chooses it from the image size (3/4 of an image's pixels, at most 60000).
        prune_opacity: Fainter ones are removed.
        prune_width: Wider ones are removed; standard deviation as a share of the image width.
        prune_near: Background that is nearer to a camera and that no second camera sees is removed; normalised units
            (the cameras' focus is at about 4); 0 keeps it.
    """

    start: int = 200
    stop: float = 0.5
    every: int = 100
    gradient: float = 2e-4
    share: float = 0.2
    split_pixels: float = 1.0
    max_gaussians: int = 0
    prune_opacity: float = 0.01
    prune_width: float = 0.16
    prune_near: float = 1.0


@dataclass(frozen=True)
class IdentitySection:
    """Identity encodings (Gaussian Grouping), trained on frozen geometry after the run.

    Attributes:
        iterations: Steps; 0 leaves encodings and classifier out.
        rate: Learning rate of the encodings.
        classifier_rate: Learning rate of the classifier.
    """

    iterations: int = 400
    rate: float = 1e-2
    classifier_rate: float = 5e-3


@dataclass(frozen=True)
class Config:
    """All sections of a run's configuration."""

    train: TrainSection = field(default_factory=TrainSection)
    init: InitSection = field(default_factory=InitSection)
    rates: RatesSection = field(default_factory=RatesSection)
    losses: LossSection = field(default_factory=LossSection)
    curriculum: CurriculumSection = field(default_factory=CurriculumSection)
    densify: DensifySection = field(default_factory=DensifySection)
    identity: IdentitySection = field(default_factory=IdentitySection)

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary, ready for JSON."""
        return dataclasses.asdict(self)

    def replace(self, **changes: Any) -> Config:
        """A copy with some keys changed: ``replace(**{"train.iterations": 100})``."""
        return from_dict(_merge(self.to_dict(), changes))


def from_dict(values: dict[str, Any]) -> Config:
    """Build a configuration from nested dictionaries; omitted keys keep their defaults.

    Raises:
        ConfigError: A section or key is unknown (the nearest name is suggested), or a value is of the wrong type.
    """
    sections = {f.name: f for f in dataclasses.fields(Config)}
    hints = get_type_hints(Config)
    built: dict[str, Any] = {}
    for section, keys in values.items():
        if section not in sections:
            raise ConfigError(f"[{section}]: unknown section{_suggest(section, sections)}")
        if not isinstance(keys, dict):
            raise ConfigError(f"{section}: expected a section with keys, got {keys!r}")
        kind = hints[section]
        types = get_type_hints(kind)
        known = {f.name for f in dataclasses.fields(kind)}
        for key in keys:
            if key not in known:
                raise ConfigError(f"{section}.{key}: unknown key{_suggest(key, known)}")
        built[section] = kind(**{key: _check(f"{section}.{key}", value, types[key]) for key, value in keys.items()})
    config = Config(**built)
    _validate(config)
    return config


def load(path: Path | None, overrides: list[str] | tuple[str, ...] = ()) -> Config:
    """Read a TOML file (or none) and apply ``section.key=value`` overrides, values written as in TOML.

    Raises:
        ConfigError: The file is missing or not TOML, or a key or value cannot be used.
    """
    values: dict[str, Any] = {}
    if path is not None:
        try:
            values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ConfigError(f"{path}: no such configuration file") from None
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: not valid TOML: {error}") from None
    return from_dict(_merge(values, dict(_parse_override(text) for text in overrides)))


def _parse_override(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition("=")
    if not separator or name.count(".") != 1:
        raise ConfigError(f"--set {text}: expected SECTION.KEY=VALUE, for example losses.ssim=0.1")
    try:
        return name.strip(), tomllib.loads(f"x = {value}")["x"]
    except tomllib.TOMLDecodeError:
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


def _check(name: str, value: Any, kind: type) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ConfigError(f"{name}: expected {kind.__name__}, got {value!r}")
    if kind in (int, float) and not 0 <= value < math.inf:
        raise ConfigError(f"{name}: expected a finite number that is not negative, got {value!r}")
    return value


def _validate(config: Config) -> None:
    """Raise ConfigError naming the first key whose value no run can use."""
    for name, good, expected in _RULES:
        section, key = name.split(".")
        value = getattr(getattr(config, section), key)
        if not good(value):
            raise ConfigError(f"{name}: expected {expected}, got {value!r}")


_AT_LEAST_1: tuple[Callable[[Any], bool], str] = (lambda value: value >= 1, "at least 1")
_SHARE: tuple[Callable[[Any], bool], str] = (lambda value: 0 <= value <= 1, "0 to 1")
_POSITIVE: tuple[Callable[[Any], bool], str] = (lambda value: value > 0, "more than 0")
_INSIDE: tuple[Callable[[Any], bool], str] = (lambda value: 0 < value < 1, "between 0 and 1")
# What a value must be beyond its type; all numbers are finite and not negative (`_check`).
_RULES: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("train.iterations", *_AT_LEAST_1),
    ("train.seed", lambda value: value < 2**63 - 1, "less than 2^63 - 1"),
    ("train.representation", lambda value: value in REPRESENTATIONS, " or ".join(REPRESENTATIONS)),
    ("train.background", lambda value: value in BACKGROUNDS, " or ".join(BACKGROUNDS)),
    ("train.sh_degree", lambda value: value <= 3, "0 to 3"),
    ("train.threads", *_AT_LEAST_1),
    ("train.checkpoint_every", *_AT_LEAST_1),
    ("train.log_every", *_AT_LEAST_1),
    ("init.object_points", *_AT_LEAST_1),
    ("init.background_points", *_AT_LEAST_1),
    ("init.sweep_depths", lambda value: value >= 2, "at least 2"),
    ("init.opacity", *_INSIDE),
    ("init.min_mask_pixels", lambda value: value < 1, "less than 1"),
    ("rates.decay", lambda value: 0 < value <= 1, "more than 0, at most 1"),
    ("rates.decay_floor_appearance", *_SHARE),
    ("rates.decay_from", *_SHARE),
    ("losses.ssim", *_SHARE),
    ("curriculum.newest", *_SHARE),
    ("densify.stop", *_SHARE),
    ("densify.every", *_AT_LEAST_1),
    ("densify.share", *_SHARE),
    ("densify.prune_opacity", lambda value: value < 1, "less than 1"),
    ("densify.prune_width", *_POSITIVE),
)
