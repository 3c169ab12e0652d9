"""Gaussians in the PLY files of 3D Gaussian Splatting and Gaussian Grouping.

Columns are read by name, because tools order them differently: x y z, f_dc_0..2, f_rest_* (all red, then green, then
blue), opacity (logit), scale_0..2 (natural logarithm), rot_0..3 (wxyz, normalised here), obj_dc_0..15 (identity
encoding) and obj_id. Other columns and elements are skipped.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from .. import atomic_files, errors, findings
from ..motion import rotations
from ..playback import played_splats
from ..playback.scene_player import Player
from ..scene import validation
from ..scene.scene import Scene
from ..scene.splats import Splats
from . import registry, scene_nodes

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_HEADER_LIMIT = 1 << 16
_LONGEST_NUMBER = 400  # characters, including the separator
_MAX_DIGITS = 18  # digits of a row count


def write(
    splats: Splats,
    path: str | Path,
    *,
    plain: bool = False,
    origin: np.ndarray | None = None,
    comments: Sequence[str] = (),
) -> Path:
    """Write a binary little-endian PLY, atomically.

    Args:
        splats: The Gaussians.
        path: Target file.
        plain: Omit identities and ids, for viewers that reject unknown columns.
        origin: Point of the world that the centres are relative to, stored in a header comment; zero if None. [3]
        comments: Further comments of the header, ASCII.

    Returns:
        The path written.
    """
    path = Path(path)
    columns = _columns(splats, plain)
    data = np.empty(len(splats.means), [(name, "<f4") for name, _ in columns])
    for name, values in columns:
        data[name] = values
    header = ["ply", "format binary_little_endian 1.0", "comment SplatRenderMode: default"]
    if origin is not None and np.any(origin):
        header.append("comment origin " + " ".join(repr(float(value)) for value in origin))
    header += [f"comment {text}" for text in comments]
    header += [f"element vertex {len(data)}", *(f"property float {name}" for name, _ in columns)]
    with registry.writing(path), atomic_files.replacing(path) as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        stream.write(data.tobytes())
    return path


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the Gaussians at each time, in the world of the scene file. Implements `registry.Format.write`."""
    player = Player(scene)
    for t, target in scene_nodes.files(scene, options, FORMAT.paths(path, options, scene)):
        splats = played_splats.at(player, t, options.object_ids)
        comments = _bands(scene, t, options.object_ids)
        yield write(splats, target, plain=options.plain, origin=scene.origin, comments=comments)


def _bands(scene: Scene, t: float, object_ids: Collection[int] | None) -> list[str]:
    """Return a comment for each motion group with a confidence band past t_max: object id, half width, half angle."""
    if t <= scene.t_max:
        return []
    shown = [g for g in scene.groups if g.role == "body" and (object_ids is None or g.object_id in object_ids)]
    found = [(g.object_id, g.history.band) for g in shown if g.history.band is not None]
    times = np.array([t])
    return [
        f"band {object_id} {band.level:g} {band.widths(times)[0]:.6g} {band.angles(times)[0]:.6g}"
        for object_id, band in found
    ]


FORMAT = registry.Format(
    name="ply",
    label="Gaussians",
    suffix=".ply",
    keeps="Gaussians of one time with their shading, object ids and identity encodings; one file per frame",
    loses="motion between frames, names of objects, sky, cameras",
    write=export,
    per_frame=True,
    has_columns=True,
    losses=scene_nodes.lost_frames,
)


def read(path: str | Path, guard: findings.Guard = findings.STRICT) -> Splats:
    """Read a PLY of Gaussians, ascii or binary of either byte order. Raises `SceneFileError` if it is damaged or lacks
    a column.

    Args:
        path: The file.
        guard: Context manager entered around each header statement, text row and group of columns, for callers that
            collect all faults (`findings`). Parts whose errors it keeps are `findings.UNREAD` in the result.
    """
    path = Path(path)
    try:
        with open(path, "rb") as stream:
            table = _read_vertices(stream, str(path), guard)
    except OSError as error:
        raise errors.SceneFileError(f"{path}: cannot be read: {error}") from error
    return _to_splats(table, str(path), guard)


