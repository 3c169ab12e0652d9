"""Mending: objects without a segment take pixels from the segment that contains them, and outlines do not change."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from r5dgs_core.association import associate, mending, segment_stack
from r5dgs_core.data.masks import UNKNOWN

SIZE, TIMES = 24, 6
PIXELS = np.arange(SIZE * SIZE).reshape(SIZE, SIZE)  # of a scene in which every pixel shows a different Gaussian


def truth() -> np.ndarray:
    """Two squares that touch, and one by itself. [H, W]"""
    mask = np.zeros((SIZE, SIZE), np.int32)
    mask[2:10, 2:10], mask[2:10, 10:18], mask[14:20, 4:10] = 1, 2, 3
    return mask


def associated(masks: list[np.ndarray]) -> tuple[list[segment_stack.ImageBags], associate.Association]:
    """Bags of masks of one view over time, and their association."""
    indices, weights = PIXELS.reshape(-1, 1), np.ones((SIZE * SIZE, 1))
    given = [
        segment_stack.from_pixels(mask, indices, weights, SIZE * SIZE, view=0, time=t) for t, mask in enumerate(masks)
    ]
    return given, associate.associate(given)


def mended(masks: list[np.ndarray], **changes: object) -> list[np.ndarray]:
    """Associate and mend masks of one view over time, with changed attributes of the association."""
    given, found = associated(masks)
    found = dataclasses.replace(found, **changes)
    out = []
    for k, (seen, shares) in enumerate(mending.shares(given, found)):
        drawn = np.zeros((SIZE * SIZE, shares.shape[1]), np.float32)
        drawn[seen] = shares
        out.append(mending.mend(masks[k], given[k].ids, drawn.reshape(SIZE, SIZE, -1), found, k))
    return out


def test_correct_masks_do_not_change():
    for mask in mended([truth() for _ in range(TIMES)]):
        np.testing.assert_array_equal(mask, truth())


def test_missed_objects_are_added():
    masks = [truth() for _ in range(TIMES)]
    masks[3][masks[3] == 3] = 0
    np.testing.assert_array_equal(mended(masks)[3], truth())


def test_merged_objects_are_separated():
    masks = [truth() for _ in range(TIMES)]
    masks[2][masks[2] == 2] = 1
    np.testing.assert_array_equal(mended(masks)[2], truth())


def test_outlines_of_segments_are_kept_despite_votes():
    masks = [truth() for _ in range(TIMES)]
    masks[4][2:10, 9] = 2  # a column of object 1
    masks[4][14:20, 10] = 3  # a column of background
    np.testing.assert_array_equal(mended(masks)[4], masks[4])


def test_an_object_that_nothing_shows_takes_no_pixel():
    masks = [truth() for _ in range(TIMES)]
    masks[0][masks[0] == 3] = UNKNOWN
    out = mended(masks)[0]
    assert (out[truth() == 3] == UNKNOWN).all()
    np.testing.assert_array_equal(out[truth() != 3], truth()[truth() != 3])


def test_unknown_pixels_stay_unknown_despite_votes():
    masks = [truth() for _ in range(TIMES)]
    masks[0][masks[0] == 3] = UNKNOWN
    given, found = associated(masks)
    drawn = np.eye(4, dtype=np.float32)[truth()]
    np.testing.assert_array_equal(mending.mend(masks[0], given[0].ids, drawn, found, 0), masks[0])


def test_an_object_spread_evenly_over_several_segments_takes_no_pixels():
    masks = [truth() for _ in range(TIMES)]
    masks[3][14:20, 4:6], masks[3][14:20, 6:8], masks[3][14:20, 8:10] = 0, 1, 2
    np.testing.assert_array_equal(mended(masks)[3], masks[3])


@pytest.mark.parametrize("doubt", [{"fallback": True}, {"usual_iou": 0.99 * mending.TRUSTED}])
def test_untrusted_votes_move_no_outline(doubt):
    masks = [truth() for _ in range(TIMES)]
    masks[3][masks[3] == 3] = 0
    np.testing.assert_array_equal(mended(masks, **doubt)[3], masks[3])


def test_relabelling_maps_ids_and_keeps_unknown_pixels():
    mask = np.array([[0, 5], [9, UNKNOWN]])
    new = mending.relabel(mask, np.array([0, 5, 9]), np.array([0, 2, 7]))
    assert new.tolist() == [[0, 2], [7, UNKNOWN]]
