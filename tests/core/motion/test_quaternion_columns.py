"""Operations on columns equal those on rows."""

import numpy as np

from r5dgs_core.motion import quaternion_columns, rotations

RNG = np.random.default_rng(3)
QUATS, OTHERS = rotations.normalize(RNG.normal(size=(2, 7, 4)))
VECTORS = RNG.normal(size=(7, 3))


def test_columns_equal_rows():
    product, turned = quaternion_columns.multiply(QUATS.T, OTHERS.T), quaternion_columns.rotate(QUATS.T, VECTORS.T)
    change = quaternion_columns.direction_changes(QUATS.T, VECTORS[0])
    np.testing.assert_allclose(product.T, rotations.multiply(QUATS, OTHERS), atol=1e-15)
    np.testing.assert_allclose(turned.T, rotations.rotate(QUATS, VECTORS), atol=1e-14)
    np.testing.assert_allclose(
        change.T, rotations.rotate(rotations.conjugate(QUATS), VECTORS[0]) - VECTORS[0], atol=1e-14
    )
