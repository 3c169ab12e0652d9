"""Reading and writing `.r5dgs`: one zip of `.npy` arrays and a `scene.json` (docs/reference/scene_format.md).

Members have the content and the names of the fields of `Scene`. Some are stored with fewer bits and restored to float32
on reading: quats, log_scales and opacity_logits as int16 fixed point, sh, shading and residuals as float16 (rotations
of residuals as int16).
"""

from __future__ import annotations

import io
import logging
import zipfile
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from .. import atomic_files, errors, findings, strict_json
from . import array_shapes, format_features, scene_json, validation
from .archive import Archive, Header, max_content_bytes
from .array_types import DTYPES, EMBEDDINGS
from .scene import Scene, grouped
from .stored_embeddings import StoredEmbeddings

FORMAT = "r5dgs scene"
JSON_MEMBER = "scene.json"

# Fixed point: a stored int16 i represents i / scale.
FIXED_POINT = {"quats": 32767.0, "residual_quats": 32767.0, "log_scales": 2048.0, "opacity_logits": 1024.0}
_QUATS = ("quats", "residual_quats")
_READ_BEFORE = 1e-7  # float32 rounding error of decoded components
_QUATS_AT_ONCE = 1 << 15  # rows per block, sized for the CPU cache
_HALF = ("sh", "shading", "residual_offsets", "residual_log_scales")
_TRACKS = ("track_times", "track_poses")  # omitted if nothing moves
_REQUIRED = ("means", "quats", "log_scales", "opacity_logits", "sh", "object_ids", "motion_ids", "background_sh")
_STORED_DTYPES = {name: {np.dtype(dtype).newbyteorder("<").str} for name, dtype in DTYPES.items()}
for _name in FIXED_POINT:
    _STORED_DTYPES[_name].add("<i2")
for _name in _HALF:
    _STORED_DTYPES[_name].add("<f2")
_log = logging.getLogger(__name__)


def write(scene: Scene, path: str | Path, *, exact: bool = False) -> Path:
    """Write a scene atomically: the old file is kept until the new one is complete and on disk.

    Args:
        scene: The scene; validated first.
        path: Target file in an existing folder.
        exact: Store all arrays in their in-memory precision instead of the compact one.

    Returns:
        The path written.
    """
    path = Path(path)
    validation.check(scene, f"{path} (not written)")
    if not path.parent.is_dir():
        raise errors.SceneFileError(f"{path}: expected an existing folder, found none; create {path.parent} first")
    try:
        with atomic_files.replacing(path) as stream:
            _write_zip(scene, stream, exact)
    except OSError as error:
        raise errors.SceneFileError(f"{path}: cannot be written: {error}") from error
    return path


def read(path: str | Path, guard: findings.Guard = findings.STRICT) -> Scene:
    """Read and validate a scene. Raises `SceneFileError` naming the member and its expected content.

    Args:
        path: The file.
        guard: Context manager entered around each array, entry and rule, for callers that collect all faults
            (`findings`). Parts whose errors it keeps are `findings.UNREAD` in the result.
    """
    with Archive(Path(path)) as archive:
        scene = _read_zip(archive, guard)
    validation.check(scene, str(path), guard)
    with guard():
        _warn_of_lost_detail(scene, path)
    return scene


def is_exact(path: str | Path) -> bool:
    """Return True if a file stores any array more precisely than the compact form.

    After reading such a file, write with ``exact`` to avoid losses.
    """
    with Archive(Path(path)) as archive:
        headers = _read_headers(archive, _read_json(archive), (*FIXED_POINT, *_HALF))
    return any(header.dtype == "<f4" for header in headers.values())


def read_embeddings(path: str | Path) -> StoredEmbeddings | None:
    """Read only the stored embeddings of a scene; returns None if it has none. Raises as `read` does."""
    place = str(path)
    with Archive(Path(path)) as archive:
        top = _read_json(archive)
        headers = _read_headers(archive, top, EMBEDDINGS)
        ids = top.each("objects", lambda row: row.get("id", int))
        vocabulary = top.words("vocabulary")
        table = scene_json.table(top)
        array_shapes.check_embeddings(_shapes(headers), len(ids), len(vocabulary), table, place)
        arrays = _read_arrays(archive, headers, EMBEDDINGS)
    validation.check_embeddings(arrays, table, place)
    objects, words = arrays["embeddings"], arrays["vocabulary_embeddings"]
    if objects is None or words is None:
        return None
    return StoredEmbeddings(
        ids, objects, vocabulary, words, table, arrays["canonical_embeddings"], arrays["view_embeddings"]
    )


