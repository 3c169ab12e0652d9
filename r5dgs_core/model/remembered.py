"""Result of a function of a tensor, kept as long as the tensor stays the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from torch import Tensor

T = TypeVar("T")


class Remembered(Generic[T]):
    """Last result of a function; it is computed again after the tensor was replaced or changed in place.

    Attributes:
        value: The result; None before the first one.
    """

    def __init__(self):
        self.value: T | None = None
        self._tensor: Tensor | None = None
        self._version = 0

    def of(self, tensor: Tensor, function: Callable[[Tensor], T]) -> T:
        """Return the function's result for a tensor."""
        if self.value is None or self._tensor is not tensor or self._version != tensor._version:
            self.value, self._tensor, self._version = function(tensor), tensor, tensor._version
        return self.value
