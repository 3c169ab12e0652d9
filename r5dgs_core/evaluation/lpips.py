"""LPIPS: perceptual distance of images from the features of AlexNet or VGG16, in plain torch.

Weights come from files that the user names: the features of a network trained on ImageNet, as torchvision stores them
(``features.0.weight``, ...), and the linear heads of LPIPS 0.1 (``lin0.model.1.weight``, ...), in one or several files.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from .. import errors, extras

Tensors = dict[str, torch.Tensor]
REMEDY = (
    "give the features of AlexNet or VGG16 from torchvision and the heads from the package lpips (weights/v0.1/*.pth)"
)
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # ImageNet statistics of images in [-1, 1]
EPSILON = 1e-10  # added to the norm of features
HEADS = 5


@dataclass(frozen=True)
class Network:
    """Convolutional network.

    Attributes:
        name: Name in results.
        layers: Layers in torchvision's order: output channels, kernel, stride and padding of a convolution, each with a
            ReLU behind it, or kernel and stride of a maximum pooling.
        taps: Positions of the convolutions whose features are compared.
    """

    name: str
    layers: tuple[tuple[int, ...], ...]
    taps: tuple[int, ...]

    @property
    def convolutions(self) -> list[tuple[int, tuple[int, ...], tuple[int, ...]]]:
        """Position in torchvision's list, layer and shape of the kernel of each convolution."""
        found, position, channels = [], 0, 3
        for layer in self.layers:
            if len(layer) == 4:
                found.append((position, layer, (layer[0], channels, layer[1], layer[1])))
                channels = layer[0]
            position += 2 if len(layer) == 4 else 1
        return found

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each tensor by its name."""
        found: dict[str, tuple[int, ...]] = {}
        channels = []
        for k, (position, layer, shape) in enumerate(self.convolutions):
            found[f"features.{position}.weight"], found[f"features.{position}.bias"] = shape, shape[:1]
            if k in self.taps:
                channels.append(layer[0])
        return found | {f"lin{k}.weight": (1, count, 1, 1) for k, count in enumerate(channels)}


_POOL2, _POOL3 = (2, 2), (3, 2)
_VGG = [(64,) * 2, (128,) * 2, (256,) * 3, (512,) * 3, (512,) * 3]
NETWORKS = {
    "alex": Network(
        "alex",
        (
            *((64, 11, 4, 2), _POOL3, (192, 5, 1, 2), _POOL3),
            *((384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)),
        ),
        (0, 1, 2, 3, 4),
    ),
    "vgg": Network(
        "vgg",
        tuple(layer for block in _VGG for layer in (*((count, 3, 1, 1) for count in block), _POOL2))[:-1],
        (1, 3, 6, 9, 12),
    ),
}


class Lpips:
    """LPIPS 0.1 with given weights.

    Args:
        network: The network.
        tensors: Its tensors by the names of `Network.shapes`.
    """

    def __init__(self, network: Network, tensors: Tensors):
        self.name = network.name
        self._network, self._tensors = network, tensors

    @torch.no_grad()
    def distance(self, image: np.ndarray, truth: np.ndarray) -> float:
        """Return the distance of two images, 0 for equal ones.

        Args:
            image: Display-referred sRGB in [0, 1]. [H, W, 3]
            truth: The same.

        Source: Zhang et al. 2018, Eq. 1, with images scaled to [-1, 1].
        """
        if image.shape != truth.shape or image.ndim != 3:
            raise ValueError(f"expected two images [H, W, 3] of one size, got {image.shape} and {truth.shape}")
        pair = torch.from_numpy(np.stack([image, truth]).astype(np.float32)).permute(0, 3, 1, 2)
        pair = (2 * pair - 1 - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]
        total = 0.0
        for k, features in enumerate(self._features(pair)):
            unit = features / (features.square().sum(1, keepdim=True).sqrt() + EPSILON)
            difference = (unit[:1] - unit[1:]).square()
            total += float(functional.conv2d(difference, self._tensors[f"lin{k}.weight"]).mean())
        return total

    def _features(self, pair: torch.Tensor) -> Iterable[torch.Tensor]:
        """Yield the compared features of two images. [2, C, h, w] each"""
        position = number = 0
        for layer in self._network.layers:
            if len(layer) == 2:
                pair = functional.max_pool2d(pair, layer[0], layer[1])
                position += 1
                continue
            weight, bias = (self._tensors[f"features.{position}.{kind}"] for kind in ("weight", "bias"))
            pair = functional.conv2d(pair, weight, bias, stride=layer[2], padding=layer[3]).relu()
            if number in self._network.taps:
                yield pair
            position, number = position + 2, number + 1


def load(paths: Iterable[Path]) -> Lpips:
    """Read the weights of LPIPS from files, ``.safetensors`` or state dictionaries of torch.

    Raises:
        BackendError: A file is missing or damaged, or tensors are missing or have the wrong shape.
    """
    found: Tensors = {}
    paths = list(paths)
    for path in paths:
        found |= {_renamed(name): tensor for name, tensor in _read(path).items()}
    place = ", ".join(str(path) for path in paths)
    first = found.get("features.0.weight")
    network = next(
        (n for n in NETWORKS.values() if first is not None and n.shapes["features.0.weight"] == first.shape), None
    )
    if network is None:
        what = "no 'features.0.weight'" if first is None else f"'features.0.weight' of shape {tuple(first.shape)}"
        raise errors.BackendError(f"--lpips {place}: expected AlexNet or VGG16, found {what}; {REMEDY}")
    for name, shape in network.shapes.items():
        if name not in found or tuple(found[name].shape) != shape:
            what = "nothing" if name not in found else f"shape {tuple(found[name].shape)}"
            raise errors.BackendError(f"--lpips {place}: expected {name!r} of shape {shape}, found {what}; {REMEDY}")
    tensors = {name: found[name].float() for name in network.shapes}
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
        raise errors.BackendError(
            f"--lpips {place}: expected finite weights, found NaN or infinity; copy the files again"
        )
    return Lpips(network, tensors)


def _renamed(name: str) -> str:
    """Return the name of a tensor as in `Network.shapes`, from names of torchvision or of the package lpips."""
    name = re.sub(r"^net\.slice\d\.(\d+)\.", r"features.\1.", name)
    return re.sub(r"^lins?\.?(\d)\.model\.1\.", r"lin\1.", name)


def _read(path: Path) -> Tensors:
    try:
        if path.suffix.lower() == ".safetensors":
            with extras.required("LPIPS weights in safetensors", "encoders"):
                from safetensors.torch import load_file
            content = load_file(path)
        else:
            content = torch.load(path, map_location="cpu", weights_only=True)
    except errors.BackendError:
        raise
    except Exception as error:  # the libraries raise many types for damaged files
        reason = getattr(error, "strerror", None) or "not a file of tensors without code"
        raise errors.BackendError(f"--lpips {path}: cannot be read ({reason}); {REMEDY}") from error
    if not isinstance(content, dict) or not all(isinstance(value, torch.Tensor) for value in content.values()):
        raise errors.BackendError(f"--lpips {path}: expected tensors by name, found other content; {REMEDY}")
    return content
