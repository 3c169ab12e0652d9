"""Validation of a checkpoint's content: plain values, and tensors with consistent shapes and types."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from ..errors import CheckpointError
from ..model import plain_tensors
from ..model.gaussians import PARAMETERS

FORMAT_VERSION = 1
RESIDUAL_GAINS = "residual.gains"  # name of a tensor
MAY_BE_NAN = (RESIDUAL_GAINS, "refine.gains", "refine.sizes")  # names of tensors with nan for what was not examined
FROZEN = "held"  # name of a tensor: mask of the Gaussians whose centres are frozen
DISCOVERED_MASKS = "discovery.masks"  # name of a tensor: packed masks of the training views
DISCOVERED_LABELS = "discovery.labels"  # name of a tensor: labels that were found after the run instead of masks
TRAIN_PSNR = "train_psnr"  # name of a tensor: `view_psnr.training_psnr` of a finished run, dB
UNEXPLAINED = "unexplained"  # name of a tensor: `unexplained_views.Decision`
TENSORS = (*(f"gaussians.{name}" for name in (*PARAMETERS, "motion_ids")), "object_ids", "background", "generator")

_WHOLE = (torch.int64, torch.int32)
_DTYPES = (torch.float32, torch.float64, torch.uint8, torch.bool, *_WHOLE)
# Lengths by letter: N Gaussians, B classes (background included), G groups (pinned one included), S observed times,
# W shadows. Other letters stand for any length; the same letter always stands for the same length.
_SHAPES: dict[str, tuple[str | int, ...]] = {
    "gaussians.means": ("N", 3),
    "gaussians.quats": ("N", 4),
    "gaussians.log_scales": ("N", 3),
    "gaussians.opacity_logits": ("N",),
    "gaussians.sh": ("N", 1, 3),
    "gaussians.sh_rest": ("N", "K - 1", 3),
    "gaussians.shading": ("N", 3),
    "gaussians.identities": ("N", "D"),
    "gaussians.motion_ids": ("N",),
    FROZEN: ("N",),
    "object_ids": ("B",),
    "background": ("Kb", 3),
    "generator": ("bytes",),
    "light": (3,),
    TRAIN_PSNR: (),
    UNEXPLAINED: (2,),
    "labels": ("N",),
    "identities": ("N", "D"),
    "classifier.weight": ("C", "D"),
    "classifier.bias": ("C",),
    "tracks.times": ("S",),
    "tracks.centers": ("G", 3),
    "tracks.translations": ("G", "S", 3),
    "tracks.rotvecs": ("G", "S", 3),
    "tracks.base_quats": ("G", "S", 4),
    "tracks.slope": (3,),
    "tracks.casters": ("W",),
    "tracks.plane_normal": (3,),
    "tracks.entered": (2,),
    "tracks.owners": ("G",),
    "tracks.absent": ("B - 1", "S"),
    "field.times": ("S",),
    "field.casters": ("W",),
    "field.plane_normal": (3,),
    "field.bodies": (),
    "field.iteration": (),
    "still.centers": ("G", 3),
    "still.time": (),
}
_WHOLE_NUMBERS = {
    "gaussians.motion_ids",
    "object_ids",
    "labels",
    "tracks.casters",
    "tracks.entered",
    "tracks.owners",
    "field.casters",
    "field.bodies",
    "field.iteration",
}
_MASKS = (FROZEN, "tracks.absent")
_OPTIONAL = ("tracks.entered", "tracks.owners", "tracks.absent")
_REQUIRED = {  # by representation
    "tracks": (
        "light",
        *(name for name in _SHAPES if name.startswith("tracks.") and name not in _OPTIONAL),
    ),
    "field": ("light", *(name for name in _SHAPES if name.startswith("field."))),
    "still": ("still.centers", "still.time"),
}


def check(content: Any) -> dict[str, Any]:
    """Return the values of a checkpoint by the names of its fields.

    Args:
        content: Content of the file.

    Raises:
        CheckpointError: A value is missing or invalid; the message names the value, but not the file.
    """
    version = content.get("format_version") if isinstance(content, dict) else None
    if not isinstance(version, int) or version != FORMAT_VERSION:
        raise CheckpointError(f"expected a checkpoint of format_version {FORMAT_VERSION}")
    for name, (good, expected) in _RULES.items():
        if name not in content:
            raise CheckpointError(f"expected '{name}', found none")
        if not good(content[name]):
            raise CheckpointError(f"'{name}': expected {expected}, found {type(content[name]).__name__}")
    tensors = content["tensors"]
    for name in (*TENSORS, *_REQUIRED.get(content["representation"], ())):
        if name not in tensors:
            raise CheckpointError(f"expected the tensor '{name}', found none")
    _check_tensors({**tensors, "observed": content["observed"]})
    return {name: content[name] for name in _RULES}


def _check_tensors(tensors: Mapping[str, Tensor]) -> None:
    """Raise `CheckpointError` if a tensor is not plain memory or the shapes of two tensors are inconsistent."""
    lengths: dict[str, int] = {}
    for name, tensor in tensors.items():
        if fault := plain_tensors.fault(tensor, _DTYPES):
            raise CheckpointError(f"'{name}': {fault}")
        shape = _SHAPES.get(name)
        if shape is None:
            continue
        found = tuple(tensor.shape)
        fits = len(shape) == len(found)
        for length, letter in zip(found, shape, strict=False):
            fits = fits and length == (letter if isinstance(letter, int) else lengths.setdefault(letter, length))
        if not fits:
            expected = ", ".join(f"{x} = {lengths[x]}" if x in lengths else str(x) for x in map(str, shape))
            raise CheckpointError(f"'{name}': expected shape [{expected}], found {list(found)}")
        wrong = (name in _WHOLE_NUMBERS) != (tensor.dtype in _WHOLE) and name != "generator"
        if wrong or (name in _MASKS and tensor.dtype != torch.bool):
            raise CheckpointError(f"'{name}': expected another type of number than {tensor.dtype}")
    for name in ("observed", "tracks.absent") if DISCOVERED_LABELS not in tensors else ():
        if name in tensors and len(tensors[name]) != max(0, lengths["B"] - 1):
            raise CheckpointError(f"'{name}': expected {lengths['B'] - 1} rows, found {len(tensors[name])}")


def _are(kinds: type | tuple[type, ...], length: int | None = None) -> Callable[[Any], bool]:
    """Return a predicate for sequences of numbers of some kinds, of a given length if any."""
    return lambda value: (
        isinstance(value, list | tuple)
        and (length is None or len(value) == length)
        and all(isinstance(x, kinds) and not isinstance(x, bool) for x in value)
    )


def _is(kinds: type | tuple[type, ...]) -> Callable[[Any], bool]:
    """Return a predicate for numbers of some kinds."""
    return lambda value: _are(kinds, 1)([value])


def _are_tensors(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(n, str) and isinstance(t, Tensor) for n, t in value.items())


_RULES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "tensors": (_are_tensors, "tensors by name"),
    "representation": (lambda value: isinstance(value, str), "a name"),
    "iteration": (_is(int), "a whole number"),
    "entered": (_are(int, 2), "two whole numbers"),
    "first_time": (_is(int), "a whole number"),
    "queue": (_are(int), "whole numbers"),
    "running_loss": (_is((int, float)), "a number"),
    "origin": (_are((int, float), 3), "three numbers"),
    "scale": (lambda value: _is((int, float))(value) and value > 0, "a positive number"),
    "observed": (lambda value: isinstance(value, Tensor) and value.dtype == torch.bool, "a tensor of truth values"),
    "finished": (lambda value: isinstance(value, bool), "true or false"),
    "seconds": (_is((int, float)), "a number"),
}
