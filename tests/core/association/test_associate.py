"""Association of segments by the Gaussians they show: properties of the result on small scenes of balls on a floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from r5dgs_core.association import associate, segment_stack, supergaussians
from r5dgs_core.data.masks import UNKNOWN

PER_BODY, FLOOR = 40, 200


@dataclass(frozen=True)
class Seen:
    """Images of a scene: true objects [P], Gaussians [P, k], weights [P, k], view and time of each."""

    truths: list[np.ndarray]
    indices: list[np.ndarray]
    weights: list[np.ndarray]
    moments: list[tuple[int, int]]
    count: int

    def bags(self, masks: list[np.ndarray]) -> list[bags.ImageBags]:
        """The images with masks."""
        return [
            segment_stack.from_pixels(mask, self.indices[k], self.weights[k], self.count, view=view, time=t)
            for k, (mask, (view, t)) in enumerate(zip(masks, self.moments, strict=True))
        ]


def look(bodies: int, views: int, times: int, seed: int = 0, wrong: float = 0.1) -> Seen:
    """Each image shows three quarters of every object's Gaussians, and a few of them in a pixel of something else."""
    rng = np.random.default_rng(seed)
    objects = np.concatenate([np.zeros(FLOOR, int), np.repeat(np.arange(1, bodies + 1), PER_BODY)])
    seen = Seen([], [], [], [], len(objects))
    for view in range(views):
        for t in range(times):
            shown = np.flatnonzero(rng.random(len(objects)) < 0.75)
            stray = rng.random(len(shown)) < wrong
            truth = np.where(stray, rng.integers(0, bodies + 1, len(shown)), objects[shown])
            seen.truths.append(truth)
            seen.indices.append(np.stack([shown, rng.permutation(shown), np.full(len(shown), -1)], axis=1))
            seen.weights.append(np.tile([0.8, 0.05, 0.0], (len(shown), 1)))
            seen.moments.append((view, t))
    return seen


def partition(ids: list[np.ndarray]) -> list[int]:
    """Ids renumbered by first appearance. Equal results mean the same partition of the segments."""
    names: dict[int, int] = {}
    return [names.setdefault(int(i), len(names)) for i in np.concatenate(ids)]


def new_masks(
    masks: list[np.ndarray], given: list[segment_stack.ImageBags], found: associate.Association
) -> list[np.ndarray]:
    """The masks with their new ids."""
    return [ids[np.searchsorted(bag.ids, mask)] for mask, bag, ids in zip(masks, given, found.ids, strict=True)]


def renumbered(seen: Seen, seed: int) -> list[np.ndarray]:
    """True masks with an own numbering for each view."""
    rng = np.random.default_rng(seed)
    most = max(truth.max() for truth in seen.truths)
    names = {view: np.append(0, rng.permutation(most) + 1) for view, _ in seen.moments}
    return [names[view][truth] for truth, (view, _) in zip(seen.truths, seen.moments, strict=True)]


@pytest.mark.parametrize(("bodies", "views", "times"), [(1, 1, 1), (2, 4, 1), (2, 1, 4), (6, 3, 5)])
def test_clean_masks_come_back_as_they_are(bodies, views, times):
    seen = look(bodies, views, times)
    found = associate.associate(seen.bags(seen.truths))
    for ids, bag in zip(found.ids, seen.bags(seen.truths), strict=True):
        assert ids.tolist() == bag.ids.tolist()
    assert {row.done for row in found.rows} == {"kept"}


@pytest.mark.parametrize(("bodies", "views", "times"), [(2, 4, 1), (2, 2, 2), (6, 3, 5), (12, 4, 3)])
def test_views_with_separate_numbering_get_a_common_one(bodies, views, times):
    seen = look(bodies, views, times)
    masks = renumbered(seen, 3)
    given = seen.bags(masks)
    for mask, truth in zip(new_masks(masks, given, associate.associate(given)), seen.truths, strict=True):
        pairs = np.unique(np.stack([mask, truth]), axis=1)
        assert len(np.unique(pairs[0])) == len(np.unique(pairs[1])) == pairs.shape[1]
    together = np.concatenate(new_masks(masks, given, associate.associate(given)))
    pairs = np.unique(np.stack([together, np.concatenate(seen.truths)]), axis=1)
    assert pairs.shape[1] == bodies + 1


