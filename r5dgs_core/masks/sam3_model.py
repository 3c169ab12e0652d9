"""SAM3 from a local folder, using the classes of transformers, without torchvision.

Nothing is downloaded: missing weights are an error, and the kernels that transformers would fetch are disabled.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .. import errors, extras
from ..language.encoders import encoder_base
from . import sam2_model

KIND = "sam3_video"
LICENCE = "the SAM License of Meta, which forbids some uses"
MEAN, DEVIATION = 0.5, 0.5  # of all channels, as in the training of SAM3
TOKENS = 32  # length of a phrase


class Sam3:
    """SAM3 networks of a folder.

    Args:
        folder: A transformers folder with ``config.json`` of model type ``sam3_video``, weights and tokenizer.
        device: "cpu" or "cuda", also "cuda:1".

    Raises:
        BackendError: The folder or the device cannot be used, or transformers is not installed or too old.

    Attributes:
        video: `transformers.Sam3VideoModel`.
        size: Side of the square input images, pixels.
        device: Device of the networks.
        name: Name of the folder.
        digest: Hash of the weights.
    """

    def __init__(self, folder: Path, device: str = "cpu"):
        self.device = sam2_model.device_of(device)
        folder = Path(folder)
        transformers = _transformers()
        _check(folder)
        weights = encoder_base.weights_of(folder)
        with sam2_model.quiet(transformers):
            self.video = sam2_model.load(transformers.Sam3VideoModel, folder).to(self.device)
            self._tokenizer = _tokenizer(transformers, folder)
        size = self.video.config.image_size
        self.size = int(size if isinstance(size, int) else max(size))
        self.name = folder.resolve().name
        self.digest = encoder_base.digest_of(weights)

    def pixels(self, image: np.ndarray) -> Tensor:
        """Convert an RGB image [H, W, 3] uint8 to network input. [1, 3, S, S]"""
        tensor = torch.from_numpy(np.ascontiguousarray(image)).to(self.device).permute(2, 0, 1)[None].float() / 255
        tensor = F.interpolate(tensor, (self.size, self.size), mode="bilinear", antialias=True, align_corners=False)
        return (tensor - MEAN) / DEVIATION

    def tokens(self, phrase: str) -> tuple[Tensor, Tensor]:
        """Return the tokens of a phrase and their attention mask. [1, T], [1, T]"""
        found = self._tokenizer(
            phrase, return_tensors="pt", padding="max_length", max_length=TOKENS, truncation=True
        ).to(self.device)
        return found.input_ids, found.attention_mask


def _transformers() -> Any:
    with extras.required("SAM3 (transformers 5 or later)", "encoders", also=(AttributeError, RuntimeError)):
        import safetensors  # noqa: F401  # transformers imports it only on loading
        import transformers
        from transformers.models.sam3_video import modeling_sam3_video

        _ = transformers.Sam3VideoModel
        modeling_sam3_video.cv_utils_kernel = False  # pyright: ignore  # else it is downloaded if `kernels` is installed
    return transformers


def _check(folder: Path) -> None:
    """Raise BackendError if a folder cannot hold SAM3, judged without loading the weights."""
    wanted = (
        "expected a folder of SAM3 as transformers saves it, with config.json, model.safetensors and tokenizer.json"
    )
    if not folder.is_dir():
        raise errors.BackendError(f"{folder}: {wanted}, found {'a file' if folder.exists() else 'nothing'}")
    path = folder / "config.json"
    kind = encoder_base.read_json(path, "SAM3").get("model_type")
    if kind != KIND:
        remedy = "; use it with --backend sam2" if kind == sam2_model.KIND else ""
        raise errors.BackendError(f"{path}: expected a model of type {KIND!r}, found {kind!r}{remedy}")


def _tokenizer(transformers: Any, folder: Path) -> Any:
    try:
        tokenizer = transformers.AutoTokenizer.from_pretrained(str(folder), local_files_only=True)
    except Exception as error:  # the library raises many types for missing and damaged files
        reason = " ".join(str(error).split())[:200]
        raise errors.BackendError(
            f"{folder}: the tokenizer cannot be loaded ({reason}); copy the model again with all files"
        ) from error
    encoder_base.check_words(folder, tokenizer)
    return tokenizer
