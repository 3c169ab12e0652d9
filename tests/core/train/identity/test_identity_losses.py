"""Losses of the identities: their values by definition, their gradients in float64, their neighbours by brute force."""

import math

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core.train.identity import identity_losses


def answers(*shape, seed=0, spread=2.0):
    draws = torch.Generator().manual_seed(seed)
    return spread * torch.randn(*shape, generator=draws, dtype=torch.float64)


def pixels(height=5, width=4, dims=16, classes=3, seed=0):
    draws = torch.Generator().manual_seed(seed)
    target = torch.randint(-1, classes, (height, width), generator=draws)
    return answers(height, width, dims, seed=seed), answers(classes, dims, seed=9), answers(classes, seed=8), target


def leaves(*tensors):
    return [t.clone().requires_grad_(True) for t in tensors]


@pytest.mark.parametrize("classes", [1, 2, 7, 40])
@pytest.mark.parametrize("block", [1, 37, 1 << 24])
def test_the_pixel_loss_and_its_gradient_follow_the_definition(classes, block, monkeypatch):
    monkeypatch.setattr(identity_losses, "BLOCK_BYTES", 8 * classes * block)
    features, weight, bias, target = pixels(9, 11, classes=classes)
    ours, theirs = leaves(features, weight, bias), leaves(features, weight, bias)
    loss = identity_losses.pixel_cross_entropy(*ours, target)
    logits = theirs[0].reshape(-1, 16) @ theirs[1].T + theirs[2]
    expected = F.cross_entropy(logits, target.reshape(-1), ignore_index=-1) / math.log(max(classes, 2))
    (3 * loss).backward()
    (3 * expected).backward()
    torch.testing.assert_close(loss, expected)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a.grad, b.grad)


def test_the_gradient_of_the_pixel_loss_matches_its_value():
    *inputs, target = pixels()
    assert torch.autograd.gradcheck(lambda *x: identity_losses.pixel_cross_entropy(*x, target), leaves(*inputs))


@pytest.mark.parametrize("classes", [2, 5, 256])
def test_uniform_guesses_have_loss_one_for_any_number_of_classes(classes):
    target = torch.arange(30).reshape(5, 6) % classes
    loss = identity_losses.pixel_cross_entropy(
        torch.randn(5, 6, 16), torch.zeros(classes, 16), torch.zeros(classes), target
    )
    assert float(loss) == pytest.approx(1.0, rel=1e-6)


def test_pixels_that_do_not_count_change_nothing():
    features, weight, bias, target = pixels()
    (first,) = leaves(features)
    identity_losses.pixel_cross_entropy(first, weight, bias, target).backward()
    assert (target < 0).any() and not first.grad[target < 0].any()
    other = torch.where((target < 0)[..., None], 1e3, features)
    values = [identity_losses.pixel_cross_entropy(f, weight, bias, target) for f in (features, other)]
    assert torch.equal(*values)
    (nobody,) = leaves(features)
    loss = identity_losses.pixel_cross_entropy(nobody, weight, bias, torch.full_like(target, -1))
    loss.backward()
    assert float(loss.detach()) == 0 and not nobody.grad.any()


def test_certain_and_wrong_answers_have_finite_losses():
    features = torch.full((2, 2, 16), 300.0, requires_grad=True)
    weight, bias = torch.eye(3, 16), torch.zeros(3)
    loss = identity_losses.pixel_cross_entropy(
        features, 100 * weight, bias - torch.tensor([0.0, 9e3, 0]), torch.ones(2, 2).long()
    )
    loss.backward()
    assert float(loss.detach()) > 1e3 and torch.isfinite(features.grad).all()


LOSSES = {
    "spatial": identity_losses.spatial_divergence,
    "as Gaussian Grouping": lambda p, n: identity_losses.spatial_divergence(p, n, include_self=True),
    "majority": identity_losses.majority_distance,
}


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("spread", [0.5, 5.0])
def test_gradients_of_the_spatial_losses_match_their_values(name, spread):
    inputs = leaves(answers(6, 3, spread=spread), answers(6, 4, 3, seed=1, spread=spread))
    assert torch.autograd.gradcheck(lambda p, n: LOSSES[name](p.softmax(-1), n.softmax(-1)), inputs)


