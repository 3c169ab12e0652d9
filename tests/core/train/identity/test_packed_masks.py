"""Masks that were found, in a checkpoint."""

from __future__ import annotations

import numpy as np
import pytest

from r5dgs_core.errors import CheckpointError
from r5dgs_core.train.identity import packed_masks


@pytest.mark.parametrize("most", [3, 255, 4000])
def test_masks_survive_a_round_trip(most):
    rng = np.random.default_rng(0)
    masks = [rng.integers(0, most, size).astype(np.uint16) for size in ((4, 5), (7, 2), (1, 1))]
    masks[0][0, 0] = most
    back = packed_masks.unpack(packed_masks.pack(masks), [m.shape for m in masks])
    assert all(np.array_equal(a, b) for a, b in zip(masks, back, strict=True))
    assert {m.dtype for m in back} == {np.dtype(np.uint8 if most < 256 else np.uint16)}


def test_damaged_masks_and_those_of_other_images_are_refused():
    packed = packed_masks.pack([np.ones((4, 4), np.uint8)])
    with pytest.raises(CheckpointError, match="expected 20 pixels, found 16"):
        packed_masks.unpack(packed, [(4, 5)])
    with pytest.raises(CheckpointError, match="damaged"):
        packed_masks.unpack(packed[:-3], [(4, 4)])
