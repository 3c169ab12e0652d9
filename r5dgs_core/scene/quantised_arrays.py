"""Quantised stored forms of the arrays of a scene file: half the size of the compact ones (feature `quantised`).

Notation: a stored integer i represents (offset + i) step. Steps are powers of two, so decoded values are exact, and
quantising them again gives the same integers. Members without a form of their own here are stored as compact ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .. import errors
from . import array_encoding
from .array_types import DTYPES, EMBEDDINGS
from .json_row import Row

# Steps of int16 members: a size changes by at most 0.8 %, an opacity by 0.4 %, a colour by 0.3 of 255 per coefficient.
STEPS = {"log_scales": 2.0**-6, "opacity_logits": 2.0**-5, "sh": 2.0**-7, "shading": 2.0**-9, "shading_rest": 2.0**-9}
PLACES = ("means", "canonical_means")  # steps by object, from the sizes of its Gaussians
PLACE_STEP = 1 / 16  # of the size of a small Gaussian of the object
_SMALL = 10  # percentile of the sizes
_BYTES = ("identities",)  # int8, step from the largest magnitude
_HALF = ("dynamics", *EMBEDDINGS)
_SMALLEST_THREE = 511 * np.sqrt(2)  # of a quaternion, whose components other than the largest are below sqrt(1/2)
_ALIKE = 4e-3  # difference of two components of which either may be the largest after rounding
_QUATS_AT_ONCE = 1 << 15
_MAX_STEP, _MIN_STEP = 2.0**60, 2.0**-140
# Further dtypes of stored members.
FURTHER_DTYPES: dict[str, tuple[str, ...]] = {
    "quats": ("|u1",),
    **dict.fromkeys(STEPS, ("<i2",)),
    **dict.fromkeys(PLACES, ("<i2", "<i4")),
    **dict.fromkeys(_BYTES, ("|i1",)),
    **dict.fromkeys(_HALF, ("<f2",)),
}


@dataclass(frozen=True)
class Block:
    """Consecutive rows of an array of positions with one step.

    Attributes:
        rows: Number of rows.
        step: Distance of neighbouring positions along an axis.
        offset: Whole steps from the origin of the scene to the stored zero.
    """

    rows: int
    step: float
    offset: tuple[int, int, int]


@dataclass
class Steps:
    """Content of the entry ``quantised`` of ``scene.json``.

    Attributes:
        members: Step by name of a member.
        places: Blocks that cover all rows, by name of a member of `PLACES`.
    """

    members: dict[str, float] = field(default_factory=dict)
    places: dict[str, tuple[Block, ...]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The entry as JSON types."""
        blocks = {name: [vars(one) for one in found] for name, found in self.places.items()}
        return {"steps": self.members, **blocks}


def encode(arrays: Mapping[str, np.ndarray], counts: Sequence[int]) -> tuple[dict[str, np.ndarray], Steps]:
    """Quantised form of the arrays of a scene.

    Args:
        arrays: Arrays of a valid scene in their in-memory dtypes, C order.
        counts: Numbers of Gaussians of the objects, in the order of their rows.

    Returns:
        The stored arrays by name and the steps of those that were quantised. An array that does not fit its quantised
        form is stored in its compact form.
    """
    steps, stored = Steps(), {}
    sizes = _decoded_sizes(arrays["log_scales"])
    for name, array in arrays.items():
        if name == "quats":
            stored[name] = _encode_quats(array)
        elif name in PLACES:
            stored[name], steps.places[name] = _encode_places(array, sizes, counts)
        elif name in STEPS or name in _BYTES:
            step = _step_of_bytes(array) if name in _BYTES else STEPS[name]
            whole = np.rint(array.astype(np.float32, copy=False) / np.float32(step))
            dtype = np.int8 if name in _BYTES else np.int16
            if array.size == 0 or np.abs(whole).max() <= np.iinfo(dtype).max:
                stored[name], steps.members[name] = whole.astype(dtype), step
            else:
                stored[name] = array_encoding.encode(name, array)
        else:
            stored[name] = array_encoding.as_half(array) if name in _HALF else array_encoding.encode(name, array)
    return stored, steps


