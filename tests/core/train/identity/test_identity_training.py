"""Labels and identity encodings agree with the masks that they come from."""

import dataclasses

import numpy as np
import pytest
import torch

from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.evaluation import evaluate, metrics
from r5dgs_core.model.gaussians import Gaussians
from r5dgs_core.raster import rasterize_splats
from r5dgs_core.scene import scene
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.train import train_views
from r5dgs_core.train.identity import identity_losses, identity_training, joint_identity, label_votes
from r5dgs_core.train.representations.fused_posing import PosedSplats


def row_of_blobs(opacities=(0.9, 0.9, 0.9)):
    """Three blobs side by side before a camera of 30 x 12 pixels, and a mask that names them 0, 5 and 3."""
    camera = Camera(30, 12, np.array([[30.0, 0, 15], [0, 30, 6], [0, 0, 1]]), np.eye(4))
    splats = PosedSplats(
        torch.tensor([[-1.0, 0, 3], [0, 0, 3], [1, 0, 3]]),
        torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4),
        torch.full((3, 3), 0.1),
        torch.tensor(opacities),
        torch.zeros(3, 3),
    )
    mask = np.repeat(np.repeat([[0, 5, 3]], 10, 1), 12, 0).astype(np.int32)
    return train_views.of_arrays("v", camera, 0.0, np.zeros((12, 30, 3), np.uint8), mask), splats


CLASSES = {0: 0, 3: 1, 5: 2}


def label(classes, view, splats, fallback):
    """Classes of the Gaussians, by the vote of one view."""
    weights = label_votes.votes([view], lambda _: splats, classes, len(fallback))
    return label_votes.elect(weights, torch.tensor(fallback)).tolist()


def test_each_gaussian_gets_the_class_of_its_pixels():
    view, splats = row_of_blobs()
    assert label(CLASSES, view, splats, [0, 0, 0]) == [0, 2, 1]


def test_gaussians_outside_all_masks_keep_their_identities():
    view, splats = row_of_blobs(opacities=(0.9, 0.0, 0.9))
    assert label(CLASSES, view, splats, [1, 1, 2]) == [0, 1, 1]


def test_ids_without_a_class_do_not_vote():
    view, splats = row_of_blobs()
    assert label({0: 0, 3: 1}, view, splats, [1, 0, 0]) == [0, 0, 1]
    assert label_votes.class_map(view, {0: 0, 3: 1})[0].tolist() == [0] * 10 + [-1] * 10 + [1] * 10


@pytest.mark.parametrize("steps", [0, 60])
def test_encodings_start_at_their_labels_and_learn_the_masks(steps):
    view, splats = row_of_blobs()
    wrong = torch.tensor([0, 2, 2])
    settings = {"identity.iterations": steps, "identity.rate": 0.1, "identity.classifier_rate": 0.05}
    losses = []
    encodings, weight, bias = identity_training.train_encodings(
        [view],
        lambda _: splats,
        CLASSES,
        wrong,
        config.Config().replace(**settings),
        splats.means,
        torch.Generator().manual_seed(0),
        lambda _, loss: losses.append(loss),
    )
    assert encodings.shape == (3, 16) and weight.shape == (3, 16) and bias.shape == (3,)
    answers = (encodings @ weight.T + bias).argmax(1).tolist()
    assert answers == ([0, 2, 2] if steps == 0 else [0, 2, 1])
    assert steps == 0 or losses[-1] < 0.8 * losses[0]


def test_more_classes_than_dimensions_are_supported():
    view, splats = row_of_blobs()
    many = {0: 0, 3: 18, 5: 19} | {i: i - 99 for i in range(100, 117)}
    labels, settings = torch.tensor([0, 19, 18]), config.Config().replace(**{"identity.iterations": 1})
    _, weight, _ = identity_training.train_encodings(
        [view], lambda _: splats, many, labels, settings, splats.means, torch.Generator().manual_seed(0)
    )
    assert weight.shape == (20, scene.IDENTITY_DIM) and torch.isfinite(weight).all()


def wall(n=300, seed=0):
    """A wall of small blobs in three stripes before the camera of `row_of_blobs`, masks 0, 5 and 3; groups so."""
    draws = torch.Generator().manual_seed(seed)
    view, _ = row_of_blobs()
    means = torch.rand(n, 3, generator=draws) * torch.tensor([3.0, 1.2, 0.1]) + torch.tensor([-1.5, -0.6, 3.0])
    stripe = ((means[:, 0] + 1.5) / means[:, 2] * 3).long().clamp(0, 2)
    params = {
        "means": means,
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        "log_scales": torch.full((n, 3), -2.6),
        "opacity_logits": torch.ones(n),
    }
    return view, Gaussians(params, torch.tensor([0, 2, 1])[stripe])