def _columns(splats: Splats, plain: bool) -> list[tuple[str, np.ndarray]]:
    """Names and values of the columns in 3DGS order."""
    zeros = np.zeros(len(splats.means), np.float32)
    columns = [(name, splats.means[:, i]) for i, name in enumerate("xyz")]
    columns += [(name, zeros) for name in ("nx", "ny", "nz")]
    columns += [(f"f_dc_{c}", splats.sh[:, 0, c]) for c in range(3)]
    rest = splats.sh.shape[1] - 1
    columns += [(f"f_rest_{c * rest + k}", splats.sh[:, 1 + k, c]) for c in range(3) for k in range(rest)]
    columns += [("opacity", splats.opacity_logits)]
    columns += [(f"scale_{i}", splats.log_scales[:, i]) for i in range(3)]
    columns += [(f"rot_{i}", splats.quats[:, i]) for i in range(4)]
    if splats.identities is not None and not plain:
        columns += [(f"obj_dc_{i}", splats.identities[:, i]) for i in range(splats.identities.shape[1])]
    if splats.object_ids is not None and not plain:
        columns += [("obj_id", splats.object_ids)]  # a float, as some readers take all columns for floats
    return columns


def _read_header(
    stream: BinaryIO, place: str, guard: findings.Guard
) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]]]:
    """Format, and for each element its name, count and properties (name, numpy type; "list" for lists)."""
    if stream.readline(8).strip() != b"ply":
        raise errors.SceneFileError(f"{place}: expected a PLY file, found another kind (no 'ply' in the first line)")
    layout, elements = "", []
    fault = None
    while True:
        raw = stream.readline(_HEADER_LIMIT)
        if not raw.endswith(b"\n") or stream.tell() > 1 << 22:
            raise errors.SceneFileError(f"{place}: expected 'end_header', found the end of the file; it is truncated")
        words = raw.decode("ascii", "replace").split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "end_header":
            break
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS:
            layout = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdigit() and len(words[2]) <= _MAX_DIGITS:
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            elements[-1][2].append((words[2], _TYPES[words[1]]))
        elif words[0] == "property" and elements and words[1:2] == ["list"] and len(words) == 5:
            elements[-1][2].append((words[4], "list"))
        else:
            fault = errors.SceneFileError(f"{place}: header: expected a PLY statement, found {' '.join(words)!r}")
            with guard():
                raise fault
    if fault:
        raise fault  # even if the guard kept it, because the column positions are now unknown
    if not layout:
        raise errors.SceneFileError(f"{place}: header: expected one of the formats {', '.join(_ORDERS)}, found none")
    return layout, elements


def _read_vertices(stream: BinaryIO, place: str, guard: findings.Guard) -> np.ndarray:
    """Vertex element as a structured array, without rows if the guard keeps an error of them."""
    layout, elements = _read_header(stream, place, guard)
    for name, count, properties in elements:
        if any(kind == "list" for _, kind in properties):
            raise errors.SceneFileError(f"{place}: expected the vertices first and without lists, found {name!r}")
        if len({column for column, _ in properties}) != len(properties):
            raise errors.SceneFileError(f"{place}: element {name}: expected unique property names")
        dtype = np.dtype([(column, _ORDERS[layout] + kind) for column, kind in properties])
        table = np.empty(0, dtype)
        with guard() if name == "vertex" else findings.STRICT():
            table = _read_rows(stream, layout, count, dtype, f"{place}: element {name}", guard)
        if name == "vertex":
            return table
    raise errors.SceneFileError(f"{place}: expected an element 'vertex', found {[e[0] for e in elements]}")


def _read_rows(
    stream: BinaryIO, layout: str, count: int, dtype: np.dtype, place: str, guard: findings.Guard
) -> np.ndarray:
    columns = len(dtype.names or ())
    least = 2 * columns - 1 if layout == "ascii" else dtype.itemsize  # least bytes per row
    left = os.fstat(stream.fileno()).st_size - stream.tell()
    if count and (not columns or count * least > left + 1):  # the last line may lack its newline
        raise errors.SceneFileError(
            f"{place}: expected {count} rows of at least {least} bytes, found {left} bytes; the file is truncated"
        )
    if layout == "ascii":
        return _read_ascii(stream, count, dtype, place, guard)
    data = stream.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise errors.SceneFileError(
            f"{place}: expected {count} rows of {dtype.itemsize} bytes, found {len(data)} bytes; the file is truncated"
        )
    return np.frombuffer(data, dtype) if count else np.empty(0, dtype)


