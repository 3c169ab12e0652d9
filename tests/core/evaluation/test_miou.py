"""Overlap of id maps with true masks: counted pixels, ignored pixels, and one map of ids for a whole split."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core.data import masks
from r5dgs_core.evaluation import miou

TRUTH = np.array([[0, 0, 1, 1], [0, 0, 1, 1], [5, 5, 0, 0]])


def measured(*pairs, ids=(1, 5)):
    tally = miou.Overlap(ids)
    for rendered, mask in pairs:
        tally.add(np.asarray(rendered), np.asarray(mask))
    return tally.result()


def test_every_number_is_that_of_its_definition():
    rendered = np.array([[0, 0, 1, 0], [0, 5, 1, 1], [5, 5, 0, 0]])
    found = measured((rendered, TRUTH))
    assert tuple(found) == miou.KEYS
    assert found["iou_objects"] == {"1": pytest.approx(3 / 4), "5": pytest.approx(2 / 3)}
    assert found["miou"] == found["miou_matched"] == pytest.approx((3 / 4 + 2 / 3) / 2)
    assert found["iou_background"] == pytest.approx(5 / 7)
    assert found["id_map"] == {"1": 1, "5": 5}
    assert json.loads(json.dumps(found, allow_nan=False)) == found


@given(st.integers(0, 10_000))
def test_pixels_with_unknown_mask_do_not_change_the_miou(seed):
    rng = np.random.default_rng(seed)
    mask, rendered = rng.choice([0, 1, 5, masks.UNKNOWN], (6, 7)), rng.choice([0, 1, 5], (6, 7))
    other = np.where(mask == masks.UNKNOWN, rng.choice([0, 1, 5], (6, 7)), rendered)
    assert measured((rendered, mask)) == measured((other, mask))
    np.testing.assert_array_equal(miou.objects_of(mask), (mask == 1) | (mask == 5))


def test_unknown_is_not_the_background():
    unknown = np.where(TRUTH == 5, masks.UNKNOWN, TRUTH)
    right = measured((TRUTH, unknown))
    assert right["miou"] == right["iou_background"] == 1.0 and set(right["iou_objects"]) == {"1"}
    missed = measured((TRUTH, np.where(TRUTH == 5, 0, TRUTH)))
    assert missed["iou_background"] < 1.0


def test_pixels_count_once_however_they_are_spread_over_images():
    rendered = np.array([[0, 0, 1, 0], [0, 5, 1, 1], [5, 5, 0, 0]])
    assert measured((rendered, TRUTH)) == measured((rendered[:1], TRUTH[:1]), (rendered[1:], TRUTH[1:]))


def test_one_map_of_ids_serves_all_images_so_that_a_switch_costs():
    swapped = np.array([0, 5, 0, 0, 0, 1])[TRUTH]
    always = measured((swapped, TRUTH), (swapped, TRUTH))
    assert always["miou"] == 0.0 and always["miou_matched"] == 1.0 and always["id_map"] == {"1": 5, "5": 1}
    assert always["iou_background"] == 1.0
    once = measured((TRUTH, TRUTH), (swapped, TRUTH))
    assert once["miou"] == once["miou_matched"] < 0.6


def test_an_object_that_the_scene_lacks_counts_as_missed_and_takes_no_id():
    found = measured((np.where(TRUTH == 5, 0, TRUTH), TRUTH), ids=(1,))
    assert found["iou_objects"] == found["iou_objects_matched"] == {"1": 1.0, "5": 0.0}
    assert found["miou"] == found["miou_matched"] == 0.5
    assert found["id_map"] == {"1": 1, "5": None}


def test_without_masks_or_without_objects_there_is_no_score():
    assert measured() == dict.fromkeys(miou.KEYS)
    empty = measured((np.zeros((3, 3), int), np.zeros((3, 3), int)))
    assert empty["miou"] is empty["miou_matched"] is None and empty["iou_background"] == 1.0
    nothing = measured((np.zeros((3, 3), int), np.full((3, 3), masks.UNKNOWN)))
    assert nothing["miou"] is nothing["iou_background"] is None and nothing["iou_objects"] == {}