def test_names_of_views_have_no_effect():
    seen = look(6, 3, 5)
    outcomes = [
        partition(new_masks(m, b := seen.bags(m), associate.associate(b)))
        for m in (renumbered(seen, 3), renumbered(seen, 4))
    ]
    assert outcomes[0] == outcomes[1]


def test_the_order_of_images_has_no_effect():
    seen = look(6, 3, 5)
    masks = renumbered(seen, 3)
    given = seen.bags(masks)
    order = np.random.default_rng(1).permutation(len(given))
    straight, mixed = associate.associate(given), associate.associate([given[k] for k in order])
    back = [mixed.ids[k] for k in np.argsort(order)]
    assert partition(straight.ids) == partition(back)


def test_a_switch_is_found_and_listed():
    seen = look(6, 3, 8)
    masks = renumbered(seen, 3)
    changed = [k for k, (view, t) in enumerate(seen.moments) if view == 1 and t >= 5]
    a, b = (masks[changed[0]][seen.truths[changed[0]] == body][0] for body in (2, 5))
    for k in changed:
        masks[k] = np.where(masks[k] == a, b, np.where(masks[k] == b, a, masks[k]))
    found = associate.associate(seen.bags(masks))
    listed = {(row.image, row.old_id) for row in found.rows if row.done == "relabelled"}
    assert listed == {(k, name) for k in changed for name in (a, b)}
    rows = {(row.image, row.old_id): row for row in found.rows}
    assert rows[changed[0], a].new_id == rows[changed[0], b].usual_id


def test_a_fragment_or_a_missed_object_does_not_split_an_object():
    seen = look(5, 2, 8)
    masks = [truth.copy() for truth in seen.truths]
    for k, (view, t) in enumerate(seen.moments):
        if view == 0 and t == 3:
            masks[k][masks[k] == 2] = 0
        if view == 0 and t > 3:
            masks[k][masks[k] == 2] = 77
    given = seen.bags(masks)
    found = associate.associate(given)
    assert found.objects.tolist() == [1, 2, 3, 4, 5]
    for k, mask in enumerate(new_masks(masks, given, found)):
        shown = np.unique(mask[seen.truths[k] == 2])
        assert shown.tolist() == ([0] if k == 3 else [2])


def test_parts_join_the_whole_if_it_is_whole_in_other_images():
    seen = look(4, 2, 10)
    masks = renumbered(seen, 3)
    split = [2, 7, 13]
    for k in split:
        part = (seen.truths[k] == 3) & (seen.indices[k][:, 0] % 2 == 0)
        masks[k] = np.where(part, 90 + k, masks[k])
    given = seen.bags(masks)
    made = new_masks(masks, given, associate.associate(given))
    whole = np.unique(made[0][seen.truths[0] == 3])
    for k in split:
        assert np.unique(made[k][(seen.truths[k] == 3)]).tolist() == whole.tolist()


def test_objects_that_are_sometimes_merged_stay_separate():
    seen = look(4, 2, 10)
    masks = renumbered(seen, 3)
    for k in (4, 12):
        name = masks[k][seen.truths[k] == 2][0]
        masks[k] = np.where(seen.truths[k] == 3, name, masks[k])
    found = associate.associate(seen.bags(masks))
    assert len(found.objects) == 4


def test_ids_without_supporting_geometry_are_kept():
    seen = look(5, 3, 4)
    rng = np.random.default_rng(0)
    masks = [rng.integers(0, 6, len(truth)) for truth in seen.truths]
    found = associate.associate(seen.bags(masks))
    assert found.fallback
    assert all(row.done == "kept" and row.new_id == row.old_id for row in found.rows)


def test_empty_masks_and_segments_without_gaussians_are_accepted():
    seen = look(3, 2, 4)
    masks = [truth.copy() for truth in seen.truths]
    masks[0][:] = 0
    masks[1][:] = UNKNOWN
    seen.indices[2][seen.truths[2] == 1] = -1
    given = seen.bags(masks)
    found = associate.associate(given)
    assert found.ids[0].tolist() == [0] and found.ids[1].tolist() == []
    assert found.ids[3].tolist() == [0, 1, 2, 3]
    assert len(found.ids[2]) == len(given[2].ids) == 4
    nothing = associate.associate(seen.bags([np.zeros_like(truth) for truth in seen.truths]))
    assert not len(nothing.objects) and nothing.rows == []


