"""The tiny data set and one training of it, made once for all tests that look at them."""

import pytest

from r5dgs_core.data import dataset as datasets
from r5dgs_core.train import bake, run
from tests import datasets as tiny_datasets


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """The data set of `tests/datasets.py` with masks."""
    return tiny_datasets.make_dataset(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="session")
def trained(tiny, tmp_path_factory):
    """A finished run on it."""
    folder = tmp_path_factory.mktemp("runs") / "trained"
    return run.train(tiny.root, folder, tiny_datasets.settings("train.iterations=300"))


@pytest.fixture(scope="session")
def baked(trained, tiny):
    """The scene of that run."""
    return bake.bake(trained, datasets.read(tiny.root))
