"""Masks by SAM3: objects that are named by phrases, found and tracked through each video.

A phrase names one object of the scene, so that its id is the same in all videos. If several things in a video fit a
phrase, the one with the largest sum of scores over the images is the object, and the pixels of the others are unknown.
"""

from __future__ import annotations

import collections
import dataclasses
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..data import mask_notes, masks
from . import sam2_segments, sam2_tracking
from .sam3_model import Sam3
from .videos import Video

_log = logging.getLogger(__name__)


class Sam3Masks:
    """Mask backend that uses SAM3.

    Args:
        model: The model.
        words: Phrases; phrase k has id k + 1.

    Attributes:
        own_names: Phrases by id.
    """

    name, numbering = "sam3", mask_notes.SCENE

    def __init__(self, model: Sam3, words: Sequence[str]):
        self.model = model
        self.own_names: Path | Mapping[int, str] | None = dict(enumerate(words, 1))
        self._words = tuple(words)
        self.made_with: dict[str, Any] = {"model": model.name, "weights": model.digest, "words": list(words)}

    def label(self, video: Video, room: Path, report: Callable[[float], None]) -> Iterator[np.ndarray | None]:
        """Implement `make_masks.MaskBackend.label`."""
        camera = video.views[0].camera
        canvas = sam2_tracking.Canvas(len(video.views), camera.height, camera.width, room)
        try:
            found = self._paint(video, canvas, report)
            table = self._ids(video, found)
            for index in range(len(video.views)):
                yield table[canvas.ids[index]]
        finally:
            canvas.close()

    def _paint(self, video: Video, canvas: sam2_tracking.Canvas, report: Callable[[float], None]) -> dict[int, _Track]:
        """Paint the tracks, numbered from 1, and return them."""
        tracks: dict[int, _Track] = collections.defaultdict(_Track)
        for count, (index, words, logits, scores) in enumerate(_follow(self.model, video, self._words)):
            if words:
                full = sam2_segments.full_size(torch.stack(list(logits.values())), canvas.ids.shape[1:]).cpu().numpy()
                canvas.paint(index, [track + 1 for track in logits], full)
                for track, mask in zip(logits, full, strict=True):
                    seen = float((mask > 0).any()) * scores[track]
                    before = tracks[track + 1]
                    tracks[track + 1] = dataclasses.replace(before, word=words[track], weight=before.weight + seen)
            report((count + 1) / len(video.views))
        return tracks

    def _ids(self, video: Video, found: dict[int, _Track]) -> np.ndarray:
        """Return the id of each track. [tracks + 1] int32"""
        table = np.zeros(max(found, default=0) + 1, np.int32)
        table[1:] = masks.UNKNOWN
        for word, object_id in ((word, object_id) for object_id, word in enumerate(self._words, 1)):
            same = [track for track, one in found.items() if one.word == object_id - 1]
            if same:
                table[max(same, key=lambda track: found[track].weight)] = object_id
            if len(same) > 1:
                _log.warning(
                    "%s: %d things fit %r; one has its name, the others are unknown. Name them apart, such as "
                    "'left %s'",
                    video.name,
                    len(same),
                    word,
                    word,
                )
        return table


@dataclasses.dataclass(frozen=True)
class _Track:
    """Track of one thing.

    Attributes:
        word: Index of the phrase that it fits.
        weight: Sum of its scores over the images that show it.
    """

    word: int = 0
    weight: float = 0.0


@torch.inference_mode()
def _follow(
    model: Sam3, video: Video, words: Sequence[str]
) -> Iterator[tuple[int, dict[int, int], dict[int, torch.Tensor], dict[int, float]]]:
    """Find and track the things that the phrases name.

    Yields:
        Index of an image, and by track: index of the phrase, logits [s, s], score.
    """
    from transformers.models.sam3_video.modeling_sam3_video import Sam3VideoInferenceSession

    camera = video.views[0].camera
    state = Sam3VideoInferenceSession(
        video=None,
        video_height=camera.height,
        video_width=camera.width,
        inference_device=model.device,
        inference_state_device=model.device,
        video_storage_device=model.device,
        dtype=torch.float32,  # pyright: ignore[reportArgumentType]
    )
    state.processed_frames = sam2_tracking.Frames(model, video)  # pyright: ignore[reportAttributeAccessIssue]
    for word in words:
        prompt = state.add_prompt(word)
        state.prompt_input_ids[prompt], state.prompt_attention_masks[prompt] = model.tokens(word)
    config = model.video.config
    tracker = config.tracker_config
    kept = max(tracker.num_maskmem, tracker.max_object_pointers_in_encoder, config.hotstart_delay) + 1
    for out in model.video.propagate_in_video_iterator(state):
        hidden = set(out.suppressed_obj_ids or ()) | state.hotstart_removed_obj_ids
        shown = [track for track in out.obj_id_to_mask if track not in hidden]
        logits = {track: out.obj_id_to_mask[track][0] for track in shown}
        scores = {track: float(out.obj_id_to_score.get(track, 0.0)) for track in shown}
        yield out.frame_idx, {track: state.obj_id_to_prompt_id[track] for track in shown}, logits, scores
        for outputs in state.output_dict_per_obj.values():  # later images do not attend to these
            for index in [index for index in outputs["non_cond_frame_outputs"] if index < out.frame_idx - kept]:
                del outputs["non_cond_frame_outputs"][index]
