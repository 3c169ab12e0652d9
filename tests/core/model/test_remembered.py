"""A result is computed once for a tensor, and again after the tensor was replaced or changed in place."""

import torch

from r5dgs_core.model.remembered import Remembered


def test_a_result_is_kept_until_its_tensor_changes():
    computed = []
    kept: Remembered[int] = Remembered()

    def total(tensor):
        computed.append(int(tensor.sum()))
        return computed[-1]

    values = torch.tensor([1, 2])
    assert [kept.of(values, total), kept.of(values, total)] == [3, 3] and computed == [3]
    values[0] = 5
    assert kept.of(values, total) == 7
    assert kept.of(values.clone(), total) == kept.value == 7
    assert computed == [3, 7, 7]
