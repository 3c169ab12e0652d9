"""Data sets with camera files: points of a reconstruction beside them."""

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.data import dataset
from r5dgs_core.data.layouts import camera_files
from tests.core.data.test_dataset import write_flat


def test_points_of_a_reconstruction_are_read_and_belong_to_the_digest(flat):
    table = np.random.default_rng(0).uniform(size=(5, 6))
    before = dataset.read(flat)
    assert before.points is None
    np.save(flat / camera_files.POINTS, table)
    found = dataset.read(flat)
    np.testing.assert_array_equal(found.points, table[:, :3])
    np.testing.assert_allclose(found.point_colors, table[:, 3:], atol=1e-7)
    assert found.digest != before.digest


@pytest.mark.parametrize(
    "content",
    [np.zeros((3, 5)), np.zeros(6), np.full((2, 6), np.nan), np.array([{}], object)],
    ids=["five columns", "one row", "not finite", "objects"],
)
def test_damaged_points_are_refused(flat, content):
    np.save(flat / camera_files.POINTS, content, allow_pickle=True)
    with pytest.raises(errors.DatasetError, match=r"points\.npy.*prepare the data set again") as caught:
        dataset.read(flat)
    assert caught.value.code == "D25"


@pytest.fixture
def flat(tmp_path):
    write_flat(tmp_path / "flat")
    return tmp_path / "flat"
