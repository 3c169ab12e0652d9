"""Forward pass of the `cpu` backend, on float32 arrays and any number of threads. Results do not depend on that number.

It needs numpy and numba alone. `autograd` adds gradients, `static_layer` reuses the pass for moving Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...scene.cameras import Camera
from ..backend import ViewPoses
from ..settings import RasterSettings, frustum_slopes
from ..thread_pool import run
from . import blend, projection, sh_kernels
from . import segments as cpu_segments
from . import tiles as cpu_tiles

WORTH_A_THREAD = 2000  # Gaussians per thread; fewer are projected before a second thread wakes up
_FEW_LABELS = 16  # labels below this are used without removing gaps
_MAX_LABEL = 1 << 24  # labels below this are exact in float32
# Distance of log2(alpha) from a threshold below which float64 decides: several times the largest rounding error of thin
# Gaussians at the usual dilation. The error grows with the whitening.
_CLOSE_LOG2, _USUAL_DILATION = 2e-4, 0.3
_NO_FACTOR = np.empty(0, np.float32)


@dataclass(frozen=True)
class CallArguments:
    """Arguments of a call other than its tensors."""

    camera: Camera
    view: np.ndarray
    limits: np.ndarray
    names_votes: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(cls, camera: Camera, settings: RasterSettings, labels: np.ndarray | None = None) -> CallArguments:
        """Pack the arguments of a call. Raises ValueError if a label is 2^24 or more."""
        return cls(camera, pack_view(camera, settings), pack_limits(settings), pack_labels(labels))


@dataclass(frozen=True)
class ForwardState:
    """State of the forward pass for the backward pass, never exposed."""

    geometry: np.ndarray
    depths: np.ndarray
    tile_starts: np.ndarray
    tile_ends: np.ndarray
    pair_rows: np.ndarray
    pair_slots: np.ndarray
    pair_blocks: np.ndarray
    slot_starts: np.ndarray
    transmittance: np.ndarray
    last_pairs: np.ndarray


def pack_view(camera: Camera, settings: RasterSettings) -> np.ndarray:
    """Camera and settings of the projection, in the order of the constants in `projection`. [26] float64"""
    k, T = camera.intrinsics, camera.T_cam_world
    return np.array(
        [
            *(k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]),
            *frustum_slopes(camera, settings),
            *(camera.width, camera.height, settings.near_plane, settings.dilation, settings.alpha_min),
            *T[:3, :3].ravel(),
            *T[:3, 3],
        ],
        np.float64,
    )


def project(
    view: np.ndarray, arrays: Sequence[np.ndarray], geometry: np.ndarray, depths: np.ndarray, boxes: np.ndarray,
    radii: np.ndarray,
) -> None:  # fmt: skip
    """Project means, quats, scales and opacities; results as in `projection.project`."""
    means, quats, scales, opacities = arrays
    run(
        projection.project, len(opacities) // WORTH_A_THREAD,
        view, means.reshape(-1), quats.reshape(-1), scales.reshape(-1), opacities, geometry, depths, boxes, radii,
    )  # fmt: skip


def pack_limits(settings: RasterSettings) -> np.ndarray:
    """Thresholds in the order of the constants in `exact_thresholds`. [6] float64"""
    return np.array(
        [
            math.log2(settings.alpha_min),
            math.log2(settings.alpha_max),
            settings.alpha_max,
            settings.finished_at,
            settings.id_alpha_min,
            _CLOSE_LOG2 * max(1.0, math.sqrt(_USUAL_DILATION / settings.dilation)),
        ]
    )


def pack_background(background: np.ndarray | None, n_channels: int) -> np.ndarray:
    """Background as one row for all pixels [1, D], or one per pixel [H * W, D]; float32."""
    if background is None:
        return np.zeros((1, n_channels), np.float32)
    return np.ascontiguousarray(background, np.float32).reshape(-1, n_channels)


def pack_labels(labels: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Distinct labels, ascending, negative ones as -1 [L] float32, and the index of each Gaussian's label [N] int32.

    Raises:
        ValueError: A label is 2^24 or more.
    """
    if labels is None:
        return np.empty(0, np.float32), np.empty(0, np.int32)
    numbers = to_numbers(labels)
    most = numbers.max(initial=-1)
    if most < _FEW_LABELS and numbers.min(initial=-1) >= -1:  # one plane per number, without a search for gaps
        return np.arange(-1, most + 1, dtype=np.float32), (numbers + 1).astype(np.int32)
    names, places = np.unique(np.maximum(numbers, -1), return_inverse=True)
    return names.astype(np.float32), places.astype(np.int32)


def to_numbers(labels: np.ndarray) -> np.ndarray:
    """Convert labels of any integer type to int64. Raises ValueError if one is 2^24 or more."""
    numbers = labels.astype(np.int64)
    if len(numbers) and numbers.max() >= _MAX_LABEL:
        at = numbers.argmax()
        raise ValueError(f"labels: expected at most {_MAX_LABEL - 1}, found {numbers[at]} at index {at}")
    return numbers


def aligned(shape: tuple[int, int], dtype: type) -> np.ndarray:
    """Allocate an array aligned to 64 bytes, so that each row of 64 bytes is one cache line."""
    size = shape[0] * shape[1] * np.dtype(dtype).itemsize
    memory = np.empty(size + 64, np.uint8)
    skip = -memory.ctypes.data % 64
    return memory[skip : skip + size].view(dtype).reshape(shape)