def posed(gaussians):
    opacities, colors = torch.sigmoid(gaussians.opacity_logits), torch.rand(len(gaussians), 3)
    return PosedSplats(gaussians.means * 1, gaussians.quats * 1, gaussians.log_scales.exp(), opacities, colors)


def make_joint(view, gaussians, training, **changes):
    settings = {"identity.training": training, "identity.rate": 0.05, "identity.classifier_rate": 0.02}
    identities = joint_identity.joint([view], CLASSES, config.Config().replace(**settings, **changes))
    assert identities is not None
    identities.begin(gaussians)
    return identities


def adam(identities, gaussians):
    named = {"identities": gaussians.identities, **identities.params}
    rates = {n: identities.rates[n.partition(".")[0]] for n in named}
    return torch.optim.Adam([{"params": [p], "lr": rates[n], "name": n} for n, p in named.items()])


def optimise(identities, gaussians, view, steps, first=0, optimizer=None):
    """Steps of the identities alone; returns the loss of each step, None where there was none, and the optimizer."""
    optimizer = optimizer or adam(identities, gaussians)
    values = []
    for iteration in range(first, first + steps):
        splats = posed(gaussians)
        features = blended(identities, gaussians, splats, view) if identities.with_geometry else None
        loss = identities.loss(gaussians, splats, view, iteration, features)
        values.append(None if loss is None else float(loss.detach()))
        if loss is not None:
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
    return values, optimizer


def blended(identities, gaussians, splats, view):
    """Encodings in the picture, out of the pass that draws the colours."""
    channels, background = identities.channels(gaussians, splats.colors, torch.ones(3))
    raster = (splats.means, splats.quats, splats.scales, splats.opacities)
    return rasterize_splats(*raster, channels, view.camera, background).image[..., 3:]


def accuracy(identities, gaussians, view):
    """Share of pixels whose class is the mask's."""
    with torch.no_grad():
        image = blended(identities, gaussians, posed(gaussians), view)
        answers = (image @ identities.params["classifier.weight"].T + identities.params["classifier.bias"]).argmax(-1)
    return float((answers == label_votes.class_map(view, CLASSES)).float().mean())


def disagreement(identities, gaussians):
    """Share of pairs of neighbours with different labels."""
    labels = identities.labels(gaussians)
    found = identity_losses.Neighbourhood(gaussians.means).nearest(torch.arange(len(gaussians)), 5)
    return float((labels[found] != labels[:, None]).float().mean())


@pytest.mark.parametrize("training", ["joint", "detached"])
def test_identities_trained_with_the_geometry_learn_the_masks(training):
    view, gaussians = wall()
    gaussians.motion_ids = gaussians.motion_ids.roll(40)  # many start with the wrong class
    identities = make_joint(view, gaussians, training, **{"identity.every": 2})
    before = accuracy(identities, gaussians, view)
    values, _ = optimise(identities, gaussians, view, 120)
    assert before < 0.8 and accuracy(identities, gaussians, view) > 0.93
    assert (None in values) == (training == "detached")
    found = [v for v in values if v is not None]
    assert found[-1] < 0.6 * found[0]


def test_identities_are_initialized_as_configured():
    view, gaussians = wall()
    gaussians.motion_ids[7] = 5  # a shadow's group lies past the classes
    identities = make_joint(view, gaussians, "detached")
    expected = gaussians.motion_ids.clone()
    expected[7] = 0
    assert torch.equal(identities.labels(gaussians), expected)
    view, gaussians = wall()
    make_joint(view, gaussians, "joint")
    drawn = gaussians.identities.detach() * 0.28209479 + 0.5
    assert drawn.min() >= 0 and drawn.max() <= 1 and abs(float(drawn.mean()) - 0.5) < 0.02


@pytest.mark.parametrize("training", ["joint", "detached"])
def test_only_joint_identities_reach_the_geometry(training):
    view, gaussians = wall()
    identities = make_joint(view, gaussians, training, **{"identity.spatial": 1.0})
    splats = posed(gaussians)
    features = blended(identities, gaussians, splats, view) if training == "joint" else None
    identities.loss(gaussians, splats, view, 0, features).backward()
    assert gaussians.identities.grad.any() and all(p.grad.any() for p in identities.params.values())
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        assert (gaussians.params[name].grad is not None) == (training == "joint"), name