def _warn_of_lost_detail(scene: Scene, path: str | Path) -> None:
    """Warn about a scene baked far from its world's origin without the feature `origin`."""
    some = slice(None, None, max(1, len(scene.gaussians.means) // 1000))
    if len(scene.gaussians.means) < 2:
        return
    step = float(np.spacing(np.abs(np.median(scene.gaussians.means[some], axis=0)).max()))
    size = float(np.exp(np.median(scene.gaussians.log_scales[some].astype(np.float64))))
    if step > 0.2 * size:
        _log.warning(
            "%s: the scene is so far from the origin that its Gaussians, of %.2g units, are positioned only to "
            "%.2g units. "
            "Bake its run again with this release for sharp images",
            path,
            size,
            step,
        )


def _write_zip(scene: Scene, stream: BinaryIO, exact: bool) -> None:
    if not _write_members(scene, stream, exact, zipfile.ZIP_DEFLATED):  # synthetic scenes with many equal rows
        stream.seek(0)
        stream.truncate()
        _write_members(scene, stream, exact, zipfile.ZIP_STORED)


def _write_members(scene: Scene, stream: BinaryIO, exact: bool, compression: int) -> bool:
    """Write the zip; returns False if it compresses so well that readers would reject it as a zip bomb."""
    with zipfile.ZipFile(stream, "w") as archive:
        still = _TRACKS if len(scene.tracks.times) == 1 else ()  # every pose is then the identity
        arrays = {name: array for name, array in scene.arrays().items() if name in DTYPES and name not in still}
        head = {
            "format": FORMAT,
            "format_version": format_features.version(scene),
            "arrays": [name for name in DTYPES if name in arrays],
            **format_features.to_json(scene),
        }
        text = scene_json.dump(scene, head)
        _add(archive, JSON_MEMBER, text, compression)
        for name in head["arrays"]:
            array, dtype = arrays[name], DTYPES[name]
            buffer = io.BytesIO()
            stored = np.ascontiguousarray(array, dtype) if exact else _encode(name, np.ascontiguousarray(array, dtype))
            np.lib.format.write_array(buffer, stored, version=(1, 0), allow_pickle=False)
            _add(archive, f"{name}.npy", buffer.getvalue(), compression)
        content = sum(info.file_size for info in archive.infolist())
        packed = archive.getinfo(JSON_MEMBER).compress_size
    return content <= max_content_bytes(stream.tell()) and strict_json.memory_of(text) <= max_content_bytes(packed)


def _add(archive: zipfile.ZipFile, name: str, data: bytes, compression: int) -> None:
    # A fixed date gives equal scenes identical files.
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.compress_type = compression
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, data, compresslevel=6)


def _encode(name: str, array: np.ndarray) -> np.ndarray:
    """Compact form of an array, or the array itself if the compact form cannot represent it."""
    if name in FIXED_POINT:
        scaled = _whole_units(array) if name in _QUATS else np.rint(array.astype(np.float64) * FIXED_POINT[name])
        fits = len(array) == 0 or np.abs(scaled).max() <= 32767
        return scaled.astype("<i2") if fits else array
    if name in _HALF and (array.size == 0 or np.abs(array).max() < 6e4):
        return array.astype("<f2")
    return array


def _whole_units(quats: np.ndarray) -> np.ndarray:
    """Quantised quaternions; for decoded ones, the stored integers that they were decoded from.

    Decoding normalises, so the stored integers may be slightly longer or shorter than a unit quaternion. Rounding the
    decoded values directly could then give neighbouring integers.
    """
    unit = FIXED_POINT["quats"]
    result = np.empty(quats.shape)
    for start in range(0, len(quats), _QUATS_AT_ONCE):
        wide = np.ascontiguousarray(
            quats[start : start + _QUATS_AT_ONCE].T, np.float64
        )  # by column, because numpy is slow on rows of four
        best = np.rint(wide * unit)
        for radius in (unit - 0.75, unit + 0.75):
            other = np.clip(np.rint(wide * radius), -unit, unit)
            norms = np.sqrt((other * other).sum(0))
            read = (np.abs(other - wide * norms) <= _READ_BEFORE * norms).all(0)
            best = np.where(read, other, best)
        result[start : start + _QUATS_AT_ONCE] = best.T
    return result


def _decode(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype == np.int16:
        values = array.astype(np.float64) / FIXED_POINT[name]
        if name in _QUATS:
            norms = np.linalg.norm(values, axis=-1, keepdims=True)
            values = np.divide(values, norms, out=values, where=np.abs(norms - 1) < 1e-3)
        return values.astype(np.float32)
    return array.astype(DTYPES[name])


def _read_zip(archive: Archive, guard: findings.Guard) -> Scene:
    top = _read_json(archive, guard)
    place = archive.place
    headers = _read_headers(archive, top, DTYPES, guard)
    fields = scene_json.fields(top)
    with guard():
        fields |= format_features.fields(top)
        if skipped := format_features.skipped(top.data):
            _log.warning("%s: skipped features that this release does not support: %s", top.place, ", ".join(skipped))
    shapes = _shapes(headers)
    still = not set(headers) & set(_TRACKS)
    with guard():
        if still:
            shapes |= {"track_times": (1,), "track_poses": (len(fields["groups"]), 1, 7)}
        for name in _TRACKS:
            if name not in headers and not still:
                raise errors.SceneFileError(f"{top.place}: arrays: expected both of {' and '.join(_TRACKS)}, or none")
    with guard():
        count = top.get("gaussians", int)
        found = shapes["means"]
        if count is not findings.UNREAD and found[:1] != (count,):
            shapes["means"] = findings.UNREAD
            raise errors.SceneFileError(
                f"{place}: means.npy: expected {count} rows as in {JSON_MEMBER}, found shape {found}"
            )
    objects, groups, vocabulary, table = (fields[name] for name in ("objects", "groups", "vocabulary", "lookup"))
    sound = array_shapes.check(shapes, objects, groups, vocabulary, table, place, guard)
    arrays = _read_arrays(archive, headers.keys() & sound, DTYPES, guard)
    arrays |= dict.fromkeys(headers.keys() - sound, findings.UNREAD)
    if still:
        arrays["track_times"] = findings.attempt(guard, lambda: np.array([fields["t_max"]], np.float64))
        arrays["track_poses"] = findings.attempt(
            guard, lambda: np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(fields["groups"]), 1, 1))
        )
    if not headers.keys() & {"shading", "shading_rest"}:
        fields["light_direction"] = None  # a light without shading has no effect
    return Scene(**grouped(arrays | fields))


