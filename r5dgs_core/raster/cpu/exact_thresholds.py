"""Decisions at the cut-offs as float64 takes them, for the few pixels where float32 cannot tell.

A contribution right at ``alpha_min``, or a pixel right at ``transmittance_min``, is kept or dropped as a whole:
rounding that tips the balance would change the pixel by far more than rounding. The kernels that blend therefore ask
here whenever they come close. Blocks, lanes and tiles are those of `blend`.
"""

from __future__ import annotations

import numpy as np

from .compilation import helper
from .projection import L11, L12, L22, LOG2_OPACITY, MEAN_X, MEAN_Y
from .simd.float32x16 import LANES

BLOCK = 4  # px, width and height of a block; LANES pixels
BLOCKS = 8  # blocks along each side of a tile

# Relative distance of transmittance from its minimum beyond which float32 decides, far above its rounding.
CLOSE_TRANSMITTANCE = 2e-4

# Entries of the limits vector; CLOSE_LOG2 is the distance of log2(alpha) from a cut-off beyond which float32 decides.
LOG2_ALPHA_MIN, LOG2_ALPHA_MAX, ALPHA_MAX, TRANSMITTANCE_MIN, ID_ALPHA_MIN, CLOSE_LOG2 = range(6)


@helper
def log2_alpha(geometry, i, x, y):
    """Logarithm to base 2 of what Gaussian i contributes, before the cap, at a point of the image in px."""
    dx, dy = x - geometry[i, MEAN_X], y - geometry[i, MEAN_Y]
    u = geometry[i, L11] * dx - geometry[i, L12] * dy
    v = geometry[i, L22] * dy
    return geometry[i, LOG2_OPACITY] - u * u - v * v


@helper
def lanes_at_least(bits, geometry, i, x0, y0, block, threshold):
    """Those of the lanes ``bits`` of a block where the contribution of Gaussian i reaches a threshold (log2)."""
    kept = np.uint64(0)
    left, top = x0 + block % BLOCKS * BLOCK + 0.5, y0 + block // BLOCKS * BLOCK + 0.5
    for lane in range(LANES):
        bit = np.uint64(1) << np.uint64(lane)
        if bits & bit and log2_alpha(geometry, i, left + lane % BLOCK, top + lane // BLOCK) >= threshold:
            kept |= bit
    return kept


@helper
def lanes_that_finish(bits, geometry, pair_rows, pair_blocks, begin, end, x0, y0, block, limits):
    """Those of the lanes ``bits`` of a block whose pixel the pairs begin : end bring below the minimal transmittance.

    ``pair_blocks`` says on which blocks each of these pairs drew anything.
    """
    finished = np.uint64(0)
    left, top = x0 + block % BLOCKS * BLOCK + 0.5, y0 + block // BLOCKS * BLOCK + 0.5
    for lane in range(LANES):
        bit = np.uint64(1) << np.uint64(lane)
        if not bits & bit:
            continue
        x, y, passed = left + lane % BLOCK, top + lane // BLOCK, 1.0
        for pair in range(begin, end):
            if not pair_blocks[pair] >> np.uint64(block) & np.uint64(1):
                continue
            exponent = log2_alpha(geometry, pair_rows[pair], x, y)
            if exponent >= limits[LOG2_ALPHA_MIN]:
                passed *= 1 - min(2.0**exponent, limits[ALPHA_MAX])
        if passed < limits[TRANSMITTANCE_MIN]:
            finished |= bit
    return finished
