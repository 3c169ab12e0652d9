"""Sentence encoders (MiniLM and similar models) by transformers; text only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ... import errors, extras
from ...scene.lookup_table import EncoderCard
from . import encoder_base

# Sentence models are trained on pairs of captions, so templates that are sentences separate objects better. Templates
# that mention a person or a hand would match persons and hands in every scene.
TEMPLATES = ("a photo of a {}", "A {} is in the picture.", "looking at a {}")
_TYPES = ("bert", "distilbert", "mpnet", "roberta", "xlm-roberta", "albert", "electra", "deberta-v2", "modernbert")
_POOLING = Path("1_Pooling") / "config.json"


def detect(folder: Path) -> bool:
    """Return True if a folder holds a sentence model."""
    return encoder_base.model_type(folder) in _TYPES


def load(folder: Path) -> SentenceEncoder:
    """Load the encoder of a folder. Raises `BackendError`."""
    return SentenceEncoder(folder)


class SentenceEncoder(encoder_base.BatchEncoder):
    """Sentence model of a folder: the mean of the last layer's tokens, or its first token, as configured there.

    Args:
        folder: Folder with config.json, model.safetensors and a tokenizer.
    """

    batch_size = 64

    def __init__(self, folder: Path):
        with extras.required("encoder", "encoders"):
            import torch
            from transformers import AutoModel, AutoTokenizer
        encoder_base.quieten()
        self._torch = torch
        config = encoder_base.read_json(folder / "config.json")
        paths = encoder_base.weights_of(folder)
        self._first = _takes_first(folder)
        try:
            self._tokenizer = AutoTokenizer.from_pretrained(str(folder), **encoder_base.LOADING)
            self._model, info = AutoModel.from_pretrained(
                str(folder), **encoder_base.LOADING, use_safetensors=True, output_loading_info=True
            )
        except Exception as error:  # a damaged folder raises many types
            raise errors.BackendError(f"{folder}: cannot be loaded: {error}; copy the model again") from error
        encoder_base.check_loaded(folder, info, unused=("pooler.",))
        encoder_base.check_words(folder, self._tokenizer)
        self._model.eval()
        self._longest = min(int(config.get("max_position_embeddings", 512)), 512) - 2
        dimension = int(self._model.config.hidden_size)
        name = folder.parent.name if folder.name == "model" else folder.name
        self.card = EncoderCard("text", name, encoder_base.digest_of(paths), dimension, TEMPLATES, encoder_base.SCALE)

    def embed_images(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """Raise `BackendError`, as sentence models embed text only."""
        raise errors.BackendError(
            f"encoder {self.card.name}: a sentence model cannot embed images; use a CLIP or SigLIP folder"
        )

    def _texts(self, texts: Sequence[str]) -> np.ndarray:
        tokens = self._tokenizer(
            list(texts), padding=True, truncation=True, max_length=self._longest, return_tensors="pt"
        )
        with self._torch.no_grad():
            states = self._model(**tokens).last_hidden_state.float()
        if self._first:
            return states[:, 0].numpy()
        present = tokens["attention_mask"][..., None].float()
        return ((states * present).sum(1) / present.sum(1).clamp(min=1)).numpy()


def _takes_first(folder: Path) -> bool:
    """Return True if the model pools by the first token, False for the mean of all tokens."""
    if not (folder / _POOLING).is_file():
        return False
    modes = {
        name for name, on in encoder_base.read_json(folder / _POOLING).items() if name.startswith("pooling_") and on
    }
    if modes - {"pooling_mode_mean_tokens", "pooling_mode_cls_token"} or len(modes) > 1:
        raise errors.BackendError(
            f"{folder / _POOLING}: expected pooling by the mean of tokens or by the first one, found "
            f"{', '.join(sorted(modes))}; use another sentence model"
        )
    return modes == {"pooling_mode_cls_token"}
