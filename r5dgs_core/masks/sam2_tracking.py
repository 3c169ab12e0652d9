"""SAM2 through a video: objects that are marked in one image are followed to both ends, and painted over each other.

Each object is followed on its own, so masks overlap; a pixel goes to the object that is surest of it.

Notation: M objects, masks of s x s out of the network, images of H x W pixels.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..data import masks
from .sam2_model import Sam2
from .sam2_segments import full_size
from .videos import Video

HEAVY = ("maskmem_features", "maskmem_pos_enc")  # what the network remembers of an image, a megabyte per object


class Frames(Mapping):
    """Images of a video as the network takes them, read when they are asked for; the last one is kept.

    Args:
        model: The model.
        video: The video.
    """

    def __init__(self, model: Sam2, video: Video):
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
    """Follow objects from one image of a video to its end, then to its beginning.

    Of the images that lie behind only those are remembered that the network looks back at, so that memory does not
    grow with the video.

    Args:
        model: The model.
        frames: The images.
        key: Image in which the objects are marked.
        marked: Their logits there, above 0 where they are. [M, s, s]

    Yields:
        Index of an image and the objects' logits in it, above 0 where they are [M, s, s]; the marked one first, each
        image once.
    """
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    state = Sam2VideoInferenceSession(
        video=None,
        inference_device=model.device,
        inference_state_device=model.device,
        video_storage_device=model.device,
        dtype=torch.float32,
    )
    state.processed_frames = frames  # pyright: ignore[reportAttributeAccessIssue]  # of which two methods are asked
    for k, logits in enumerate(marked):
        mask = full_size(logits[None], (model.size, model.size)) > 0
        state.add_mask_inputs(state.obj_id_to_idx(k), key, mask[None].float())
    state.obj_with_new_inputs = list(range(len(marked)))
    config = model.video.config
    seen_back, pointed_back = config.num_maskmem, config.max_object_pointers_in_encoder
    yield key, model.video(inference_session=state, frame_idx=key).pred_masks[:, 0]
    for step in (1, -1):
        for objects in state.output_dict_per_obj.values():
            objects["non_cond_frame_outputs"].clear()  # of the other direction
        for index in range(key + step, len(frames) if step > 0 else -1, step):
            found = model.video(inference_session=state, frame_idx=index, reverse=step < 0)
            for objects in state.output_dict_per_obj.values():
                _forget(objects["non_cond_frame_outputs"], index, step, seen_back, pointed_back)
            yield index, found.pred_masks[:, 0]


def _forget(outputs: dict[int, dict], index: int, step: int, seen_back: int, pointed_back: int) -> None:
    """Drop what no later image of this direction looks at."""
    for name in ("high_res_masks", "pred_masks"):
        outputs[index].pop(name, None)
    if (old := outputs.get(index - step * seen_back)) is not None:
        for name in HEAVY:
            old.pop(name, None)
    outputs.pop(index - step * pointed_back, None)


class Canvas:
    """Object ids of a video's images, and how sure of each pixel its object is; on the disk, gone with the process.

    Args:
        count: Images.
        height: Of the images, pixels.
        width: Of the images, pixels.
        folder: Where there is room for four bytes per pixel.
    """

    def __init__(self, count: int, height: int, width: int, folder: Path):
        shape = (count, height, width)
        self._files = [tempfile.TemporaryFile(dir=folder) for _ in range(2)]  # noqa: SIM115  # closed by `close`
        self.ids = np.memmap(self._files[0], np.uint16, "w+", shape=shape)
        self._sure = np.memmap(self._files[1], np.float16, "w+", shape=shape)

    def paint(self, index: int, ids: Sequence[int], logits: np.ndarray) -> None:
        """Give objects the pixels of an image that they are surer of than others were; of equals the first one.

        Args:
            index: The image.
            ids: Their ids. (M,)
            logits: Above 0 where they are. [M, H, W]
        """
        best = logits.argmax(0)
        sure = np.take_along_axis(logits, best[None], 0)[0].astype(np.float16)
        better = sure > self._sure[index]  # which begins at 0
        self.ids[index][better] = np.asarray(ids, np.uint16)[best[better]]
        self._sure[index][better] = sure[better]

    def mark_gaps(self, longest: int) -> None:
        """Call unknown where an object was before and after images that lack it, unless another one is there.

        That it is hidden there by what is no object, or lost from sight, cannot be told from here.

        Args:
            longest: Longer gaps stay as they are: the object may have gone and come back. Images.
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
        """Give the room back."""
        del self.ids, self._sure
        for file in self._files:
            file.close()
