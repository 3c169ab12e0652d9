"""Unknown pixels of masks have no effect on training, so the information of other masks is kept."""

import dataclasses

import numpy as np
import pytest
import torch

from r5dgs_core.bake import bake
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import masks
from r5dgs_core.evaluation import evaluate
from r5dgs_core.model.gaussians import Gaussians
from r5dgs_core.playback import scene_player
from r5dgs_core.train import normalization, run, train_views
from r5dgs_core.train.identity import identity_training, joint_identity, label_votes
from r5dgs_core.train.initialization import background_images, scatter, triangulation, visual_hull
from r5dgs_core.train.representations.fused_posing import PosedSplats
from tests.support import tiny_datasets

CLASSES = {0: 0, tiny_datasets.BRICK: 1, tiny_datasets.BALL: 2}


@pytest.fixture(scope="module")
def seen(tiny):
    """Training views in the world's own coordinates."""
    dataset = datasets.read(tiny.root)
    return train_views.load(dataset, normalization.Normalization(np.zeros(3), 1.0), None)


@pytest.fixture(scope="module")
def pose(tiny):
    """Splats of the true scene at a view's time."""

    def at(view):
        frame = scene_player.Player(tiny.truth).frame(view.t)
        return PosedSplats(
            *(torch.from_numpy(np.asarray(a, np.float32)) for a in (frame.means, frame.quats)),
            torch.from_numpy(np.exp(np.asarray(tiny.truth.gaussians.log_scales, np.float32))),
            torch.sigmoid(torch.from_numpy(tiny.truth.gaussians.opacity_logits)),
            torch.zeros(len(frame.means), 3),
        )

    return at


def marked(view, where, value):
    """The view with another value in some pixels of its mask."""
    return view.with_arrays(mask=np.where(where, np.uint16(value), view.mask))


def unknown(view):
    return marked(view, True, masks.UNKNOWN)


def unmasked(view):
    return dataclasses.replace(view, load_mask=None)


def joint(training: str):
    settings = config.load(None, [f"identity.training={training}", "identity.every=1", "identity.weight=1"])
    return joint_identity.JointIdentity(CLASSES, settings, torch.Generator().manual_seed(0))


def test_unknown_pixels_have_no_gradient(seen):
    learner, view = joint("joint"), seen[0]
    half = np.arange(view.mask.shape[1]) < view.mask.shape[1] // 2
    features = torch.randn(*view.mask.shape, 16, requires_grad=True)
    gaussians = Gaussians({"means": torch.zeros(1, 3)}, torch.zeros(1, dtype=torch.int64))
    loss = learner.loss(gaussians, None, marked(view, half[None], masks.UNKNOWN), 1, features)
    (gradient,) = torch.autograd.grad(loss, features)
    assert torch.equal(gradient[:, half], torch.zeros_like(gradient[:, half]))
    assert (gradient[:, ~half].abs().sum(-1) > 0).all()


def test_unknown_pixels_do_not_vote(seen, pose):
    count = len(pose(seen[0]).means)
    assert not label_votes.votes([unknown(v) for v in seen], pose, CLASSES, count).any()
    several = label_votes.votes([*seen[:6], *(unknown(v) for v in seen[6:])], pose, CLASSES, count)
    assert torch.equal(several, label_votes.votes(seen[:6], pose, CLASSES, count)) and several.any()


def test_masks_marked_unknown_do_not_change_the_labels(tiny, seen, pose):
    """Two of three masks of the ball are missing: as background they outvote the rest, as unknown they do not."""
    truth = torch.from_numpy(np.array([CLASSES[int(i)] for i in tiny.truth.gaussians.object_ids]))
    fallback = torch.zeros(len(truth), dtype=torch.int64)

    def learned(missed):
        some = [  # every camera keeps a third of its masks
            v if (k + k // 6) % 3 == 0 else marked(v, v.mask == tiny_datasets.BALL, missed) for k, v in enumerate(seen)
        ]
        labels = label_votes.elect(label_votes.votes(some, pose, CLASSES, len(truth)), fallback)
        settings = config.load(None, ["identity.iterations=30"])
        means = torch.from_numpy(tiny.truth.gaussians.means)
        encodings, weight, bias = identity_training.train_encodings(
            some, pose, CLASSES, labels, settings, means, torch.Generator().manual_seed(0)
        )
        return labels, (encodings @ weight.T + bias).argmax(1)

    whole, as_unknown, as_background = (learned(value) for value in (tiny_datasets.BALL, masks.UNKNOWN, 0))
    ball = truth == CLASSES[tiny_datasets.BALL]
    for one, other in zip(whole, as_unknown, strict=True):
        assert (one == other)[ball].float().mean() > 0.95 and (one == other).float().mean() > 0.99
    assert all((labels[ball] == 2).float().mean() < 0.5 for labels in as_background)


def test_unknown_pixels_are_no_object_and_have_no_position(tiny, seen):
    times = np.unique([v.t for v in seen])
    mixed = [unknown(v) if k % 4 == 1 else v for k, v in enumerate(seen)]
    without = [unmasked(v) if k % 4 == 1 else v for k, v in enumerate(seen)]
    found, expected = (triangulation.locate(some, times, 5e-4) for some in (mixed, without))
    assert found.object_ids.tolist() == [tiny_datasets.BRICK, tiny_datasets.BALL]
    for field in dataclasses.fields(found):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name))


