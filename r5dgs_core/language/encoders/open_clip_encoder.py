"""open_clip encoders, such as Meta's Perception Encoder. Needs the packages open_clip and torchvision."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ... import errors, extras
from ...scene.lookup_table import EncoderCard
from . import encoder_base
from .clip_encoder import TEMPLATES

CONFIG = "open_clip_config.json"


def detect(folder: Path) -> bool:
    """Return True if a folder holds an open_clip model."""
    return (folder / CONFIG).is_file()


def load(folder: Path) -> OpenClipEncoder:
    """Load the encoder of a folder. Raises `BackendError`."""
    return OpenClipEncoder(folder)


class OpenClipEncoder(encoder_base.BatchEncoder):
    """Model of a folder with open_clip_config.json and open_clip_model.safetensors.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path):
        config = encoder_base.read_json(folder / CONFIG)
        remedy = "install a torchvision that fits this torch; or use a CLIP or SigLIP folder of transformers"
        # A torchvision for another torch raises RuntimeError.
        with extras.required(f"{folder}", "open_clip", remedy, also=(RuntimeError,)):
            import open_clip
            import torch
        self._torch = torch
        paths = encoder_base.weights_of(folder, "open_clip_model*.safetensors")
        where = f"local-dir:{folder.resolve()}"
        try:
            self._model, self._preprocess = open_clip.create_model_from_pretrained(where)
            self._tokenizer = open_clip.get_tokenizer(where)
            dimension = int(config["model_cfg"]["embed_dim"])
        except Exception as error:  # a damaged folder raises many types
            raise errors.BackendError(f"{folder}: cannot be loaded: {error}; copy the model again") from error
        self._model.eval()
        digest = encoder_base.digest_of(paths)
        self.card = EncoderCard("open_clip", folder.name, digest, dimension, TEMPLATES, encoder_base.SCALE)

    def _texts(self, texts: Sequence[str]) -> np.ndarray:
        with self._torch.no_grad():
            return self._model.encode_text(self._tokenizer(list(texts)), normalize=True).float().numpy()

    def _images(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        from PIL import Image

        from ...data import images

        batch = [self._preprocess(Image.fromarray(images.to_uint8(each))) for each in pictures]
        with self._torch.no_grad():
            return self._model.encode_image(self._torch.stack(batch), normalize=True).float().numpy()
