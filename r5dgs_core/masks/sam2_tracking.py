"""Object tracking through a video with SAM2: objects marked in one image are followed to both ends and painted.

Each object is tracked on its own, so masks overlap; a pixel goes to the object with the largest logit.

Notation: M objects, masks of s x s from the network, images of H x W pixels.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ..data import masks
from .sam2_model import Sam2
from .sam2_segments import full_size
from .videos import Video

HEAVY = ("maskmem_features", "maskmem_pos_enc")  # the network's memory of an image, a megabyte per object


class Network(Protocol):
    """Network with its own input size."""

    def pixels(self, image: np.ndarray) -> Tensor:
        """Convert an RGB image [H, W, 3] uint8 to network input. [1, 3, S, S]"""
        ...


class Frames(Mapping):
    """Images of a video as network input, read on demand; the last one is cached.

    Args:
        model: The model.
        video: The video.
    """

    def __init__(self, model: Network, video: Video):
        self._model, self._video = model, video
        self._last: tuple[int, Tensor] | None = None

    def __getitem__(self, index: int) -> Tensor:
        if not 0 <= index < len(self):
            raise KeyError(index)
        if self._last is None or self._last[0] != index:
            self._last = index, self._model.pixels(self._video.image(index))[0]
        return self._last[1]

    def __len__(self) -> int:
        return len(self._video.views)

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self)))


@torch.inference_mode()
def follow(model: Sam2, frames: Frames, key: int, marked: Tensor) -> Iterator[tuple[int, Tensor]]:
    """Track objects from one image of a video to its end, then to its beginning.

    Only the past images that the network attends to are remembered, so memory does not grow with the video.

    Args:
        key: Index of the image in which the objects are marked.
        marked: Their logits in it, above 0 inside the objects. [M, s, s]

    Yields:
        Index of an image and the objects' logits in it, above 0 inside the objects [M, s, s]; the marked image first,
        each image once.
    """
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    state = Sam2VideoInferenceSession(
        video=None,
        inference_device=model.device,
        inference_state_device=model.device,
        video_storage_device=model.device,
        dtype=torch.float32,
    )
    state.processed_frames = frames  # pyright: ignore[reportAttributeAccessIssue]  # used like a dict
    for k, logits in enumerate(marked):
        mask = full_size(logits[None], (model.size, model.size)) > 0
        state.add_mask_inputs(state.obj_id_to_idx(k), key, mask[None].float())
    state.obj_with_new_inputs = list(range(len(marked)))
    config = model.video.config
    seen_back, pointed_back = config.num_maskmem, config.max_object_pointers_in_encoder
    yield key, model.video(inference_session=state, frame_idx=key).pred_masks[:, 0]
    for step in (1, -1):
        for objects in state.output_dict_per_obj.values():
            objects["non_cond_frame_outputs"].clear()  # outputs of the other direction
        for index in range(key + step, len(frames) if step > 0 else -1, step):
            found = model.video(inference_session=state, frame_idx=index, reverse=step < 0)
            for objects in state.output_dict_per_obj.values():
                _forget(objects["non_cond_frame_outputs"], index, step, seen_back, pointed_back)
            yield index, found.pred_masks[:, 0]


def _forget(outputs: dict[int, dict], index: int, step: int, seen_back: int, pointed_back: int) -> None:
    """Drop outputs that no later image of this direction attends to."""
    for name in ("high_res_masks", "pred_masks"):
        outputs[index].pop(name, None)
    if (old := outputs.get(index - step * seen_back)) is not None:
        for name in HEAVY:
            old.pop(name, None)
    outputs.pop(index - step * pointed_back, None)


class Canvas:
    """Object id and its logit for each pixel of a video, in temporary files.

    Args:
        count: Number of images.
        height: Height of the images, pixels.
        width: Width of the images, pixels.
        folder: Folder with space for four bytes per pixel.
    """

    def __init__(self, count: int, height: int, width: int, folder: Path):
        shape = (count, height, width)
        self._files = [tempfile.TemporaryFile(dir=folder) for _ in range(2)]  # noqa: SIM115  # closed by `close`
        self.ids = np.memmap(self._files[0], np.uint16, "w+", shape=shape)
        self._sure = np.memmap(self._files[1], np.float16, "w+", shape=shape)

    def paint(self, index: int, ids: Sequence[int], logits: np.ndarray) -> None:
        """Give each pixel of an image to the object with the largest logit, unless an earlier object's is as large.

        Args:
            ids: Ids of the objects. (M,)
            logits: Above 0 inside the objects. [M, H, W]
        """
        best = logits.argmax(0)
        sure = np.take_along_axis(logits, best[None], 0)[0].astype(np.float16)
        better = sure > self._sure[index]  # initially 0
        self.ids[index][better] = np.asarray(ids, np.uint16)[best[better]]
        self._sure[index][better] = sure[better]

    def mark_gaps(self, longest: int) -> None:
        """Mark background pixels as unknown in images that lack an object of earlier and later images.

        The object may be hidden by something that is not an object, or lost by the tracker.

        Args:
            longest: Number of images of the longest gap to mark; in longer gaps the object may have left.
        """
        last: dict[int, int] = {}
        for index in range(len(self.ids)):
            for object_id in np.unique(self.ids[index]).tolist():
                if object_id in (0, masks.UNKNOWN):
                    continue
                before = last.get(object_id, index - 1)
                last[object_id] = index
                if not 1 < index - before <= longest + 1:
                    continue
                place = (self.ids[before] == object_id) | (self.ids[index] == object_id)
                for between in range(before + 1, index):
                    self.ids[between][place & (self.ids[between] == 0)] = masks.UNKNOWN

    def close(self) -> None:
        """Delete the temporary files."""
        del self.ids, self._sure
        for file in self._files:
            file.close()