def test_a_hull_is_not_cut_where_one_mask_is_unknown_or_shows_background(tiny, seen):
    t = seen[0].t
    then = [v for v in seen if v.t == t]
    center = tiny.center(tiny_datasets.BALL, t)
    columns = np.nonzero((then[0].mask == tiny_datasets.BALL).any(0))[0]
    side = np.arange(then[0].mask.shape[1]) >= np.median(columns)

    def spread_of(value):
        cut = [marked(then[0], side[None] & (then[0].mask == tiny_datasets.BALL), value), *then[1:]]
        points, _ = visual_hull.carve(cut, tiny_datasets.BALL, center, 0.5, 400, np.random.default_rng(0))
        at, _, valid = visual_hull.pixel_indices(then[0], points)
        return side[at[valid]].mean()

    assert spread_of(masks.UNKNOWN) > 0.3
    assert spread_of(0) > 0.3  # the other masks are not filled by half a ball


def test_background_images_treat_unknown_masks_like_missing_ones(seen):
    for one, other in zip(
        background_images.compute([unknown(v) for v in seen]),
        background_images.compute([unmasked(v) for v in seen]),
        strict=True,
    ):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.known, other.known)


def test_pixels_known_in_some_masks_use_only_those_masks(seen):
    (same,) = train_views.by_camera(seen, 1)
    cover = np.zeros(same[0].mask.shape, bool)
    cover[5:15, 5:15] = True
    clean = marked(same[0], True, 0)
    dirty = unknown(same[1]).with_arrays(np.full_like(same[1].image, 255))
    hidden = marked(clean, cover, 1)
    (background,) = background_images.compute([hidden, dirty, dirty])
    assert not background.known[6:14, 6:14].any()  # an object there; the others may show the same one
    np.testing.assert_allclose(background.image[20:], clean.image[20:] / 255, atol=1e-6)


def test_points_of_a_reconstruction_are_not_judged_by_unknown_pixels(tiny, seen):
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [tiny.center(tiny_datasets.BALL, seen[0].t) + 0.1 * rng.normal(size=(40, 3)), rng.normal(size=(40, 3))]
    )
    colors = np.zeros_like(points)
    then = [v for v in seen if v.t == seen[0].t]
    mixed, alone = [*then, *(unknown(v) for v in seen)], then
    kept = [scatter.behind_objects(points, colors, some, 80, np.random.default_rng(1))[0] for some in (mixed, alone)]
    np.testing.assert_array_equal(*kept)
    assert 0 < len(kept[0]) < len(points)


@pytest.mark.nightly
def test_a_run_with_unknown_masks_learns_nearly_the_same_as_with_all_masks(tiny, tmp_path):
    """The ball is missing in two of three masks, which costs little if marked unknown, else most of its mIoU."""
    found = {}
    for name, missed in (("whole", None), ("unknown", masks.UNKNOWN), ("background", 0)):
        folder = tmp_path / name
        for k, view in enumerate(datasets.read(tiny.root).train):
            ids = datasets.load_mask(view)
            if missed is not None and (k + k // 6) % 3:
                ids = np.where(ids == tiny_datasets.BALL, missed, ids)
            masks.write(folder / f"{view.name}.png", ids)
        settings = tiny_datasets.settings("train.iterations=300", f"data.masks='{folder}'")
        made = run.train(tiny.root, tmp_path / f"run_{name}", settings)
        dataset = datasets.read(tiny.root)
        scores = evaluate.evaluate(bake.bake(made), dataset)["splits"]
        found[name] = [scores[split]["rigid"]["miou"] for split in ("val", "test")]
    for whole, as_unknown, as_background in zip(*found.values(), strict=True):
        assert as_unknown > whole - 0.05
        assert as_background < as_unknown - 0.2