def segment_weights(
    shapes: Sequence[np.ndarray], camera: Camera, segments: np.ndarray, count: int, settings: RasterSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Implement `Backend.segment_weights` for means, quats, scales and opacities; one entry per tile.

    ``segments`` are int32, -1 for none. [H, W]
    """
    plan = CallArguments.of(camera, settings)
    state, *_ = rasterize([*shapes, shapes[3][:, None]], None, plan, True, with_slots=False)
    assert state is not None
    starts = np.append(0, np.cumsum(_kinds_per_tile(segments) * (state.tile_ends - state.tile_starts[:-1])))
    counts = np.zeros(len(state.tile_ends), np.int64)
    entries = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32), np.empty(starts[-1], np.float32)
    run(
        cpu_segments.weigh_segments, len(counts) // 2,
        state.tile_starts, state.tile_ends, state.pair_rows, state.pair_blocks, state.geometry, state.depths,
        plan.limits, state.last_pairs, segments, count, starts, counts, *entries,
    )  # fmt: skip
    written = [slice(start, start + of_tile) for start, of_tile in zip(starts, counts, strict=False)]
    rows, names, weights = (np.concatenate([array[part] for part in written]) for array in entries)
    return rows, names, weights


def _kinds_per_tile(segments: np.ndarray) -> np.ndarray:
    """Number of segments in each tile. [H, W] -> [tiles] int64"""
    size = projection.TILE
    rows, columns = (-(-side // size) for side in segments.shape)
    padded = np.full((rows * size, columns * size), -1, np.int32)
    padded[: segments.shape[0], : segments.shape[1]] = segments
    tiles = padded.reshape(rows, size, columns, size).swapaxes(1, 2).reshape(rows * columns, size * size)
    tiles = np.sort(np.maximum(tiles, -1), axis=1)
    return (tiles[:, 0] >= 0) + (np.diff(tiles, axis=1) > 0).sum(axis=1)


def rasterize(
    arrays: Sequence[np.ndarray],
    background: np.ndarray | None,
    plan: CallArguments,
    with_state: bool,
    with_slots: bool = True,
) -> tuple[ForwardState | None, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project, sort, assign and blend means, quats, scales, opacities and channels.

    Returns:
        The state or None, image, alpha, depth, ids and radii. The state supports gradients only if ``with_slots``.
    """
    *shapes, channels = arrays
    (n, n_channels), height, width = channels.shape, plan.camera.height, plan.camera.width
    rows = projection.padded_rows(n)
    geometry = aligned((rows, projection.GEOMETRY), np.float64)
    depths, boxes, radii = np.empty(rows), np.empty(rows), np.empty(rows, np.float32)
    project(plan.view, shapes, geometry, depths, boxes, radii)
    order = cpu_tiles.sort_by_depth(depths, radii)
    tile_starts, pair_rows, pair_slots, slot_starts = cpu_tiles.assign_tiles(
        order, boxes, geometry, width, height, with_state and with_slots
    )
    names, votes = plan.names_votes
    image = np.empty((height, width, n_channels), np.float32)
    alpha, depth = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    ids = np.full((height, width) if len(names) else (0, 0), -1, np.int32)
    transmittance, last_pairs = (np.empty((height, width) if with_state else (0, 0), np.float32) for _ in range(2))
    tiles = np.arange(len(tile_starts) - 1)
    tile_ends, pair_blocks = np.empty(len(tiles), np.int64), np.empty(len(pair_rows), np.uint64)
    run(
        blend.blend, len(tiles) // 2,
        tiles, tile_starts, pair_rows, geometry, channels, depths, votes, names,
        pack_background(background, n_channels), plan.limits, image, alpha, depth, transmittance, last_pairs, ids,
        tile_ends, pair_blocks,
    )  # fmt: skip
    state = None
    if with_state:
        state = ForwardState(
            geometry, depths, tile_starts, tile_ends, pair_rows, pair_slots, pair_blocks, slot_starts, transmittance,
            last_pairs,
        )  # fmt: skip
    return state, image, alpha, depth, ids, radii[:n]


def seen_colors(
    means: np.ndarray, sh: np.ndarray, rest: np.ndarray | None, factor: np.ndarray | None, poses: ViewPoses
) -> np.ndarray:
    """Implement `shade.seen_colors`. [N, 3] float32"""
    colors = np.empty((len(means), 3), np.float32)
    run(sh_kernels.shade, len(means) // WORTH_A_THREAD, *shade_inputs(means, sh, rest, factor, poses), colors)
    return colors


def shade_inputs(
    means: np.ndarray, sh: np.ndarray, rest: np.ndarray | None, factor: np.ndarray | None, poses: ViewPoses
) -> tuple:
    """Arguments of `sh_kernels.shade` and `sh_kernels.shade_backward`, in their order."""
    constants = sh.reshape(-1)
    if rest is None:
        count = sh.shape[1]
        coefficients = (constants, 3 * count, constants, 3, 3 * count, count)
    else:
        count = 1 + rest.shape[1]
        coefficients = (constants, 3, rest.reshape(-1), 0, 3 * (count - 1), count)
    return means, poses.eyes, poses.maps, poses.ids, *coefficients, _NO_FACTOR if factor is None else factor