def _read_ascii(stream: BinaryIO, count: int, dtype: np.dtype, place: str, guard: findings.Guard) -> np.ndarray:
    table = np.zeros(count, dtype)
    names = dtype.names or ()
    limit = _LONGEST_NUMBER * (len(names) + 1)
    for row in range(count):
        line = stream.readline(limit)
        words = line.split()
        with guard():
            if len(words) != len(names):
                raise errors.SceneFileError(f"{place}: row {row}: expected {len(names)} numbers, found {len(words)}")
            try:
                table[row] = tuple(float(word) for word in words)
            except (ValueError, OverflowError) as error:
                raise errors.SceneFileError(f"{place}: row {row}: expected numbers, found {words[:4]}") from error
        if not line:
            break
    return table


def _to_splats(table: np.ndarray, place: str, guard: findings.Guard) -> Splats:
    names = table.dtype.names or ()

    def stack(columns: list[str]) -> np.ndarray:
        there = [column for column in columns if column in names]
        with guard():
            if there != columns:
                missing = ", ".join(column for column in columns if column not in names)
                raise errors.SceneFileError(f"{place}: expected the columns of a Gaussian splat, not found: {missing}")
        with guard():
            with np.errstate(over="ignore"):  # values beyond float32 become infinite
                values = np.stack([table[column].astype(np.float32) for column in there], axis=-1)
            if not np.isfinite(values).all():
                row = int(np.flatnonzero(~np.isfinite(values).all(-1))[0])
                raise errors.SceneFileError(f"{place}: row {row}: expected finite {there[0]}.., found NaN or infinity")
            if there == columns:
                return values
        return findings.UNREAD

    def harmonics() -> np.ndarray:
        if not higher:
            return np.ascontiguousarray(base[:, None])
        channels = rest.reshape(len(table), 3, -1).transpose(0, 2, 1)
        return np.ascontiguousarray(np.concatenate([base[:, None], channels], axis=1))

    higher, encoding = (sum(name.startswith(start) for name in names) for start in ("f_rest_", "obj_dc_"))
    with guard():
        if higher not in (0, 9, 24, 45):
            raise errors.SceneFileError(f"{place}: expected 0, 9, 24 or 45 columns f_rest_*, found {higher}")
    base = stack([f"f_dc_{c}" for c in range(3)])
    rest = stack([f"f_rest_{i}" for i in range(higher)]) if higher else base
    quats = stack([f"rot_{i}" for i in range(4)])
    splats = Splats(
        means=stack(list("xyz")),
        quats=findings.attempt(guard, lambda: rotations.normalize(quats.astype(np.float64)).astype(np.float32)),
        log_scales=stack([f"scale_{i}" for i in range(3)]),
        opacity_logits=findings.attempt(guard, lambda: stack(["opacity"])[:, 0]),
        sh=findings.attempt(guard, harmonics),
        identities=stack([f"obj_dc_{i}" for i in range(encoding)]) if encoding else None,
        object_ids=findings.attempt(guard, lambda: _whole(table["obj_id"], f"{place}: obj_id"))
        if "obj_id" in names
        else None,
    )
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh", "identities"):
        with guard():
            if getattr(splats, name) is not None:
                validation.check_range(name, getattr(splats, name), place)
    return splats


def _whole(values: np.ndarray, place: str) -> np.ndarray:
    """Convert ids to int32, with a range check."""
    least, most = np.iinfo(np.int32).min, np.iinfo(np.int32).max
    bad = ~((values >= least) & (values <= most))
    if bad.any():
        raise errors.SceneFileError(f"{place}: expected whole numbers from {least} to {most}, found {values[bad][0]:g}")
    return values.astype(np.int32)
