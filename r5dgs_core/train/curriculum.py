"""Order of the training views: it starts at one time, adds the others outwards, and then takes all views in turn."""

from __future__ import annotations

import math

import numpy as np
import torch

from ..config.config import Config


class Curriculum:
    """Times that take part in training, and the views still to be drawn.

    Args:
        config: The run's configuration.
        view_times: Knot of each view. [V]
        knots: Number of observed times.
        first: Knot that training starts with.

    Attributes:
        entered: First and last knot in training.
        queue: Views still to be drawn once all times have entered, the next one last.
    """

    def __init__(self, config: Config, view_times: np.ndarray, knots: int, first: int):
        self.entered = (first, first)
        self.queue: list[int] = []
        self._section = config.curriculum
        self._begin, self._full = config.curriculum.steps(config.train.iterations)
        self._view_times = view_times
        self._last = knots - 1
        self._first = first

    def grow(self, iteration: int) -> list[tuple[int, int, tuple[int, int]]]:
        """Add the knots that enter at a step.

        Return for each the knot, the direction of its neighbours (+1 or -1), and the range of knots in training before
        it was added.
        """
        reach, found = self._reach(iteration), []
        while self.entered[0] > max(0, self._first - reach):
            found.append((self.entered[0] - 1, +1, self.entered))
            self.entered = (self.entered[0] - 1, self.entered[1])
        while self.entered[1] < min(self._last, self._first + reach):
            found.append((self.entered[1] + 1, -1, self.entered))
            self.entered = (self.entered[0], self.entered[1] + 1)
        return found

    def _reach(self, iteration: int) -> int:
        """Return the distance from the first knot up to which knots take part."""
        most, stages = max(self._first, self._last - self._first), self._section.stages
        if iteration < self._begin or most == 0:
            return 0
        if iteration >= self._full:
            return most
        span = max(1, self._full - self._begin)
        if stages > 1:
            entered = 1 + (iteration - self._begin) * (stages - 1) // span
            return min(most, math.ceil(most * entered / stages))
        return min(most, 1 + (iteration - self._begin) * most // span)

    def draw(self, iteration: int, generator: torch.Generator) -> int:
        """Return the index of the view of a step.

        Until all times have entered, it is drawn at random, often from the newest times; afterwards the views are taken
        in shuffled order.
        """
        if iteration >= self._full:
            if not self.queue:
                self.queue = torch.randperm(len(self._view_times), generator=generator).tolist()
            return self.queue.pop()
        low, high = self.entered
        inside = (self._view_times >= low) & (self._view_times <= high)
        newest = (self._view_times == low) | (self._view_times == high)
        chance, pick = torch.rand(2, generator=generator).tolist()
        pool = np.flatnonzero(newest if chance < self._section.newest and newest.any() else inside)
        if len(pool) == 0:
            pool = np.arange(len(self._view_times))
        return int(pool[min(int(pick * len(pool)), len(pool) - 1)])
