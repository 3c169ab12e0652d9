"""Points carved from masks lie in every mask, and a small ball replaces an empty hull."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.data import dataset as datasets
from r5dgs_core.train import normalization, train_views
from r5dgs_core.train.initialization import visual_hull
from tests.support import tiny_datasets


@pytest.fixture(scope="module")
def posed(tiny):
    """Views of one time, the time, and the way to training coordinates."""
    dataset = datasets.read(tiny.root)
    norm = normalization.from_cameras([v.camera for v in dataset.train])
    every = train_views.load(dataset, norm, None)
    t = every[18].t
    return [v for v in every if v.t == t], t, norm


def carve(seen, object_id, center, count=200, seed=0):
    return visual_hull.carve(seen, object_id, center, 0.6, count, np.random.default_rng(seed))


@pytest.mark.parametrize("object_id", [tiny_datasets.BRICK, tiny_datasets.BALL])
def test_carved_points_fall_on_the_object_wherever_it_is_not_hidden(tiny, posed, object_id):
    seen, t, norm = posed
    center = (tiny.center(object_id, t) - norm.origin) / norm.scale
    points, colors = carve(seen, object_id, center)
    assert points.shape == colors.shape == (200, 3)
    assert (colors >= 0).all() and (colors <= 1).all()
    for view in seen:
        columns, rows, valid = visual_hull.pixel_indices(view, points)
        assert valid.all()
        assert (view.mask[rows, columns] != 0).all()  # the object, or another one before it


def test_carved_points_have_the_colours_of_the_object(tiny, posed):
    seen, t, norm = posed
    painted = [v.with_arrays(np.where((v.mask == 1)[..., None], [200, 30, 30], 60).astype(np.uint8)) for v in seen]
    center = (tiny.center(1, t) - norm.origin) / norm.scale
    _, colors = carve(painted, 1, center)
    np.testing.assert_allclose(colors, np.tile([200, 30, 30], (200, 1)) / 255, atol=1e-6)


def test_one_wrong_mask_does_not_empty_the_hull(tiny, posed):
    seen, t, norm = posed
    center = (tiny.center(1, t) - norm.origin) / norm.scale
    wrong = [seen[0].with_arrays(mask=np.zeros_like(seen[0].mask)), *seen[1:]]
    points, _ = carve(wrong, 1, center)
    for view in seen[1:]:
        columns, rows, _ = visual_hull.pixel_indices(view, points)
        assert (view.mask[rows, columns] != 0).mean() > 0.95


def test_views_that_lack_the_objects_id_do_not_outvote_those_that_have_it(tiny, posed):
    seen, t, norm = posed
    center = (tiny.center(1, t) - norm.origin) / norm.scale
    unmarked = [v.with_arrays(mask=np.where(v.mask == 1, 0, v.mask)) for v in seen[2:]]
    points, colors = carve([*seen[:2], *unmarked], 1, center)
    for view in seen[:2]:
        columns, rows, _ = visual_hull.pixel_indices(view, points)
        assert (view.mask[rows, columns] != 0).all()
    assert (colors.max(1) > 0.05).all()


def test_a_fallback_ball_has_the_mean_colour_of_the_object(posed):
    seen, _, _ = posed
    painted = [v.with_arrays(np.full_like(v.image, [90, 150, 30]), np.where(v.mask == 1, 5, 0)) for v in seen]
    _, colors = carve(painted, 5, np.array([0.0, 0.0, 50.0]), count=40)
    np.testing.assert_allclose(colors, np.tile([90, 150, 30], (40, 1)) / 255, atol=1e-6)


def test_without_any_agreement_the_object_starts_as_a_small_ball(posed):
    seen, _, _ = posed
    points, colors = carve(seen, 9, np.array([0.1, 0.2, 0.3]), count=50)
    assert points.shape == (50, 3) and np.isfinite(colors).all()
    assert np.linalg.norm(points - [0.1, 0.2, 0.3], axis=1).max() < 0.6


def test_views_without_mask_and_points_behind_a_camera_do_not_vote(tiny, posed):
    seen, t, norm = posed
    center = (tiny.center(2, t) - norm.origin) / norm.scale
    blind = [*seen, dataclasses.replace(seen[0], load_mask=None)]
    np.testing.assert_array_equal(carve(blind, 2, center)[0], carve(seen, 2, center)[0])
    _, _, valid = visual_hull.pixel_indices(seen[0], (seen[0].camera.center - 2 * seen[0].camera.forward)[None])
    assert not valid.any()


@pytest.mark.parametrize("hidden", [0, 1])
def test_something_without_an_id_before_the_object_does_not_cut_it_in_other_views(tiny, posed, hidden):
    seen, t, norm = posed
    ball = tiny_datasets.BALL
    center = (tiny.center(ball, t) - norm.origin) / norm.scale
    mask = seen[hidden].mask.copy()
    middle = np.nonzero(mask == ball)[1].mean()
    mask[(mask == ball) & (np.arange(mask.shape[1]) > middle)] = 0
    screened = [v.with_arrays(mask=mask) if i == hidden else v for i, v in enumerate(seen)]

    def reached(views):
        points, _ = carve(views, ball, center, count=2000)
        columns, rows, _ = visual_hull.pixel_indices(seen[hidden], points)
        return columns.max() - columns.min()

    assert reached(screened) >= 0.9 * reached(seen)


def votes_of(seed, views=12, count=200):
    """Votes of views on points of a disc, of which something hides a part in some views, and the views' masks."""
    rng = np.random.default_rng(seed)
    points = 0.7 * rng.normal(size=(count, 2))
    filling = np.linalg.norm(points, axis=1) < 1
    inside, outside = np.zeros((2, views, count), bool)
    outlines = []
    for number in range(views):
        hidden = (rng.random() < 0.5) & (points[:, 0] > rng.uniform(-0.5, 0.8))
        inside[number], outside[number] = filling & ~hidden, (~filling | hidden) & (rng.random(count) > 0.03)
        cells = np.floor((points + 9) * rng.uniform(2, 6)).astype(int) @ [1, 1000]
        outlines.append(visual_hull.Outline(cells, np.unique(cells[filling])))
    outlines[rng.integers(views)] = None
    return inside, outside, inside | outside | (rng.random((views, count)) < 0.9), outlines


