"""Rigid motions of objects have no loss, all other changes do; representatives are deterministic."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core.motion import rotations
from r5dgs_core.train.representations import rigidity


def cloud(n=60, seed=0, classes=4):
    draws = torch.Generator().manual_seed(seed)
    means = torch.randn(n, 3, generator=draws, dtype=torch.float64)
    labels = torch.randint(-1, classes, (n,), generator=draws)
    opacities = torch.rand(n, generator=draws)
    return means, labels, opacities


def rigid_motion(means, labels, seed=5):
    """Every object turned and moved by itself; background and unassigned ones scattered."""
    draws = torch.Generator().manual_seed(seed)
    moved = means + torch.randn(means.shape, generator=draws, dtype=torch.float64)
    for k in range(1, int(labels.max()) + 1):
        quat = rotations.normalize(torch.randn(4, generator=draws, dtype=torch.float64))
        shift = torch.randn(3, generator=draws, dtype=torch.float64)
        moved[labels == k] = rotations.rotate(quat, means[labels == k]) + shift
    return moved


@given(st.integers(1, 80), st.integers(0, 10_000))
def test_the_representative_is_the_visible_member_nearest_to_the_centroid(n, seed):
    means, labels, opacities = cloud(n, seed)
    found = rigidity.representatives(means, labels, opacities)
    assert len(found) == max(int(labels.max()), 0) + 1 and found[0] == -1
    for k in range(1, len(found)):
        rows = torch.nonzero(labels == k)[:, 0]
        seen = rows[opacities[rows] > rigidity.SEEN_OPACITY]
        rows = seen if len(seen) else rows
        if not len(rows):
            assert found[k] == -1
            continue
        distances = (means[rows] - means[rows].mean(0)).norm(dim=1)
        assert found[k] in rows
        assert float((means[found[k]] - means[rows].mean(0)).norm()) == pytest.approx(float(distances.min()))


def test_the_first_of_equally_near_members_is_the_representative():
    corners = torch.tensor([[9.0, 9, 9], [1, 1, 0], [-1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    labels = torch.tensor([0, 1, 1, 1, 1])
    opacities = torch.ones(5)
    assert rigidity.representatives(corners, labels, opacities).tolist() == [-1, 1]
    opacities[1] = 0.1
    faint = rigidity.representatives(corners, labels, opacities)  # the centroid is now nearest to the inner corner
    assert faint.tolist() == [-1, 4]


def test_anchors_name_the_representative_of_each_member():
    means, labels, opacities = cloud()
    rows = rigidity.representatives(means, labels, opacities)
    anchors = rigidity.anchors(means, labels, opacities, int(labels.max()) + 1)
    for label, anchor in zip(labels.tolist(), anchors.tolist(), strict=True):
        assert anchor == (-1 if label < 1 else rows[label])


FORMS = pytest.mark.parametrize("form", ["absolute", "squared"])


@FORMS
def test_rigid_motions_of_the_objects_are_free_whatever_the_background_does(form):
    means, labels, opacities = cloud()
    anchors = rigidity.anchors(means, labels, opacities, int(labels.max()) + 1)
    moved = rigid_motion(means, labels)
    assert float((moved - means).norm()) > 1
    assert float(rigidity.rigidity(means, moved, anchors, form)) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(("form", "power"), [("absolute", 1), ("squared", 2)])
def test_growth_costs_the_mean_power_of_the_change_of_distance(form, power):
    means, labels, opacities = cloud()
    anchors = rigidity.anchors(means, labels, opacities, int(labels.max()) + 1)
    members = [i for i, a in enumerate(anchors.tolist()) if a not in (-1, i)]
    distances = [float((means[i] - means[anchors[i]]).norm()) for i in members]
    for factor in (1.25, 0.5):
        cost = float(rigidity.rigidity(means, factor * means, anchors, form))
        expected = sum((abs(factor - 1) * distance) ** power for distance in distances) / len(members)
        assert cost == pytest.approx(expected, rel=1e-9)


@FORMS
def test_gradients_match_the_loss_and_reach_only_the_later_state(form):
    means, labels, opacities = cloud(14, classes=3)
    anchors = rigidity.anchors(means, labels, opacities, int(labels.max()) + 1)
    assert len(set(anchors.tolist())) == 3
    after = (means + 0.3 * cloud(14, seed=1)[0]).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: rigidity.rigidity(means, x, anchors, form), (after,))
    before = means.clone().requires_grad_(True)
    rigidity.rigidity(before, after, anchors, form).backward()
    assert before.grad is None and (after.grad[anchors >= 0] != 0).any() and not after.grad[anchors < 0].any()


@FORMS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("collapsed", ["before", "after", "both"])
def test_members_on_their_representative_have_finite_gradients(dtype, collapsed, form):
    means, labels, opacities = cloud(12, classes=3)
    anchors = rigidity.anchors(means, labels, opacities, int(labels.max()) + 1)
    points = torch.zeros(12, 3, dtype=dtype)
    before = points if collapsed != "after" else means.to(dtype)
    after = (points if collapsed != "before" else means.to(dtype)).clone().requires_grad_(True)
    loss = rigidity.rigidity(before, after, anchors, form)
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(after.grad).all()


@FORMS
def test_without_members_there_is_no_loss_and_no_gradient(form):
    for anchors in (torch.full((5,), -1), torch.arange(5), torch.zeros(0, dtype=torch.int64)):
        after = torch.randn(len(anchors), 3, requires_grad=True)
        loss = rigidity.rigidity(after.detach() + 1, after, anchors, form)
        loss.backward()
        assert float(loss.detach()) == 0 and not after.grad.any()


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_the_loss_holds_together_an_object_that_is_pulled_apart(weight):
    means, labels, opacities = cloud(40, classes=2)
    anchors = rigidity.anchors(means, labels, opacities, int(labels.max()) + 1)
    target = rigid_motion(means, labels) + 0.3 * cloud(40, seed=7)[0]
    after = means.clone().requires_grad_(True)
    optimizer = torch.optim.Adam([after], lr=0.02)
    for _ in range(300):
        loss = 0.05 * (after - target).square().mean() + weight * rigidity.rigidity(means, after, anchors, "absolute")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    left = float(rigidity.rigidity(means, after.detach(), anchors, "absolute"))
    assert left < 0.04 if weight else left > 0.15


def test_a_rigid_motion_of_each_group_costs_no_stiffness_and_anything_else_does():
    generator = torch.Generator().manual_seed(0)
    before = torch.randn(40, 3, generator=generator)
    groups = torch.arange(40) % 3
    turns = rotations.normalize(torch.randn(3, 4, generator=generator))
    quats = turns[groups]
    offsets = rotations.rotate(quats, before) + groups[:, None] * 0.3 - before
    same = torch.zeros(40, 3)
    assert float(rigidity.stiffness(before, before + offsets, quats, same, groups, int(groups.max()) + 1)) < 1e-10
    bent = before + offsets + 0.1 * before.square()
    assert float(rigidity.stiffness(before, bent, quats, same, groups, int(groups.max()) + 1)) > 1e-4
    found, shift, known = rigidity.rigid_fits(before, before + offsets, groups, int(groups.max()) + 1)
    assert known.all()
    assert rotations.angle_between(found.numpy(), turns.numpy()).max() < 1e-3
    torch.testing.assert_close(shift, torch.arange(3)[:, None].expand(3, 3) * 0.3, atol=1e-5, rtol=0)


def test_stiffness_pulls_every_gaussian_towards_where_its_group_has_it():
    draw = torch.Generator().manual_seed(0)
    before = torch.randn(12, 3, generator=draw, dtype=torch.float64)
    offsets = (0.2 * torch.randn(12, 3, generator=draw, dtype=torch.float64)).requires_grad_(True)
    groups = torch.ones(12, dtype=torch.int64)
    rest = torch.zeros(12, 3, dtype=torch.float64)
    found, shift, _ = rigidity.rigid_fits(before, before + offsets.detach(), groups, int(groups.max()) + 1)
    quats = found[groups]
    loss = rigidity.stiffness(before, before + offsets, quats, rest, groups, int(groups.max()) + 1)
    (gradient,) = torch.autograd.grad(loss, offsets)
    goal = rotations.rotate(quats, before) + shift[groups]
    torch.testing.assert_close(gradient, 2 * (before + offsets - goal).detach() / 12)