def decode(name: str, stored: np.ndarray, steps: Steps, place: str) -> np.ndarray:
    """Array in its in-memory dtype. Raises `SceneFileError` if ``scene.json`` lacks its steps."""
    if name == "quats" and stored.dtype == np.uint8:
        return _decode_quats(stored)
    if name in PLACES and stored.dtype != np.float32:
        blocks = steps.places.get(name, ())
        rows = [one.rows for one in blocks]
        if sum(rows) != len(stored):
            raise errors.SceneFileError(
                f"{place}: {name}: expected blocks of 'quantised' that cover {len(stored)} rows, found {sum(rows)}"
            )
        step = np.repeat([one.step for one in blocks], rows)[:, None]
        offset = np.repeat(np.array([one.offset for one in blocks], np.float64).reshape(-1, 3), rows, axis=0)
        return ((offset + stored) * step).astype(np.float32)
    if name in steps.members and stored.dtype.kind == "i":
        return (stored * np.float64(steps.members[name])).astype(DTYPES[name])
    if stored.dtype.kind == "i" and name not in array_encoding.FIXED_POINT and np.dtype(DTYPES[name]).kind == "f":
        raise errors.SceneFileError(f"{place}: {name}: expected its step in 'quantised', found none")
    return array_encoding.decode(name, stored)


def read(top: Row) -> Steps:
    """Content of the entry ``quantised``. Raises `SceneFileError` for steps and offsets that are out of range."""
    strict = Row(top.data, top.place)
    row = Row(strict.get("quantised", dict), f"{top.place}: quantised")
    members = Row(row.get("steps", dict), f"{row.place}: steps")
    places = {name: row.each(name, _read_block) for name in PLACES if row.has(name)}
    return Steps({name: _read_step(members, name) for name in members.data if name in FURTHER_DTYPES}, places)


def _read_block(row: Row) -> Block:
    rows, offset = row.get("rows", int), row.get("offset", list)
    if rows < 0:
        raise errors.SceneFileError(f"{row.place}: rows: expected a number from 0, found {rows}")
    if len(offset) != 3 or not all(type(each) is int and abs(each) < 1 << 62 for each in offset):
        raise errors.SceneFileError(f"{row.place}: offset: expected three whole numbers, found {offset!r:.60}")
    return Block(rows, _read_step(row, "step"), tuple(offset))


def _read_step(row: Row, key: str) -> float:
    step = row.get(key, float)
    if not _MIN_STEP <= step <= _MAX_STEP:
        raise errors.SceneFileError(f"{row.place}: {key}: expected a step from 2^-140 to 2^60, found {step!r}")
    return step


def _decoded_sizes(log_scales: np.ndarray) -> np.ndarray:
    """Mean log scale of each Gaussian as a reader of the file finds it, so that quantising again gives equal steps."""
    step = STEPS["log_scales"]
    return (np.rint(log_scales.astype(np.float64) / step) * step).mean(axis=-1)


def _encode_places(means: np.ndarray, sizes: np.ndarray, counts: Sequence[int]) -> tuple[np.ndarray, tuple[Block, ...]]:
    """Whole steps of positions, int16 or int32, and their blocks, one for each object with Gaussians."""
    whole, blocks, start = np.empty(means.shape, np.int64), [], 0
    for count in counts:
        if not count:
            continue
        rows = slice(start, start + count)
        start += count
        finest = float(np.spacing(np.abs(means[rows]).max()))  # of float32
        wanted = PLACE_STEP * np.exp(np.clip(np.percentile(sizes[rows], _SMALL), -90.0, 40.0))
        step = max(_power_of_two(float(wanted)), finest, _MIN_STEP)
        units = np.rint(means[rows].astype(np.float64) / step).astype(np.int64)
        offset = (units.min(axis=0) + units.max(axis=0)) // 2
        whole[rows] = units - offset
        blocks.append(Block(int(count), step, tuple(offset.tolist())))
    fits = not whole.size or np.abs(whole).max() <= np.iinfo(np.int16).max
    return whole.astype(np.int16 if fits else np.int32), tuple(blocks)


