"""CLIP and SigLIP by transformers, without torchvision: words and pictures in one space."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors
from ..scene.lookup_table import EncoderCard
from . import encoders

TEMPLATES = ("{}", "a photo of a {}", "a render of a {}")
_BATCH = 16


class ClipEncoder:
    """A CLIP or SigLIP model of a folder.

    Args:
        folder: With config.json, model.safetensors, a tokenizer and preprocessor_config.json.
        kind: "clip" or "siglip".
    """

    def __init__(self, folder: Path, kind: str):
        try:
            import torch
            from transformers import AutoImageProcessor, AutoModel, AutoTokenizer
        except ImportError as error:
            raise encoders.missing_package(error) from error
        encoders.quieten()
        self._torch = torch
        encoders.read_json(folder / "preprocessor_config.json")
        paths = encoders.weights_of(folder)
        try:
            self._tokenizer = AutoTokenizer.from_pretrained(str(folder), **encoders.LOADING)
            self._processor = AutoImageProcessor.from_pretrained(str(folder), **encoders.LOADING, backend="pil")
            self._model, info = AutoModel.from_pretrained(
                str(folder), **encoders.LOADING, use_safetensors=True, output_loading_info=True
            )
        except Exception as error:  # whatever a damaged folder makes of it
            raise errors.BackendError(f"{folder}: cannot be loaded: {error}; copy the model again") from error
        encoders.check_loaded(folder, info)
        encoders.check_words(folder, self._tokenizer)
        self._model.eval()
        self._longest = int(self._model.config.text_config.max_position_embeddings)
        # SigLIP was trained on texts of one length, and looks at their padding.
        self._padding: Any = "max_length" if kind == "siglip" else True
        self._inputs = ("input_ids",) if kind == "siglip" else ("input_ids", "attention_mask")
        dimension = self._texts(["object"]).shape[1]
        digest = encoders.digest_of(paths)
        self.card = EncoderCard(kind, folder.name, digest, dimension, TEMPLATES, encoders.SCALE)

    def embed_texts(self, texts: Sequence[str]) -> np.ndarray:
        """See `encoders.Encoder`."""
        return encoders.in_batches(texts, _BATCH, self._texts, self.card.dimension)

    def embed_images(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """See `encoders.Encoder`."""
        return encoders.in_batches(pictures, _BATCH, self._images, self.card.dimension)

    def _texts(self, texts: Sequence[str]) -> np.ndarray:
        tokens = self._tokenizer(
            list(texts), padding=self._padding, truncation=True, max_length=self._longest, return_tensors="pt"
        )
        with self._torch.no_grad():
            return _pooled(self._model.get_text_features(**{name: tokens[name] for name in self._inputs}))

    def _images(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        from ..data import images  # here, as OpenImageIO is not needed for words

        pixels = self._processor(images=[images.to_uint8(each) for each in pictures], return_tensors="pt")
        with self._torch.no_grad():
            return _pooled(self._model.get_image_features(pixel_values=pixels["pixel_values"]))


def _pooled(features: Any) -> np.ndarray:
    """Rows of what transformers returns: an output with ``pooler_output``, a tensor before its version 5."""
    return getattr(features, "pooler_output", features).float().numpy()
