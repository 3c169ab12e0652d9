"""Training views read their pixels within a bounded memory, which never changes results."""

import dataclasses

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images
from r5dgs_core.errors import DatasetError
from r5dgs_core.train import train_views
from r5dgs_core.train.normalization import Normalization
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

UNCHANGED = Normalization(np.zeros(3), 1.0)
TWO_IMAGES = 2 * 3 * 48 * 36 / 2**30  # GB


def loaded(dataset, memory=np.inf):
    return train_views.load(dataset, UNCHANGED, train_views.behind(dataset, tiny_datasets.settings()), memory)


@pytest.fixture(scope="module")
def transparent(tmp_path_factory):
    return datasets.read(tiny_datasets.make_dataset(tmp_path_factory.mktemp("alpha"), views=2, alpha=True).root)


@pytest.mark.parametrize("kind", ["opaque", "transparent"])
def test_pixels_do_not_depend_on_the_memory(tiny, transparent, kind):
    dataset = transparent if kind == "transparent" else datasets.read(tiny.root)
    for one, other in zip(loaded(dataset), loaded(dataset, 1.0), strict=True):
        for mine, its in ((one.image, other.image), (one.mask, other.mask), (one.alpha, other.alpha)):
            assert np.array_equal(mine, its)
            assert mine is None or mine.dtype == np.uint8


def test_images_are_those_of_the_data_set(tiny, transparent):
    for dataset in (datasets.read(tiny.root), transparent):
        for given, view in zip(dataset.train, loaded(dataset, 1.0), strict=True):
            assert np.array_equal(view.image, np.round(255 * datasets.load_image(given)))
            assert np.array_equal(view.mask, datasets.load_mask(given))
            if dataset.has_alpha:
                assert np.array_equal(view.alpha, np.round(255 * datasets.load_rgba(given)[..., 3]))


def test_the_pixels_in_memory_stay_within_the_limit(tiny):
    limit = 20_000
    views = loaded(datasets.read(tiny.root), limit)
    cache = views[0].load_image.cache
    for view in train_views.in_turn(views, train_views.IMAGE, train_views.MASK):
        _ = view.image, view.mask
        assert 0 < cache.nbytes <= limit
    train_views.forget(views)
    assert cache.nbytes == 0


@pytest.mark.heavy
def test_training_gives_the_same_bits_with_hardly_any_memory(tiny):
    found = []
    for memory in (1.0, TWO_IMAGES):
        dataset = datasets.read(tiny.root)
        # The tests share the initial state of views of equal names.
        named = tuple(dataclasses.replace(view, name=f"{view.name} {memory}") for view in dataset.train)
        settings = tiny_datasets.settings("train.iterations=60", "identity.training=detached")
        trainer = Trainer(dataclasses.replace(dataset, train=named), settings.replace(**{"data.memory": memory}))
        while not trainer.done:
            trainer.step()
        found.append(trainer.state().tensors)
    assert found[0].keys() == found[1].keys()
    assert all(torch.equal(tensor, found[1][name]) for name, tensor in found[0].items())


def test_a_damaged_image_is_refused_before_training(tiny, tmp_path):
    dataset = datasets.read(tiny.root)
    file = tmp_path / "cut.png"
    file.write_bytes(dataset.train[3].image_path.read_bytes()[:200])
    broken = dataclasses.replace(dataset.train[3], image_path=file)
    with pytest.raises(DatasetError, match="cut.png: the image cannot be decoded"):
        loaded(dataclasses.replace(dataset, train=(*dataset.train[:3], broken, *dataset.train[4:])))


def test_an_image_that_changed_its_size_is_refused(tiny, tmp_path):
    view = datasets.read(tiny.root).train[0]
    images.write_png(tmp_path / "small.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(DatasetError, match="the image changed: 4x4 now, 48x36"):
        datasets.load_image_8bit(dataclasses.replace(view, image_path=tmp_path / "small.png"))


@pytest.mark.parametrize("kind", ["RGB", "opaque RGBA", "RGBA", "gray", "16 bits"])
def test_images_in_8_bits_are_rounded_images(tiny, tmp_path, kind):
    rng, view = np.random.default_rng(0), datasets.read(tiny.root).train[0]
    shape = (36, 48, {"gray": 1, "opaque RGBA": 4, "RGBA": 4}.get(kind, 3))
    pixels = rng.integers(0, 256, shape).astype(np.uint8)
    if kind == "opaque RGBA":
        pixels[..., 3] = 255
    images.write_png(tmp_path / "it.png", pixels.astype(np.uint16) * 250 if kind == "16 bits" else pixels)
    view = dataclasses.replace(view, image_path=tmp_path / "it.png")
    expected = np.round(255 * datasets.load_image(view, np.array([0.2, 0.4, 0.6])))
    found = datasets.load_image_8bit(view, np.array([0.2, 0.4, 0.6]))
    assert found.dtype == np.uint8
    assert np.array_equal(found, expected)


def test_functions_of_images_are_computed_when_they_are_used(tiny):
    first = loaded(datasets.read(tiny.root), 1.0)[0]
    held = train_views.of_arrays("held", first.camera, 0.0, first.image)
    for view in (first, held):
        assert np.array_equal(view.with_image_function("inverse", lambda image: 255 - image).image, 255 - first.image)


def test_views_take_other_masks_one_for_each(tiny):
    views = loaded(datasets.read(tiny.root))[:2]
    first, second = train_views.with_masks(views, [np.zeros((2, 2)), np.ones((2, 2))])
    assert (first.mask == 0).all()
    assert (second.mask == 1).all()
    with pytest.raises(ValueError, match="a mask for each of 2 views, got 1"):
        train_views.with_masks(views, [np.zeros((2, 2))])