def left_out(inside, outside, seen, outlines, enough):
    """The points and the views to leave out, by trying every view and comparing all masks each time."""

    def select(hiding):
        against, total = outside.copy(), seen.copy()
        against[hiding], total[hiding] = False, inside[hiding]
        good = visual_hull._select(inside.sum(0), against.sum(0), total.sum(0), enough)
        shown = [x for x in outlines if x is not None and len(x.filled) >= visual_hull.MIN_CELLS]
        return min((x.share(good) for x in shown), default=1.0), good

    hiding, (share, good) = [], select([])
    showing = [number for number, x in enumerate(outlines) if x is not None]
    while share < visual_hull.FILLED and len(showing) - len(hiding) > visual_hull.MIN_VIEWS:
        trials = {number: select([*hiding, number]) for number in showing if number not in hiding}
        best = max(trials, key=lambda number: trials[number][0])
        if trials[best][0] < share + visual_hull.HELPS:
            break
        hiding.append(best)
        share, good = trials[best]
    return good, hiding


def test_views_are_left_out_as_if_all_were_tried():
    counts = []
    for seed in range(40):
        votes = votes_of(seed)
        found, expected = visual_hull._chosen(*votes, 20), left_out(*votes, 20)
        np.testing.assert_array_equal(found[0], expected[0])
        assert found[1] == expected[1]
        counts.append(len(found[1]))
    assert counts.count(0) > 5 and max(counts) > 1


def test_the_number_of_comparisons_with_masks_grows_with_the_views(monkeypatch):
    compared, share = [], visual_hull.Outline.share
    monkeypatch.setattr(visual_hull.Outline, "share", lambda *given: compared.append(0) or share(*given))
    visual_hull._chosen(*votes_of(0, views=150), 20)
    assert 150 < len(compared) < 5 * 150
