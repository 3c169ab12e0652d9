"""SAM2 from a local folder, using the classes of transformers, without torchvision.

The folder provides both networks: the image segmenter (`image`) and the video tracker (`video`). Nothing is downloaded,
and missing weights are an error instead of being initialised at random.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .. import errors, extras
from ..language.encoders import encoder_base

KIND = "sam2_video"
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet statistics, used to train SAM2


class Sam2:
    """SAM2 networks of a folder.

    Args:
        folder: A transformers folder with ``config.json`` of model type ``sam2_video`` and ``.safetensors``.
        device: "cpu" or "cuda", also "cuda:1".

    Raises:
        BackendError: The folder or the device cannot be used, or transformers is not installed.

    Attributes:
        image: `transformers.Sam2Model`.
        video: `transformers.Sam2VideoModel`.
        size: Side of the square input images, pixels.
        device: Device of the networks.
        name: Name of the folder.
        digest: Hash of the weights.
    """

    def __init__(self, folder: Path, device: str = "cpu"):
        self.device = device_of(device)
        folder = Path(folder)
        transformers = _transformers()
        _check(folder)
        weights = encoder_base.weights_of(folder)
        with quiet(transformers):
            self.video = load(transformers.Sam2VideoModel, folder).to(self.device)
            self.image = load(transformers.Sam2Model, folder).to(self.device)
        size = self.video.config.image_size
        self.size = int(size if isinstance(size, int) else max(size))
        self.name = folder.resolve().name
        self.digest = encoder_base.digest_of(weights)

    def pixels(self, image: np.ndarray) -> Tensor:
        """Convert an RGB image [H, W, 3] uint8 to network input. [1, 3, S, S]"""
        tensor = torch.from_numpy(np.ascontiguousarray(image)).to(self.device).permute(2, 0, 1)[None].float() / 255
        size = (self.size, self.size)
        tensor = F.interpolate(tensor, size, mode="bilinear", antialias=True, align_corners=False)
        mean, deviation = (tensor.new_tensor(values)[:, None, None] for values in (MEAN, DEVIATION))
        return (tensor - mean) / deviation


def device_of(name: str) -> torch.device:
    """Return the device of ``--device``; BackendError if it is unknown or missing."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise errors.BackendError(f"--device {name}: expected cpu or cuda") from error
    if device.type not in ("cpu", "cuda"):
        raise errors.BackendError(f"--device {name}: expected cpu or cuda")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise errors.BackendError(f"--device {name}: this machine or this torch has no CUDA; use --device cpu")
    return device


def _transformers() -> Any:
    try:
        with extras.required("SAM2 (transformers 5 or later)", "encoders", also=(AttributeError,)):
            import safetensors  # noqa: F401  # transformers imports it only on loading
            import transformers

            _ = transformers.Sam2VideoModel, transformers.Sam2Model
    except RuntimeError as error:  # transformers imports other installed packages
        raise errors.BackendError(
            f"transformers cannot be imported ({error}). Remedy: if the installed torchvision does not fit "
            "torch, remove it, as it is not needed: pip uninstall torchvision"
        ) from error
    return transformers


def _check(folder: Path) -> None:
    """Raise BackendError if a folder cannot hold SAM2, judged without loading the weights."""
    wanted = "expected a folder of SAM2 as transformers saves it, with config.json and model.safetensors"
    if not folder.is_dir():
        raise errors.BackendError(f"{folder}: {wanted}, found {'a file' if folder.exists() else 'nothing'}")
    path = folder / "config.json"
    kind = encoder_base.read_json(path, "SAM2").get("model_type")
    if kind != KIND:
        remedy = "; a folder of the image model alone cannot follow objects" if kind == "sam2" else ""
        raise errors.BackendError(f"{path}: expected a model of type {KIND!r}, found {kind!r}{remedy}")


def load(kind: Any, folder: Path) -> Any:
    """Load one network for inference, with all weights from the folder."""
    try:
        model, found = kind.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, output_loading_info=True, dtype=torch.float32
        )
    except Exception as error:  # the library raises many types for damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise errors.BackendError(
            f"{folder}: the model cannot be loaded ({reason[:300]}); a file may be damaged: download it again"
        ) from error
    encoder_base.check_loaded(folder, found)
    return model.eval().requires_grad_(False)


@contextlib.contextmanager
def quiet(transformers: Any) -> Iterator[None]:
    """Silence the library's progress bars and its warning that one folder serves two networks."""
    log = transformers.utils.logging
    level, bars = log.get_verbosity(), log.is_progress_bar_enabled()
    log.set_verbosity_error()
    log.disable_progress_bar()
    try:
        yield
    finally:
        log.set_verbosity(level)
        if bars:
            log.enable_progress_bar()
