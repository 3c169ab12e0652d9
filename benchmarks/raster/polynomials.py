"""Other polynomials for the exponential of the `cpu` backend, each compiled in its own process.

Kernels are compiled once per process and cached on disk, so another polynomial needs its own process and cache.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch

from .. import timing

POINTS = 2001  # points of [-1/2, 1/2] at which errors are evaluated
SWEEPS = 400  # iterations; more change nothing in float32


def fit(degree: int) -> tuple[float, ...]:
    """Minimax polynomial of 2^x on [-1/2, 1/2], exact at 0: it minimises the largest relative error.

    Returns:
        Coefficients, the constant 1 first.

    Source: Lawson 1961: least squares with weights that grow with the error converge to the minimax solution.
    """
    x = 0.5 * np.cos(np.linspace(0, np.pi, POINTS))
    columns = x[:, None] ** np.arange(1, degree + 1) * np.exp2(-x)[:, None]
    target = 1 - np.exp2(-x)  # relative error of 1 + c1 x + ... : columns @ c - target
    weights = np.full(POINTS, 1 / POINTS)
    best, least = np.zeros(degree), np.inf
    for _ in range(SWEEPS):
        root = np.sqrt(weights)
        coefficients = np.linalg.lstsq(columns * root[:, None], target * root, rcond=None)[0]
        error = np.abs(columns @ coefficients - target)
        if error.max() < least:
            best, least = coefficients, error.max()
        weights = weights * error
        weights /= weights.sum()
    return (1.0, *best.tolist())


def worst_error(coefficients: tuple[float, ...]) -> float:
    """Largest relative error on [-1/2, 1/2], in exact arithmetic."""
    x = np.linspace(-0.5, 0.5, POINTS)
    return float(np.abs(np.polynomial.polynomial.polyval(x, coefficients) / np.exp2(x) - 1).max())


class Remote(timing.Contender):
    """Contender that draws in its own process, with another polynomial. Close it when done."""

    def __init__(self, label: dict[str, Any], coefficients: tuple[float, ...], make_run: Callable[[], Callable]):
        """Start the process; ``make_run``, called there, gives the function that returns the image as a tensor."""
        super().__init__(label, self.draw)
        self._folder = tempfile.TemporaryDirectory(prefix="r5dgs-polynomial-")
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, coefficients, make_run), daemon=True)
        before = os.environ.get("NUMBA_CACHE_DIR")
        os.environ["NUMBA_CACHE_DIR"] = self._folder.name
        try:
            self._process.start()
        finally:
            os.environ.pop("NUMBA_CACHE_DIR")
            if before is not None:
                os.environ["NUMBA_CACHE_DIR"] = before

    def draw(self) -> torch.Tensor:
        """The image."""
        return torch.from_numpy(self._ask("draw"))

    def prepare(self) -> None:
        self._ask("prepare")

    def take_turn(self) -> tuple[float, float]:
        return self._ask("turn")

    def close(self) -> None:
        """End the process and delete its machine code."""
        self._connection.close()
        self._process.join()
        self._folder.cleanup()

    def _ask(self, request: str) -> Any:
        self._connection.send(request)
        try:
            return self._connection.recv()
        except EOFError:
            raise RuntimeError(f"{self.label}: the process ended; its message is above") from None


def _serve(connection: Connection, coefficients: tuple[float, ...], make_run: Callable[[], Callable]) -> None:
    """Process requests until the other end closes."""
    from r5dgs_core.raster import thread_pool
    from r5dgs_core.raster.cpu.simd import float32x16

    float32x16._EXP2 = coefficients
    torch.set_num_threads(1)
    thread_pool.set_threads(1)
    contender = timing.Contender({}, make_run())
    while True:
        try:
            request = connection.recv()
        except EOFError:
            return
        if request == "draw":
            connection.send(contender.run().numpy())
        else:
            connection.send(contender.prepare() if request == "prepare" else contender.take_turn())
