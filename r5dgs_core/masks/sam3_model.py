"""SAM3 from a local folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from .. import errors
from ..language.encoders import encoder_base
from . import sam_model
from .sam2_model import Sam2

LICENCE = "the SAM License of Meta, which forbids some uses"
TOKENS = 32  # length of a phrase


class Sam3(sam_model.SamModel):
    """SAM3 network of a transformers folder, with its tokenizer: see `SamModel`.

    Attributes:
        video: `transformers.Sam3VideoModel`.
    """

    FAMILY = "SAM3"
    KIND = "sam3_video"
    FILES = "config.json, model.safetensors and tokenizer.json"
    OTHER_KINDS = {Sam2.KIND: "use it with --backend sam2"}
    MEAN, DEVIATION = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)

    @classmethod
    def _import(cls) -> Any:
        import transformers
        from transformers.models.sam3_video import modeling_sam3_video

        _ = transformers.Sam3VideoModel
        modeling_sam3_video.cv_utils_kernel = False  # pyright: ignore  # else it is downloaded if `kernels` is installed
        return transformers

    def _load(self, transformers: Any, folder: Path) -> None:
        self.video = sam_model.load(transformers.Sam3VideoModel, folder).to(self.device)
        self._tokenizer = _tokenizer(transformers, folder)

    def tokens(self, phrase: str) -> tuple[Tensor, Tensor]:
        """Return the tokens of a phrase and their attention mask. [1, T], [1, T]"""
        found = self._tokenizer(
            phrase, return_tensors="pt", padding="max_length", max_length=TOKENS, truncation=True
        ).to(self.device)
        return found.input_ids, found.attention_mask


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