@pytest.mark.parametrize("name", ["spatial", "majority"])
def test_each_spatial_loss_makes_neighbours_agree(name):
    left = {}
    for weight in (0.0, 2.0):
        view, gaussians = wall()
        identities = make_joint(view, gaussians, "joint", **{f"identity.{name}": weight, "identity.samples": 200})
        optimise(identities, gaussians, view, 80)
        left[weight] = disagreement(identities, gaussians)
    assert left[2.0] < 0.6 * left[0.0]


def test_each_disabled_loss_is_omitted():
    view, gaussians = wall()
    on = {"identity.spatial": 2.0, "identity.majority": 0.5, "identity.samples": 50}
    values = {}
    for off in ("none", "identity.weight", "identity.spatial", "identity.majority"):
        scene = wall()[1]
        identities = make_joint(view, scene, "joint", **{**on, off: 0.0} if off != "none" else on)
        splats = posed(scene)
        loss = identities.loss(scene, splats, view, 0, blended(identities, scene, splats, view))
        values[off] = float(loss.detach())
    parts = [values["none"] - values[name] for name in values if name != "none"]
    assert min(parts) > 1e-4
    assert sum(parts) == pytest.approx(values["none"], rel=1e-5)
    nothing = make_joint(view, wall()[1], "joint", **{"identity.weight": 0.0})
    assert nothing.loss(scene, splats, view, 0, torch.zeros(12, 30, 16)) is None


@pytest.mark.parametrize(
    ("representation", "variant", "active"),
    [("tracks", "r5dgs", True), ("field", "5dgs", False), ("field", "r5dgs", False), ("field", "r5dgs_extra", True)],
)
def test_only_the_variant_with_extra_losses_uses_the_majority_loss(representation, variant, active):
    view, gaussians = wall()
    changes = {"train.representation": representation, "field.variant": variant, "identity.weight": 0.0}
    identities = make_joint(view, gaussians, "joint", **changes, **{"identity.majority": 0.5})
    assert (identities.loss(gaussians, posed(gaussians), view, 0) is not None) == active


def test_neighbours_teach_invisible_gaussians_also_after_the_run():
    view, gaussians = wall()
    truth, wrong = gaussians.motion_ids, torch.arange(300) % 12 == 0
    with torch.no_grad():
        gaussians.opacity_logits[wrong] = -12.0
    start = torch.where(wrong, (truth + 1) % 3, truth)
    right = []
    for spatial in (0.0, 5.0):
        changes = {"identity.iterations": 100, "identity.spatial": spatial, "identity.rate": 0.05}
        encodings, weight, bias = identity_training.train_encodings(
            [view],
            lambda _: posed(gaussians),
            CLASSES,
            start,
            config.Config().replace(**changes),
            gaussians.means.detach(),
            torch.Generator().manual_seed(0),
        )
        answers = (encodings @ weight.T + bias).argmax(1)
        right.append(float((answers == truth)[wrong].float().mean()))
        assert (answers == truth)[~wrong].float().mean() > 0.95
    assert right[0] == 0 and right[1] > 0.8


@pytest.mark.parametrize(
    ("representation", "asked", "counted"),
    [("field", "auto", True), ("tracks", "auto", False), ("tracks", "on", True), ("field", "off", False)],
)
def test_a_gaussian_counts_among_its_neighbours_as_configured(representation, asked, counted):
    """Counting it takes the farthest of k away: with one neighbour nothing is left to differ from."""
    changes = {"train.representation": representation, "identity.include_self": asked, "identity.neighbours": 1}
    agreement = identity_training.Agreement(config.Config().replace(**changes, **{"identity.spatial": 1.0}))
    points = identity_losses.Neighbourhood(torch.rand(50, 3, generator=torch.Generator().manual_seed(0)))
    draws = torch.Generator().manual_seed(1)
    encodings, weight = torch.randn(50, 16, generator=draws), torch.randn(3, 16, generator=draws)
    loss = agreement.loss(encodings, weight, torch.zeros(3), points, draws)
    assert (float(loss) == 0) == counted


def test_losses_come_at_their_intervals():
    view, gaussians = wall()
    changes = {"identity.every": 3, "identity.spatial": 1.0, "identity.regularise_every": 2, "identity.samples": 20}
    identities = make_joint(view, gaussians, "detached", **changes)
    none = [identities.loss(gaussians, posed(gaussians), view, k) is None for k in range(7)]
    assert none == [False, True, False, False, False, True, False]


def test_views_without_masks_have_no_pixel_loss_and_unknown_ids_do_not_count():
    view, gaussians = wall()
    identities = make_joint(view, gaussians, "detached")
    blind = dataclasses.replace(view, load_mask=None)
    assert identities.loss(gaussians, posed(gaussians), blind, 0) is None
    unknown = view.with_arrays(mask=np.full_like(view.mask, 77))
    assert float(identities.loss(gaussians, posed(gaussians), unknown, 0).detach()) == 0


