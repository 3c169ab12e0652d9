"""Float64 decisions at the thresholds, for the few pixels that float32 cannot decide.

A contribution near ``alpha_min``, or a pixel near ``transmittance_min``, is kept or dropped as a whole, so a rounding
error at the threshold changes the pixel by much more than a rounding error elsewhere. The blending kernels therefore
call these helpers for such pixels. See `batches` for blocks, lanes and tiles.
"""

from __future__ import annotations

import numpy as np

from ..compilation import helper
from .projection import L11, L12, L22, LOG2_OPACITY, MEAN_X, MEAN_Y
from .simd.float32x16 import LANES

BLOCK = 4  # px, side of a block, which has LANES pixels
BLOCKS = 8  # blocks along each side of a tile

# Relative distance of the transmittance from its minimum beyond which float32 decides, far above its rounding.
CLOSE_TRANSMITTANCE = 2e-4

# Entries of the limits vector. CLOSE_LOG2: distance of log2(alpha) from a threshold beyond which float32 decides.
LOG2_ALPHA_MIN, LOG2_ALPHA_MAX, ALPHA_MAX, TRANSMITTANCE_MIN, ID_ALPHA_MIN, CLOSE_LOG2 = range(6)


@helper
def log2_alpha(geometry, i, x, y):
    """Log2 of the contribution of Gaussian i, before the cap, at a point of the image in px."""
    dx, dy = x - geometry[i, MEAN_X], y - geometry[i, MEAN_Y]
    u = geometry[i, L11] * dx - geometry[i, L12] * dy
    v = geometry[i, L22] * dy
    return geometry[i, LOG2_OPACITY] - u * u - v * v


@helper
def lanes_at_least(bits, geometry, i, x0, y0, block, threshold):
    """Subset of the lanes ``bits`` of a block in which Gaussian i reaches a threshold (log2 of alpha)."""
    kept = np.uint64(0)
    left, top = x0 + block % BLOCKS * BLOCK + 0.5, y0 + block // BLOCKS * BLOCK + 0.5
    for lane in range(LANES):
        bit = np.uint64(1) << np.uint64(lane)
        if bits & bit and log2_alpha(geometry, i, left + lane % BLOCK, top + lane // BLOCK) >= threshold:
            kept |= bit
    return kept


@helper
def lanes_that_finish(bits, geometry, pair_rows, pair_blocks, begin, end, x0, y0, block, limits):
    """Subset of the lanes ``bits`` of a block whose transmittance the pairs begin : end bring below the minimum.

    ``pair_blocks`` holds the blocks that each pair contributes to.
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
