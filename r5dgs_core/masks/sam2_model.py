"""SAM2 from a local folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from . import sam_model


class Sam2(sam_model.SamModel):
    """SAM2 networks of a transformers folder: see `SamModel`.

    Attributes:
        image: `transformers.Sam2Model`, which segments images.
        video: `transformers.Sam2VideoModel`.
    """

    FAMILY = "SAM2"
    KIND = "sam2_video"
    FILES = "config.json and model.safetensors"
    OTHER_KINDS = {"sam2": "a folder of the image model alone cannot follow objects"}
    MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet statistics

    @classmethod
    def _import(cls) -> Any:
        import transformers

        _ = transformers.Sam2VideoModel, transformers.Sam2Model
        return transformers

    def _load(self, transformers: Any, folder: Path) -> None:
        self.video = sam_model.load(transformers.Sam2VideoModel, folder).to(self.device)
        self.image = sam_model.load(transformers.Sam2Model, folder).to(self.device)