def test_encodings_grow_and_shrink_with_the_gaussians():
    view, gaussians = wall()
    identities = make_joint(view, gaussians, "detached")
    _, optimizer = optimise(identities, gaussians, view, 1)
    before, moments = gaussians.identities.detach().clone(), optimizer.state[gaussians.identities]["exp_avg"].clone()
    chosen, kept = torch.arange(0, 300, 9), torch.arange(334) % 4 > 0
    gaussians.extend(optimizer, {n: p[chosen] for n, p in gaussians.params.items()}, gaussians.motion_ids[chosen])
    gaussians.keep(optimizer, kept)
    assert torch.equal(gaussians.identities, torch.cat([before, before[chosen]])[kept])
    found = optimizer.state[gaussians.identities]["exp_avg"]
    assert torch.equal(found, torch.cat([moments, torch.zeros(34, 16)])[kept]) and moments.any()


@pytest.mark.parametrize(("name", "count"), [("identities", 299), ("identity", 300)])
def test_gaussians_accept_only_known_parameters_of_matching_shape(name, count):
    with pytest.raises(ValueError, match=name):
        wall()[1].add(name, torch.zeros(count, 16))


def test_joint_identities_need_masks_of_objects():
    view, _ = row_of_blobs()
    asked = config.Config().replace(**{"identity.training": "joint"})
    assert joint_identity.joint([view], CLASSES, config.Config()) is None
    assert joint_identity.joint([view], CLASSES, asked.replace(**{"identity.iterations": 0})) is None
    assert joint_identity.joint([view], {0: 0}, asked) is None
    assert joint_identity.joint([dataclasses.replace(view, load_mask=None)], CLASSES, asked) is None
    assert joint_identity.joint([view], CLASSES, asked) is not None


@pytest.mark.parametrize("training", ["joint", "detached"])
@pytest.mark.parametrize("grown", [False, True])
def test_identities_resume_to_the_same_bits(training, grown):
    """Broken off after 7 steps, with the Gaussians moved since neighbours were looked for, or grown just before."""
    changes = {"identity.spatial": 1.0, "identity.samples": 64, "identity.every": 2}
    view, gaussians = wall()
    unbroken = make_joint(view, gaussians, training, **changes)
    _, optimizer = optimise(unbroken, gaussians, view, 7)
    with torch.no_grad():
        gaussians.params["means"].add_(0.2 * torch.rand(300, 3, generator=torch.Generator().manual_seed(3)))
    if grown:
        chosen = torch.arange(0, 300, 7)
        gaussians.extend(optimizer, {n: p[chosen] for n, p in gaussians.params.items()}, gaussians.motion_ids[chosen])
    stored = {n: t.detach().clone() for n, t in unbroken.tensors(gaussians).items()}
    assert ("identity.points" in stored) != grown
    copy = Gaussians({n: p.detach().clone() for n, p in gaussians.params.items()}, gaussians.motion_ids)
    resumed = make_joint(view, wall()[1], training, **changes)
    resumed.restore(stored, copy)
    second = adam(resumed, copy)
    for group, old in zip(second.param_groups, optimizer.param_groups, strict=True):
        second.state[group["params"][0]] = {k: v.clone() for k, v in optimizer.state[old["params"][0]].items()}
    optimise(unbroken, gaussians, view, 5, 7, optimizer)
    optimise(resumed, copy, view, 5, 7, second)
    assert torch.equal(gaussians.identities, copy.identities)
    for name, tensor in unbroken.tensors(gaussians).items():
        assert torch.equal(tensor, resumed.tensors(copy)[name]), name


def test_pixels_of_the_trained_scene_belong_to_the_objects_of_the_masks(baked, tiny):
    counts = np.zeros((3, 3), np.int64)
    for view in datasets.read(tiny.root).train:
        rendering = evaluate.render(baked, view.camera, view.t)
        counts += metrics.confusion(rendering.ids, datasets.load_mask(view), [1, 2])
    assert metrics.miou(counts) > 0.8


def test_most_members_of_an_object_lie_near_its_centre(baked, tiny):
    for k in (1, 2):
        members = baked.gaussians.means[baked.gaussians.object_ids == k]
        assert len(members) > 50
        distances = np.linalg.norm(members - tiny.center(k, 0.75), axis=1)
        assert np.quantile(distances, 0.9) < 0.85  # half a diagonal of the brick is 0.72
