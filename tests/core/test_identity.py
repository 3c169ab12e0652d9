"""Labels and identity encodings agree with the masks that they come from."""

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.report import evaluate, metrics
from r5dgs_core.scene import scene
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.train import identity
from r5dgs_core.train.config import IdentitySection
from r5dgs_core.train.posing import Splats
from r5dgs_core.train.views import TrainView


def row_of_blobs(opacities=(0.9, 0.9, 0.9)):
    """Three blobs side by side before a camera of 30 x 12 pixels, and a mask that names them 0, 5 and 3."""
    camera = Camera(30, 12, np.array([[30.0, 0, 15], [0, 30, 6], [0, 0, 1]]), np.eye(4))
    splats = Splats(
        torch.tensor([[-1.0, 0, 3], [0, 0, 3], [1, 0, 3]]),
        torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4),
        torch.full((3, 3), 0.1),
        torch.tensor(opacities),
        torch.zeros(3, 3),
    )
    mask = np.repeat(np.repeat([[0, 5, 3]], 10, 1), 12, 0).astype(np.int32)
    return TrainView("v", camera, 0.0, np.zeros((12, 30, 3), np.uint8), mask, None), splats


CLASSES = {0: 0, 3: 1, 5: 2}


def test_each_gaussian_gets_the_class_of_the_pixels_that_it_paints():
    view, splats = row_of_blobs()
    labels = identity.vote([view], lambda _: splats, CLASSES, torch.zeros(3, dtype=torch.int64))
    assert labels.tolist() == [0, 2, 1]


def test_gaussians_that_no_mask_shows_keep_what_they_had():
    view, splats = row_of_blobs(opacities=(0.9, 0.0, 0.9))
    labels = identity.vote([view], lambda _: splats, CLASSES, torch.tensor([1, 1, 2]))
    assert labels.tolist() == [0, 1, 1]


def test_ids_without_a_class_do_not_vote():
    view, splats = row_of_blobs()
    labels = identity.vote([view], lambda _: splats, {0: 0, 3: 1}, torch.tensor([1, 0, 0]))
    assert labels.tolist() == [0, 0, 1]
    assert identity.class_map(view, {0: 0, 3: 1})[0].tolist() == [0] * 10 + [-1] * 10 + [1] * 10


@pytest.mark.parametrize("steps", [0, 60])
def test_encodings_start_at_their_labels_and_learn_the_masks(steps):
    view, splats = row_of_blobs()
    wrong = torch.tensor([0, 2, 2])
    section = IdentitySection(iterations=steps, rate=0.1, classifier_rate=0.05)
    losses = []
    encodings, weight, bias = identity.train_encodings(
        [view],
        lambda _: splats,
        CLASSES,
        wrong,
        section,
        torch.Generator().manual_seed(0),
        lambda _, loss: losses.append(loss),
    )
    assert encodings.shape == (3, 16) and weight.shape == (3, 16) and bias.shape == (3,)
    answers = (encodings @ weight.T + bias).argmax(1).tolist()
    assert answers == ([0, 2, 2] if steps == 0 else [0, 2, 1])
    assert steps == 0 or losses[-1] < 0.8 * losses[0]


def test_more_classes_than_dimensions_are_no_obstacle():
    view, splats = row_of_blobs()
    many = {0: 0, 3: 18, 5: 19} | {i: i - 99 for i in range(100, 117)}
    section = IdentitySection(iterations=1)
    _, weight, _ = identity.train_encodings(
        [view], lambda _: splats, many, torch.tensor([0, 19, 18]), section, torch.Generator().manual_seed(0)
    )
    assert weight.shape == (20, scene.IDENTITY_DIM) and torch.isfinite(weight).all()


def test_pixels_of_the_trained_scene_belong_to_the_objects_of_the_masks(baked, tiny):
    counts = np.zeros((3, 3), np.int64)
    for view in datasets.read(tiny.root).train:
        rendering = evaluate.render(baked, view.camera, view.t)
        counts += metrics.confusion(rendering.ids, datasets.load_mask(view), [1, 2])
    assert metrics.miou(counts) > 0.8


def test_members_of_an_object_lie_where_it_is(baked, tiny):
    for k in (1, 2):
        members = baked.means[baked.object_ids == k]
        assert len(members) > 50
        distances = np.linalg.norm(members - tiny.center(k, 0.75), axis=1)
        assert np.quantile(distances, 0.9) < 0.85  # half a diagonal of the brick is 0.72