def _step_of_bytes(array: np.ndarray) -> float:
    """Step by which the largest magnitude becomes 32 to 63, which gives the same step when it is written again."""
    largest = float(np.abs(array).max()) if array.size else 0.0
    return min(max(2 * _power_of_two(largest / 63.5), _MIN_STEP), _MAX_STEP)


def _power_of_two(value: float) -> float:
    """Largest power of two up to a value >= 0; 0 for 0."""
    return float(np.ldexp(1.0, int(np.frexp(value)[1]) - 1)) if value > 0 else 0.0


def _encode_quats(quats: np.ndarray) -> np.ndarray:
    """Four bytes per rotation: the index of its largest component, and the other three in ten bits each.

    Decoded rotations give the same bytes again: they are found among the four choices of the index.
    """
    stored = np.empty((len(quats), 4), np.uint8)
    for start in range(0, len(quats), _QUATS_AT_ONCE):
        rows = slice(start, start + _QUATS_AT_ONCE)
        stored[rows] = _bytes(_settled(_decode_quats(_bytes(_settled(quats[rows])))))
    return stored


def _settled(quats: np.ndarray) -> np.ndarray:
    """Packed form of rotations; for decoded ones, a form that decodes to exactly them. [N] uint32

    Rounding may have made another component the largest.
    """
    sizes = np.abs(quats)
    packed = _packed(quats, sizes.argmax(axis=1))
    alike = sizes > sizes.max(axis=1, keepdims=True) - _ALIKE
    rows = np.flatnonzero(alike.sum(axis=1) > 1)
    rows = rows[(_decode_quats(_bytes(packed[rows])) != quats[rows]).any(axis=1)]
    for index in range(4):
        some = rows[alike[rows, index]]
        other = _packed(quats[some], np.full(len(some), index))
        found = (_decode_quats(_bytes(other)) == quats[some]).all(axis=1)
        packed[some[found]] = other[found]
    return packed


def _packed(quats: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Rotations packed into 32 bits, without the component ``index``, which is made positive. [N] uint32"""
    rows = np.arange(len(quats))
    others = (index[:, None] + np.arange(1, 4)) % 4
    signs = np.where(quats[rows, index] < 0, -1.0, 1.0)[:, None]
    parts = np.rint(quats[rows[:, None], others] * (signs * _SMALLEST_THREE))
    parts = (np.clip(parts, -511, 511) + 512).astype(np.uint32)
    return index.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]


def _bytes(packed: np.ndarray) -> np.ndarray:
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def _decode_quats(stored: np.ndarray) -> np.ndarray:
    """Unit quaternions from four bytes each. [N, 4] float32"""
    packed = np.ascontiguousarray(stored).view("<u4").reshape(-1)
    result = np.empty((len(packed), 4), np.float32)
    for start in range(0, len(packed), _QUATS_AT_ONCE):
        part = packed[start : start + _QUATS_AT_ONCE]
        others = (
            ((part[:, None] >> np.array([20, 10, 0], np.uint32)) & 1023).astype(np.float64) - 512
        ) / _SMALLEST_THREE
        largest = np.sqrt(np.clip(1 - (others * others).sum(axis=1, keepdims=True), 0, None))
        whole = np.concatenate([largest, others], axis=1)
        whole /= np.linalg.norm(whole, axis=1, keepdims=True)
        place = ((part >> 30)[:, None] + np.arange(4)) % 4
        result[start : start + len(part)][np.arange(len(part))[:, None], place] = whole
    return result
