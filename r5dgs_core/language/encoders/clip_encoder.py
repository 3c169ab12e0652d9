"""CLIP and SigLIP encoders by transformers, without torchvision: text and images in one embedding space."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ... import errors, extras
from ...scene.lookup_table import EncoderCard
from . import encoder_base

TEMPLATES = ("{}", "a photo of a {}", "a render of a {}")


def detect(folder: Path) -> bool:
    """Return True if a folder holds a CLIP or SigLIP model of transformers."""
    return encoder_base.model_type(folder) in ("clip", "siglip")


def load(folder: Path) -> ClipEncoder:
    """Load the encoder of a folder. Raises `BackendError`."""
    return ClipEncoder(folder, str(encoder_base.model_type(folder)))


class ClipEncoder(encoder_base.BatchEncoder):
    """CLIP or SigLIP model of a folder.

    Args:
        folder: Folder with config.json, model.safetensors, a tokenizer and preprocessor_config.json.
        kind: "clip" or "siglip".
    """

    def __init__(self, folder: Path, kind: str):
        with extras.required("encoder", "encoders"):
            import torch
            from transformers import AutoImageProcessor, AutoModel, AutoTokenizer
        encoder_base.quieten()
        self._torch = torch
        encoder_base.read_json(folder / "preprocessor_config.json")
        paths = encoder_base.weights_of(folder)
        try:
            self._tokenizer = AutoTokenizer.from_pretrained(str(folder), **encoder_base.LOADING)
            self._processor = AutoImageProcessor.from_pretrained(str(folder), **encoder_base.LOADING, backend="pil")
            self._model, info = AutoModel.from_pretrained(
                str(folder), **encoder_base.LOADING, use_safetensors=True, output_loading_info=True
            )
        except Exception as error:  # a damaged folder raises many types
            raise errors.BackendError(f"{folder}: cannot be loaded: {error}; copy the model again") from error
        encoder_base.check_loaded(folder, info)
        encoder_base.check_words(folder, self._tokenizer)
        self._model.eval()
        self._longest = int(self._model.config.text_config.max_position_embeddings)
        # SigLIP was trained on texts of one length and attends to padding.
        self._padding: Any = "max_length" if kind == "siglip" else True
        self._inputs = ("input_ids",) if kind == "siglip" else ("input_ids", "attention_mask")
        dimension = self._texts(["object"]).shape[1]
        digest = encoder_base.digest_of(paths)
        self.card = EncoderCard(kind, folder.name, digest, dimension, TEMPLATES, encoder_base.SCALE)

    def _texts(self, texts: Sequence[str]) -> np.ndarray:
        tokens = self._tokenizer(
            list(texts), padding=self._padding, truncation=True, max_length=self._longest, return_tensors="pt"
        )
        with self._torch.no_grad():
            return _pooled(self._model.get_text_features(**{name: tokens[name] for name in self._inputs}))

    def _images(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        from ...data import images  # imported here, as text needs no OpenImageIO

        pixels = self._processor(images=[images.to_uint8(each) for each in pictures], return_tensors="pt")
        with self._torch.no_grad():
            return _pooled(self._model.get_image_features(pixel_values=pixels["pixel_values"]))


def _pooled(features: Any) -> np.ndarray:
    """Features returned by transformers: the field ``pooler_output``, or the tensor itself before version 5."""
    return getattr(features, "pooler_output", features).float().numpy()