def _read_json(archive: Archive, guard: findings.Guard = findings.STRICT) -> scene_json.Row:
    """Content of the JSON member, or `findings.UNREAD` if it is not valid JSON and the guard keeps the error.

    A file of another kind or version always raises, because its arrays may have another meaning.
    """
    where = f"{archive.place}: {JSON_MEMBER}"
    if JSON_MEMBER not in archive:
        raise errors.SceneFileError(f"{where}: expected in a .r5dgs file, not found; this is another kind of zip")
    data = findings.attempt(guard, lambda: _parse_json(archive, where))
    if data is not findings.UNREAD:
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise errors.SceneFileError(
                f'{where}: expected "format": "{FORMAT}", not found; this is another kind of file'
            )
        format_features.check(data, where)
    return scene_json.Row(data, where, guard)


def _parse_json(archive: Archive, where: str) -> Any:
    if archive.size(JSON_MEMBER) > strict_json.MAX_BYTES:
        raise errors.SceneFileError(
            f"{where}: expected at most {strict_json.MAX_BYTES >> 20} MiB, found {archive.size(JSON_MEMBER) >> 20} MiB"
        )
    memory = min(strict_json.MAX_MEMORY, max_content_bytes(archive.compressed_size(JSON_MEMBER)))
    remedy = "bake or copy the file again"
    return strict_json.parse(archive.read(JSON_MEMBER), where, errors.SceneFileError, remedy, memory=memory)


def _read_headers(
    archive: Archive, top: scene_json.Row, names: Iterable[str], guard: findings.Guard = findings.STRICT
) -> dict[str, Header]:
    """Headers of the requested arrays that a file has; `findings.UNREAD` if the guard keeps the error.

    Optional arrays count as present only if scene.json lists them, so that a lost one is detected.
    """
    listed = top.words("arrays")
    if listed is findings.UNREAD:
        listed = [name for name in names if f"{name}.npy" in archive]
    wanted = [name for name in names if name in listed or name in _REQUIRED]
    headers: dict[str, Header] = {}
    for name in wanted:
        with guard():
            if f"{name}.npy" not in archive:
                headers[name] = findings.UNREAD
                raise errors.SceneFileError(f"{archive.place}: {name}.npy: expected in a .r5dgs file, not found")
    for name in wanted:
        if name not in headers:
            headers[name] = findings.attempt(
                guard, lambda name=name: archive.header(f"{name}.npy", _STORED_DTYPES[name])
            )
    return headers


def _shapes(headers: dict[str, Header]) -> dict[str, tuple[int, ...]]:
    return {name: findings.UNREAD if header is findings.UNREAD else header.shape for name, header in headers.items()}


def _read_arrays(
    archive: Archive, there: Collection[str], names: Iterable[str], guard: findings.Guard = findings.STRICT
) -> dict[str, np.ndarray | None]:
    """Arrays in their in-memory dtypes, None for those that the file lacks."""

    def read_one(name: str) -> np.ndarray:
        return _decode(name, archive.array(f"{name}.npy", _STORED_DTYPES[name]))

    return {
        name: findings.attempt(guard, lambda name=name: read_one(name)) if name in there else None for name in names
    }
