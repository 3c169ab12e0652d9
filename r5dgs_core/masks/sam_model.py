"""Base of the SAM networks from a local folder, which the classes of transformers load without torchvision.

Nothing is downloaded, and missing weights are an error instead of being initialised at random.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .. import errors, extras
from ..language.encoders import encoder_base


class SamModel:
    """Networks of a transformers folder. Subclasses set the class variables and load their networks.

    Args:
        folder: Folder with ``config.json``, the weights and the other files of `FILES`.
        device: "cpu" or "cuda", also "cuda:1".

    Raises:
        BackendError: The folder or the device cannot be used, or transformers is not installed or too old.

    Attributes:
        video: Network that follows objects.
        size: Side of the square input images, pixels.
        device: Device of the networks.
        name: Name of the folder.
        digest: Hash of the weights.
    """

    FAMILY: ClassVar[str]  # as in messages
    KIND: ClassVar[str]  # model type in config.json
    FILES: ClassVar[str]
    OTHER_KINDS: ClassVar[Mapping[str, str]]  # remedies for other model types
    MEAN: ClassVar[tuple[float, float, float]]  # of the channels in training
    DEVIATION: ClassVar[tuple[float, float, float]]

    video: Any

    def __init__(self, folder: Path, device: str = "cpu"):
        folder = Path(folder)
        self.device = _device(device)
        transformers = self._transformers()
        self._check(folder)
        weights = encoder_base.weights_of(folder)
        with _quiet(transformers):
            self._load(transformers, folder)
        size = self.video.config.image_size
        self.size = int(size if isinstance(size, int) else max(size))
        self.name = folder.resolve().name
        self.digest = encoder_base.digest_of(weights)

    def _load(self, transformers: Any, folder: Path) -> None:
        """Set `video` and other networks."""
        raise NotImplementedError

    @classmethod
    def _import(cls) -> Any:
        """Import transformers and the needed classes, and return it. AttributeError if it is too old."""
        raise NotImplementedError

    def pixels(self, image: np.ndarray) -> Tensor:
        """Convert an RGB image [H, W, 3] uint8 to network input. [1, 3, S, S]"""
        tensor = torch.from_numpy(np.ascontiguousarray(image)).to(self.device).permute(2, 0, 1)[None].float() / 255
        size = (self.size, self.size)
        tensor = F.interpolate(tensor, size, mode="bilinear", antialias=True, align_corners=False)
        mean, deviation = (tensor.new_tensor(values)[:, None, None] for values in (self.MEAN, self.DEVIATION))
        return (tensor - mean) / deviation

    @classmethod
    def _transformers(cls) -> Any:
        try:
            with extras.required(f"{cls.FAMILY} (transformers 5 or later)", "encoders", also=(AttributeError,)):
                import safetensors  # noqa: F401  # transformers imports it only on loading

                return cls._import()
        except RuntimeError as error:  # transformers imports other installed packages
            raise errors.BackendError(
                f"transformers cannot be imported ({error}). Remedy: if the installed torchvision does not fit "
                "torch, remove it, as it is not needed: pip uninstall torchvision"
            ) from error

    @classmethod
    def _check(cls, folder: Path) -> None:
        """Raise BackendError if a folder cannot hold the networks, judged without loading the weights."""
        if not folder.is_dir():
            raise errors.BackendError(
                f"{folder}: expected a folder of {cls.FAMILY} as transformers saves it, with {cls.FILES}, "
                f"found {'a file' if folder.exists() else 'nothing'}"
            )
        path = folder / "config.json"
        kind = encoder_base.read_json(path, cls.FAMILY).get("model_type")
        if kind != cls.KIND:
            remedy = cls.OTHER_KINDS.get(str(kind), "")
            raise errors.BackendError(
                f"{path}: expected a model of type {cls.KIND!r}, found {kind!r}{remedy and '; ' + remedy}"
            )


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


def _device(name: str) -> torch.device:
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


@contextlib.contextmanager
def _quiet(transformers: Any) -> Iterator[None]:
    """Silence the library's progress bars and its warning that one folder serves several networks."""
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
