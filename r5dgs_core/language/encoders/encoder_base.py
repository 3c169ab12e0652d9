"""Protocol and helpers of text and image encoders; `registry` opens them.

Weights are only read from a folder that the user names. A damaged or incomplete folder is an error: missing weights are
never initialised at random.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ... import errors, extras, strict_json
from ...scene.lookup_table import EncoderCard

CANONICAL = ("object", "things", "stuff", "texture")  # phrases of LERF
SCALE = 10.0  # of LERF
LOADING = {"local_files_only": True, "trust_remote_code": False}  # neither run a folder's code nor prompt for it
_ARTICLE = re.compile(r"^(?:an?|the)\s+", re.IGNORECASE)


class Encoder(Protocol):
    """Encoder of phrases, and of images if it supports them, to unit vectors of one space.

    Attributes:
        card: Description of the encoder.
    """

    card: EncoderCard

    def embed_texts(self, texts: Sequence[str]) -> np.ndarray:
        """Embed texts verbatim, without templates. [n, D] float32, unit"""
        ...

    def embed_images(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """Embed images [H, W, 3], sRGB in [0, 1]. [n, D] float32, unit. Raises `BackendError` for text encoders."""
        ...


class BatchEncoder:
    """Base class of an `Encoder` that embeds in batches; subclasses set ``card`` and embed one batch.

    Attributes:
        batch_size: Maximum number of texts or images per batch.
    """

    card: EncoderCard
    batch_size = 16

    def embed_texts(self, texts: Sequence[str]) -> np.ndarray:
        """Implement `Encoder`."""
        return in_batches(texts, self.batch_size, self._texts, self.card.dimension)

    def embed_images(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """Implement `Encoder`."""
        return in_batches(pictures, self.batch_size, self._images, self.card.dimension)

    def _texts(self, texts: Sequence[str]) -> np.ndarray:
        """Embed one batch of texts. [n, D]"""
        raise NotImplementedError

    def _images(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """Embed one batch of images. [n, D]"""
        raise NotImplementedError


def embed_phrases(encoder: Encoder, phrases: Sequence[str]) -> np.ndarray:
    """Embed phrases, each as the mean over the encoder's templates. [n, D] float32, unit"""
    if not phrases:
        return np.zeros((0, encoder.card.dimension), np.float32)
    bare = [_ARTICLE.sub("", phrase.strip()) or phrase for phrase in phrases]
    total = sum(
        encoder.embed_texts([template.replace("{}", phrase) for phrase in bare]).astype(np.float64)
        for template in encoder.card.templates
    )
    return unit(np.asarray(total))


def in_batches(
    items: Sequence[Any], size: int, embed: Callable[[Sequence[Any]], np.ndarray], dimension: int
) -> np.ndarray:
    """Embed items in batches of ``size``. [n, D] float32, unit"""
    parts = [embed(items[start : start + size]) for start in range(0, len(items), size)]
    return unit(np.concatenate([np.zeros((0, dimension), np.float32), *parts]))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Normalise vectors to length 1, float32; zero stays zero. [..., D]"""
    wide = np.asarray(vectors, np.float64)
    norms = np.linalg.norm(wide, axis=-1, keepdims=True)
    return np.divide(wide, norms, out=np.zeros_like(wide), where=norms > 0).astype(np.float32)


def read_json(path: Path, of: str = "an encoder") -> dict[str, Any]:
    """Read a JSON object of a model's folder. Raises `BackendError`."""
    if not path.is_file():
        raise errors.BackendError(
            f"{path}: expected in the folder of {of}, found {what_is(path)}; download or copy the model again"
        )
    found = strict_json.read(path, errors.BackendError, "copy the model again")
    if not isinstance(found, dict):
        raise errors.BackendError(f"{path}: expected a JSON object, found {type(found).__name__}; copy the model again")
    return found


def weights_of(folder: Path, pattern: str = "model*.safetensors") -> list[Path]:
    """Return the weight files of a model, after checking that each can be opened. Raises `BackendError`."""
    with extras.required("encoder", "encoders"):
        import safetensors
    paths = sorted(folder.glob(pattern))
    if not paths:
        raise errors.BackendError(
            f"{folder / 'model.safetensors'}: expected the weights, found none; download the model's safetensors file "
            "(others, such as .bin, are not read)"
        )
    for path in paths:
        try:
            with safetensors.safe_open(str(path), framework="np") as archive:
                archive.keys()
        except Exception as error:  # safetensors has its own type; the system raises others
            raise errors.BackendError(
                f"{path}: expected safetensors, found a damaged or cut file ({error}); copy the model again"
            ) from error
    return paths


def digest_of(paths: Sequence[Path]) -> str:
    """SHA-256 of the concatenated contents of files."""
    found = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as stream:
            while block := stream.read(1 << 20):
                found.update(block)
    return found.hexdigest()


def quieten() -> None:
    """Silence transformers; this package checks and reports the relevant problems itself."""
    from transformers.utils import logging

    logging.disable_progress_bar()
    logging.set_verbosity_error()


def model_type(folder: Path) -> object:
    """Return ``model_type`` of a folder's config.json, or None if there is no such file. Raises `BackendError`."""
    path = folder / "config.json"
    return read_json(path).get("model_type") if path.is_file() else None


def check_loaded(folder: Path, info: dict[str, Any], unused: Sequence[str] = ()) -> None:
    """Raise `BackendError` if weights were missing or had wrong shapes, as they would be random.

    Args:
        folder: Folder, for the message.
        info: Loading info of transformers.
        unused: Prefixes of names to ignore.
    """
    absent = sorted(str(name) for name in info.get("missing_keys", ()) if not str(name).startswith(tuple(unused)))
    wrong = sorted(str(each[0] if isinstance(each, tuple) else each) for each in info.get("mismatched_keys", ()))
    for names, what in ((absent, "are missing"), (wrong, "have shapes that differ from config.json")):
        if names:
            raise errors.BackendError(
                f"{folder}: {len(names)} of the model's weights {what} ({names[0]}, ...); copy the model again, "
                "config.json and weights from the same place"
            )


def check_words(folder: Path, tokenizer: Any) -> None:
    """Raise `BackendError` if all words have the same tokens: without its files, the tokenizer is empty."""
    one, other = tokenizer(["lemon", "apple"])["input_ids"]  # of equal length, as each letter may be unknown
    if list(one) == list(other):
        raise errors.BackendError(
            f"{folder}: the tokenizer's vocabulary is missing; copy the model again with all files, "
            "including tokenizer.json"
        )


def what_is(path: Path) -> str:
    """Describe a path for messages: "a file", "a folder" or "nothing"."""
    return "a file" if path.is_file() else "a folder" if path.is_dir() else "nothing"