@pytest.mark.parametrize("name", LOSSES)
def test_agreement_has_no_loss_and_disagreement_has(name):
    p = answers(7, 4).softmax(-1)
    same = p[:, None].expand(7, 5, 4)
    other = answers(7, 5, 4, seed=3).softmax(-1)
    assert float(LOSSES[name](p, same)) == pytest.approx(0, abs=1e-12)
    assert float(LOSSES[name](p, other)) > 0.01


def test_the_divergence_in_space_follows_its_definition():
    p, n = answers(6, 4).softmax(-1), answers(6, 5, 4, seed=1).softmax(-1)
    by_pair = [[F.kl_div(n[q, k].log(), p[q], reduction="sum") / 4 for k in range(5)] for q in range(6)]
    table = torch.tensor(by_pair, dtype=torch.float64)
    torch.testing.assert_close(identity_losses.spatial_divergence(p, n), table.mean())
    table[:, -1] = 0  # the farthest makes room for the query itself
    torch.testing.assert_close(identity_losses.spatial_divergence(p, n, include_self=True), table.mean())


def test_the_majority_is_the_mean_of_the_others():
    p, n = answers(6, 4).softmax(-1), answers(6, 5, 4, seed=1).softmax(-1)
    expected = sum(float(((p[q] - n[q].sum(0) / 5) ** 2).sum()) for q in range(6)) / 6
    assert float(identity_losses.majority_distance(p, n)) == pytest.approx(expected)


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("shape", [(0, 3), (4, 0), (4, 1)])
def test_few_or_no_neighbours_give_finite_losses_and_gradients(name, shape):
    p, n = leaves(answers(shape[0], 3), answers(*shape, 3, seed=1))
    loss = LOSSES[name](p.softmax(-1), n.softmax(-1))
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(p.grad).all() and torch.isfinite(n.grad).all()


@pytest.mark.parametrize("name", LOSSES)
def test_certain_answers_have_finite_gradients(name):
    p, n = leaves(1e4 * answers(5, 3).float(), 1e4 * answers(5, 4, 3, seed=1).float())
    LOSSES[name](p.softmax(-1), n.softmax(-1)).backward()
    assert torch.isfinite(p.grad).all() and torch.isfinite(n.grad).all()


@given(st.integers(1, 40), st.integers(1, 6), st.integers(0, 10_000))
def test_neighbours_are_the_nearest_others(n, count, seed):
    draws = torch.Generator().manual_seed(seed)
    points = torch.rand(n, 3, generator=draws)
    rows = torch.randint(n, (7,), generator=draws)
    found = identity_losses.Neighbourhood(points).nearest(rows, count)
    distances = torch.cdist(points[rows].double(), points.double())
    distances[torch.arange(7), rows] = torch.inf
    expected = distances.sort(1).values[:, : min(count, n - 1)]
    assert found.shape == expected.shape and not (found == rows[:, None]).any()
    torch.testing.assert_close(distances.gather(1, found), expected)


def test_coincident_points_are_not_their_own_neighbours():
    points = torch.zeros(9, 3)
    points[6:] = torch.tensor([1.0, 0, 0])
    rows = torch.arange(9)
    found = identity_losses.Neighbourhood(points).nearest(rows, 4)
    assert found.shape == (9, 4) and not (found == rows[:, None]).any()
    assert all(len(set(line)) == 4 for line in found.tolist())
    assert (found[:6] < 6).all()


def test_neighbours_do_not_change_when_the_points_move():
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    neighbourhood = identity_losses.Neighbourhood(points)
    before = neighbourhood.nearest(torch.arange(30), 3)
    points += torch.rand(30, 3, generator=torch.Generator().manual_seed(1))
    assert torch.equal(neighbourhood.nearest(torch.arange(30), 3), before)
    assert not torch.equal(identity_losses.Neighbourhood(points).nearest(torch.arange(30), 3), before)