@pytest.mark.parametrize("rows", [[[1, 2]], [[1, 2], [3, 4]]])
def test_images_that_share_no_gaussians_keep_their_ids(rows):
    given = [
        segment_stack.from_pixels(np.ones(2, int), np.array(own)[:, None], np.ones((2, 1)), 5, view=view, time=0)
        for view, own in enumerate(rows)
    ]
    found = associate.associate(given)
    assert [ids.tolist() for ids in found.ids] == [[1]] * len(rows)


def test_images_without_any_segment_have_no_objects():
    unknown = segment_stack.from_pixels(np.full(2, UNKNOWN), np.zeros((2, 1), int), np.ones((2, 1)), 3, view=0, time=0)
    found = associate.associate([unknown])
    assert found.rows == [] and not len(found.objects) and found.ids[0].tolist() == []


def test_grouping_gaussians_into_patches_gives_the_same_segments():
    seen = look(6, 3, 5)
    masks = renumbered(seen, 3)
    given = seen.bags(masks)
    objects = np.concatenate([np.zeros(FLOOR, int), np.repeat(np.arange(1, 7), PER_BODY)])
    rng = np.random.default_rng(0)
    neighbours = np.stack([rng.choice(np.flatnonzero(objects == body), 4) for body in objects])
    whole, patched, thinned = (
        associate.associate(given),
        associate.associate(given, neighbours, most=100),
        associate.associate(given, most=300),
    )
    assert partition(whole.ids) == partition(patched.ids) == partition(thinned.ids)


def test_patches_group_neighbours_that_move_together():
    rng = np.random.default_rng(0)
    places = rng.random((300, 3))
    side = places[:, 0] > 0.5
    neighbours = np.argsort(np.linalg.norm(places[:, None] - places[None], axis=-1), axis=1)[:, 1:9]
    paths = np.stack([places, places + side[:, None] * [3.0, 0.0, 0.0]], axis=1)
    groups = supergaussians.group(300, neighbours, paths, 50)
    assert groups.max() + 1 < 200
    for k in range(groups.max() + 1):
        assert len(np.unique(side[groups == k])) == 1
    still = supergaussians.group(300, neighbours, None, 50)
    assert any(len(np.unique(side[still == k])) == 2 for k in range(still.max() + 1))


def test_ids_too_large_for_masks_are_renumbered():
    seen = look(3, 3, 4)
    masks = [np.where(truth > 0, truth + 70_000, 0) for truth in seen.truths]
    assert associate.associate(seen.bags(masks)).objects.tolist() == [1, 2, 3]


@pytest.mark.parametrize("high", [60_000, 65_534])
def test_new_objects_get_unused_ids_however_high_the_incoming_ones_are(high):
    seen = look(3, 3, 4)
    given_masks = []
    for truth, (view, _) in zip(seen.truths, seen.moments, strict=True):  # each view names two of the three objects
        names = np.array([0, *(int(k) for k in np.insert([1, high], view, UNKNOWN))])
        given_masks.append(names[truth])
    found = associate.associate(seen.bags(given_masks))
    assert len(found.objects) == 3 and all(0 < k < UNKNOWN for k in found.objects)
    assert not any(row.done == "unknown" for row in found.rows)


def test_what_does_not_fit_is_refused():
    seen = look(2, 2, 2)
    with pytest.raises(ValueError, match="at least one image"):
        associate.associate([])
    with pytest.raises(ValueError, match="pixels, got indices"):
        segment_stack.from_pixels(seen.truths[0][1:], seen.indices[0], seen.weights[0], seen.count, view=0, time=0)
    given = seen.bags(seen.truths)
    with pytest.raises(ValueError, match="image 1: expected ascending ids"):
        segment_stack.stack(
            [given[0], segment_stack.ImageBags(given[1].ids[::-1], given[1].pixels, given[1].weights, 0, 1)]
        )
