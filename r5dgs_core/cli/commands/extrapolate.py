"""The command ``r5dgs extrapolate``: predict the motion of a scene again, with other pushes or materials."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, folder_lock, input_paths
from .. import options
from . import export

if TYPE_CHECKING:
    from ...scene.scene import Scene

NAME = "extrapolate"
SHORT = "predict the motion of a scene again, with other pushes or materials"
LONG = (
    "Predict the motion of a scene after its last observed time again, with contacts where the smooth motion would "
    "pass through something. Bodies may be pushed, and their friction and restitution set."
)
EXAMPLE = 'scene.r5dgs --push "red ball" 0.5,0,1 --out pushed.r5dgs'
PAGE = "user/contact.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file")
    p.add_argument("--out", type=Path, required=True, metavar="FILE.r5dgs", help="scene file to write")
    p.add_argument("--until", type=float, metavar="T", help="scene time up to which contacts are searched")
    ignore = "objects that touch nothing; may be repeated"
    p.add_argument("--ignore-contact", action="append", default=[], metavar="WORDS", help=ignore)
    push = "change of the velocity at t_max, in scene units per unit of time, world axes; may be repeated"
    p.add_argument("--push", action="append", default=[], nargs=2, metavar=("WORDS", "VX,VY,VZ"), help=push)
    p.add_argument("--si", action="store_true", help="--push is in m/s")
    friction = "Coulomb friction of objects, >= 0; may be repeated"
    p.add_argument("--friction", action="append", default=[], metavar="WORDS=MU", help=friction)
    bounce = "coefficient of restitution of objects, 0 to 1; may be repeated"
    p.add_argument("--bounce", action="append", default=[], metavar="WORDS=E", help=bounce)
    p.add_argument("--samples", type=int, default=32, metavar="N", help="sampled futures for the band (default: 32)")
    p.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the samples (default: 0)")
    options.add_threads(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    given = {"until": args.until, "samples": args.samples, "seed": args.seed, "si": args.si, "threads": args.threads}
    words = {"ignore": args.ignore_contact, "push": args.push, "friction": args.friction, "bounce": args.bounce}
    run_extrapolate(args.file, args.out, **words, **given)


@folder_lock.writes("out")
def run_extrapolate(
    path: Path,
    out: Path,
    *,
    ignore: Sequence[str] = (),
    push: Sequence[Sequence[str]] = (),
    friction: Sequence[str] = (),
    bounce: Sequence[str] = (),
    until: float | None = None,
    samples: int = 32,
    seed: int = 0,
    si: bool = False,
    threads: int | None = None,
) -> Scene:
    """Predict the motion of a scene file again, write it and print what touches something.

    Args:
        path: The scene file.
        out: The scene file to write.
        ignore: Words for objects that touch nothing.
        push: Pairs of words and a velocity "VX,VY,VZ".
        friction, bounce: "WORDS=NUMBER" each.
        until: Scene time up to which contacts are searched; None for the horizon.
        samples: Number of sampled futures.
        seed: Their seed.
        si: True if pushes are in m/s.
        threads: Threads of the kernels; see `options.use_threads`.

    Raises:
        UsageError: An argument is malformed.
        ConfigError: Words match no object or one that is not simulated, ``until`` is not after t_max, or ``si`` is
            given for a scene without units.
        BackendError: Contacts are needed and MuJoCo is not installed.
    """
    _check(until, samples)
    velocities = [(words, _vector(words, text)) for words, text in push]
    frictions = [_number("--friction", text, math.inf) for text in friction]
    bounces = [_number("--bounce", text, 1.0) for text in bounce]
    input_paths.check_scene(path)
    input_paths.check_scene_output(out)
    from ...bake import contact
    from ...contact import scene_bodies, scene_future, scene_world
    from ...scene import scene_file

    options.use_threads(threads)
    scene = scene_file.read(path)
    if until is not None and until <= scene.t_max:
        raise errors.ConfigError(f"--until {until:g}: expected a time after t_max = {scene.t_max:g}")
    scene = scene_bodies.without_contacts(scene)
    named = {"ignore": ignore, "push": velocities, "friction": frictions, "bounce": bounces}
    changes = _by_group(scene, named, _si_factor(scene, path) if si else 1.0)
    wishes = scene_world.Wishes(**changes, until=until, samples=samples, seed=seed)
    found = scene_future.predict(scene, wishes)
    changed = dataclasses.replace(scene, groups=found.groups, needs=contact.needs(scene.needs, found))
    scene_file.write(changed, out, precision=scene_file.precision_of(path))
    for line in (*found.lines, *(f"{name}: moves with contacts; {text}" for name, text in found.taken.items())):
        print(line)
    print(f"written: {out}" + ("" if found.taken else "; all motions are smooth"))
    return changed


def _by_group(scene: Scene, named: dict[str, Any], factor: float) -> dict[str, Any]:
    """Pushes, materials and ignored bodies as fields of `Wishes`; pushes are multiplied by ``factor``."""
    import numpy as np

    materials: dict[int, tuple[float | None, float | None]] = {}
    for words, value in named["friction"]:
        materials |= {g: (value, None) for g in _simulated(scene, words, "--friction")}
    for words, value in named["bounce"]:
        materials |= {g: (materials.get(g, (None,))[0], value) for g in _simulated(scene, words, "--bounce")}
    pushes = {g: factor * np.array(v) for words, v in named["push"] for g in _simulated(scene, words, "--push")}
    ignored = frozenset(g for words in named["ignore"] for g in _groups(scene, words, "--ignore-contact"))
    for number in sorted(ignored & pushes.keys()):
        name = next(item.name for item in scene.objects if item.id == scene.groups[number].object_id)
        raise errors.UsageError(f"--push and --ignore-contact both name {name}; remedy: leave one of them out")
    return {"pushes": pushes, "materials": materials, "ignored": ignored}


def _check(until: float | None, samples: int) -> None:
    if until is not None and not math.isfinite(until):
        raise errors.UsageError(f"--until {until}: expected a scene time")
    if not 1 <= samples <= 10_000:
        raise errors.UsageError(f"--samples {samples}: expected 1 to 10000")


def _vector(words: str, text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise errors.UsageError(f"--push {words!r} {text}: expected a velocity VX,VY,VZ, such as 0.5,0,1")
    return values


def _number(option: str, text: str, most: float) -> tuple[str, float]:
    words, sign, value = text.rpartition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not (sign and words and 0 <= number <= most and math.isfinite(number)):
        limits = "a number >= 0" if most == math.inf else f"a number from 0 to {most:g}"
        raise errors.UsageError(f"{option} {text!r}: expected WORDS= and {limits}, such as 'red ball=0.3'")
    return words, number


def _groups(scene: Scene, words: str, option: str) -> list[int]:
    """Bodies of the objects that words name."""
    ids = export.object_ids(scene, words, option)
    return [group.id for group in scene.groups if group.role == "body" and group.object_id in ids]


def _simulated(scene: Scene, words: str, option: str) -> list[int]:
    """Bodies of the objects that words name, each of which must have one that can be simulated."""
    from ...contact import scene_bodies

    bodies, lines = scene_bodies.of(scene)
    usable = {body.group.id for body in bodies} & set(_groups(scene, words, option))
    missing = export.object_ids(scene, words, option) - {scene.groups[number].object_id for number in usable}
    for name in (item.name for item in scene.objects if item.id in missing):
        reason = next((line for line in lines if line.startswith(f"{name}: ")), f"{name}: has no hull to simulate")
        raise errors.ConfigError(f"{option} {words!r}: {reason}; remedy: name other objects")
    return sorted(usable)


def _si_factor(scene: Scene, path: Path) -> float:
    """Scene units per unit of time in one m/s."""
    seconds, meters = scene.units.seconds_per_unit, scene.units.meters_per_unit
    if seconds is None or meters is None:
        raise errors.ConfigError(
            f"--si: {path} has no meters_per_unit and seconds_per_unit; remedy: give --push in scene units and leave "
            "--si out"
        )
    return seconds / meters
