import numpy as np
import torch

from r5dgs_core.model import track_state
from r5dgs_core.model.tracks import Tracks
from r5dgs_core.motion import rotations
from r5dgs_core.train import checkpoint_content, part_clusters

KNOTS = np.linspace(0.0, 1.0, 9)


def arm_paths(rng, count=120, noise=0.002, bend=1.4, turn=0.6):
    """Paths of the points of two links, canonical positions first, and the link of each point."""
    links = np.repeat([0, 1], [count, count // 2])
    points = rng.uniform([0, -0.1, -0.1], [1, 0.1, 0.1], (len(links), 3))
    points[links == 1, 0] = 1 + 0.7 * points[links == 1, 0]
    paths = [points]
    for t in KNOTS:
        upper = rotations.rotvecs_to_quats(np.array([0.0, turn * t, 0.0]))
        own = rotations.rotvecs_to_quats(np.array([0.0, -bend * t, 0.0]))
        elbow = np.array([1.0, 0.0, 0.0])
        bent = np.where(links[:, None] == 1, elbow + rotations.rotate(own[None], points - elbow), points)
        paths.append(rotations.rotate(upper[None], bent))
    return np.stack(paths, 1) + noise * rng.normal(size=(len(links), len(KNOTS) + 1, 3)), links


def test_the_links_of_an_arm_are_found():
    rng = np.random.default_rng(0)
    paths, links = arm_paths(rng)
    labels = part_clusters.find(paths, np.ones(len(paths)), rng)
    assert labels is not None and labels.max() == 1
    assert (labels == links).mean() > 0.93  # near the joint both motions are alike
    assert part_clusters.distance(paths, np.ones(len(paths)), labels) < 0.02


def test_links_that_hardly_bend_are_found():
    rng = np.random.default_rng(0)
    paths, links = arm_paths(rng, bend=0.2, turn=0.0)
    labels = part_clusters.find(paths, np.ones(len(paths)), rng)
    assert labels is not None and (labels == links).mean() > 0.9


def test_a_rigid_body_and_too_few_points_have_no_parts():
    rng = np.random.default_rng(1)
    paths, links = arm_paths(rng, bend=0.0)
    assert part_clusters.find(paths, np.ones(len(paths)), rng) is None
    assert part_clusters.find(paths[:10], np.ones(10), rng) is None


def test_a_split_state_moves_each_part_along_its_paths():
    rng = np.random.default_rng(2)
    paths, links = arm_paths(rng, noise=0.0)
    n, rest = len(links), 7
    shadow = 3
    tracks = Tracks(
        KNOTS,
        torch.zeros(3, 3),
        torch.zeros(3, len(KNOTS), 3),
        torch.from_numpy(rotations.identity(3, len(KNOTS))).float(),
        torch.tensor([1]),
    )
    ids = torch.tensor([0] * rest + [1] * n + [2] * 4 + [shadow] * 3)
    tensors = {"gaussians.motion_ids": ids, **track_state.tensors_of(tracks)}
    tensors["adam.translations.exp_avg"] = torch.ones(3, len(KNOTS), 3)
    rows = np.arange(rest, rest + n)
    found = part_clusters.split(tensors, 1, rows, links, paths, np.ones(n))
    new = track_state.tracks_of(found)
    assert new.owners.tolist() == [0, 1, 2, 1]
    assert found["gaussians.motion_ids"].tolist() == [0] * rest + [1, 3] * 0 + np.where(links == 1, 3, 1).tolist() + (
        [2] * 4 + [4] * 3
    )
    assert found["adam.translations.exp_avg"].shape[0] == 4
    assert found["tracks.owners"].dtype in checkpoint_content._WHOLE
    for s, t in enumerate(KNOTS):
        poses = new.poses(float(t))
        for link, body in ((0, 1), (1, 3)):
            x = torch.from_numpy(paths[links == link, 0]).float() - new.centers[body]
            moved = new.centers[body] + x @ poses.rotmats[body].T + poses.displacements[body]
            np.testing.assert_allclose(moved.detach(), paths[links == link, s + 1], atol=2e-5)
    assert tracks.owners.tolist() == [0, 1, 2]


def test_tracks_without_parts_have_no_owners_in_a_checkpoint():
    still = Tracks(KNOTS, torch.zeros(2, 3), torch.zeros(2, 9, 3), torch.zeros(2, 9, 4))
    assert track_state.OWNERS not in track_state.tensors_of(still)
