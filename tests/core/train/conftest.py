"""A trainer that continues the trained run of the tiny scene."""

import pytest

from r5dgs_core.data import dataset as datasets
from r5dgs_core.train import checkpoint
from r5dgs_core.train.trainer import Trainer


@pytest.fixture
def trainer(tiny, trained):
    """Trainer in the state of the last checkpoint."""
    made = Trainer(datasets.read(tiny.root), trained.config)
    made.restore(checkpoint.load(trained.folder))
    return made
