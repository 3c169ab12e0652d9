"""Weights of other projects: state dictionaries of tensors, read without executing code from the file."""

from __future__ import annotations

import pickle
import zipfile
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from ..errors import CheckpointError
from ..model import plain_tensors


@dataclass(frozen=True)
class Linear:
    """Affine layer.

    Attributes:
        weight: [outputs, inputs] float32
        bias: [outputs] float32
    """

    weight: Tensor
    bias: Tensor

    @property
    def inputs(self) -> int:
        """Number of input channels."""
        return self.weight.shape[1]

    @property
    def outputs(self) -> int:
        """Number of output channels."""
        return self.weight.shape[0]

    def __call__(self, x: Tensor) -> Tensor:
        """Apply the layer. [..., inputs] -> [..., outputs]"""
        return functional.linear(x, self.weight, self.bias)


@dataclass(frozen=True)
class Weights:
    """Tensors of one file by name.

    Attributes:
        path: The file, for errors.
        tensors: Float32, on the CPU.
    """

    path: Path
    tensors: dict[str, Tensor]

    def __contains__(self, name: str) -> bool:
        return name in self.tensors

    def tensor(self, name: str, shape: tuple[int | None, ...]) -> Tensor:
        """Return a tensor after checking its shape; None matches any size."""
        if name not in self.tensors:
            raise CheckpointError(
                f"{self.path}: expected the tensor '{name}', found {', '.join(sorted(self.tensors)[:8]) or 'none'}, ..."
            )
        found = tuple(self.tensors[name].shape)
        if len(found) != len(shape) or any(n not in (None, m) for n, m in zip(shape, found, strict=True)):
            raise CheckpointError(f"{self.path}: '{name}': expected shape {_words(shape)}, found {_words(found)}")
        return self.tensors[name]

    def linear(self, name: str, *, inputs: int | None = None, outputs: int | None = None) -> Linear:
        """Return the layer ``name.weight, name.bias``, after checking the given widths."""
        weight = self.tensor(f"{name}.weight", (outputs, inputs))
        return Linear(weight, self.tensor(f"{name}.bias", (weight.shape[0],)))

    def chain(self, names: list[str], *, inputs: int | None, outputs: int | None = None) -> list[Linear]:
        """Return consecutive layers, after checking that their widths match."""
        layers: list[Linear] = []
        for i, name in enumerate(names):
            layers.append(self.linear(name, inputs=inputs, outputs=outputs if i == len(names) - 1 else None))
            inputs = layers[-1].outputs
        return layers


def load(path: Path) -> Weights:
    """Read a state dictionary; accepts only tensors.

    Raises:
        CheckpointError: The file is missing, damaged, holds code, or anything but finite tensors by name.
    """
    path = Path(path)
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                inflated = any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist())
            if inflated:
                raise CheckpointError(f"{path}: holds compressed members, which torch.save never writes; refused")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointError:
        raise
    except FileNotFoundError:
        raise CheckpointError(f"{path}: the file is missing") from None
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path}: refused, as it holds code or objects besides tensors ({_reason(error)}); "
            "use a file saved with torch.save(model.state_dict(), ...)"
        ) from error
    except Exception as error:  # torch raises many types for damaged files
        raise CheckpointError(f"{path}: cannot be read ({type(error).__name__}); is it truncated?") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: expected tensors by name, found {type(content).__name__}")
    tensors = {}
    for name, value in content.items():
        if not isinstance(name, str) or not isinstance(value, Tensor):
            raise CheckpointError(f"{path}: {name!r}: expected a tensor, found {type(value).__name__}")
        if fault := plain_tensors.fault(value.detach()):
            raise CheckpointError(f"{path}: {name!r:.60}: {fault}")
        tensors[name] = value.detach().to(torch.float32)
        if not torch.isfinite(tensors[name]).all():
            raise CheckpointError(f"{path}: '{name}': expected finite numbers, found NaN or infinity")
    return Weights(path, tensors)


def _reason(error: Exception) -> str:
    """Line of torch's long message that names the rejected object."""
    lines = [line.strip() for line in str(error).splitlines() if "nsupported" in line or "GLOBAL" in line]
    return (lines[0] if lines else str(error).splitlines()[0])[:160]


def _words(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
