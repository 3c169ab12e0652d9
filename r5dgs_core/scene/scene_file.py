"""Reading and writing `.r5dgs`: one zip of `.npy` arrays and a `scene.json` (docs/reference/scene_format.md).

Members have the content and the names of the fields of `Scene`. Some are stored with fewer bits and restored to float32
on reading (`array_encoding`, `quantised_arrays`).
"""

from __future__ import annotations

import io
import logging
import zipfile
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, BinaryIO, Literal, get_args

import numpy as np

from .. import atomic_files, errors, findings, strict_json
from . import array_encoding, array_shapes, format_features, quantised_arrays, scene_json, validation
from .archive import Archive, Header, max_content_bytes
from .array_types import DTYPES, EMBEDDINGS
from .scene import Scene, grouped
from .stored_embeddings import StoredEmbeddings

FORMAT = "r5dgs scene"
JSON_MEMBER = "scene.json"

_TRACKS = ("track_times", "track_poses")  # omitted if nothing moves
_REQUIRED = ("means", "quats", "log_scales", "opacity_logits", "sh", "object_ids", "motion_ids", "background_sh")
_STORED_DTYPES = {name: {np.dtype(dtype).newbyteorder("<").str} for name, dtype in DTYPES.items()}
for _name in array_encoding.FIXED_POINT:
    _STORED_DTYPES[_name].add("<i2")
for _name in array_encoding.HALF:
    _STORED_DTYPES[_name].add("<f2")
_QUANTISED_DTYPES = {
    name: {*own, *quantised_arrays.FURTHER_DTYPES.get(name, ())} for name, own in _STORED_DTYPES.items()
}
Precision = Literal["exact", "compact", "quantised"]
_QUANTISED_LEVEL = 3  # of deflate; 6 takes four times as long for 2 % of the size, as the integers are noise
_log = logging.getLogger(__name__)


def write(scene: Scene, path: str | Path, *, precision: Precision = "compact") -> Path:
    """Write a scene atomically: the old file is kept until the new one is complete and on disk.

    Args:
        scene: The scene; validated first.
        path: Target file in an existing folder.
        precision: "exact" stores all arrays as they are in memory, "compact" with errors that no picture shows, and
            "quantised" at half the size of "compact", with the errors in docs/reference/scene_format.md.

    Returns:
        The path written.
    """
    path = Path(path)
    validation.check(scene, f"{path} (not written)")
    if not path.parent.is_dir():
        raise errors.SceneFileError(f"{path}: expected an existing folder, found none; create {path.parent} first")
    try:
        with atomic_files.replacing(path) as stream:
            _write_zip(scene, stream, precision)
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


def precision_of(path: str | Path) -> Precision:
    """Return the precision with which to write a scene that was read from a file, to lose nothing.

    It is "exact" if the file stores any array more precisely than its compact form.
    """
    with Archive(Path(path)) as archive:
        top = _read_json(archive)
        if format_features.is_quantised(top.data):
            return "quantised"
        headers = _read_headers(archive, top, (*array_encoding.FIXED_POINT, *array_encoding.HALF))
    return "exact" if any(header.dtype == "<f4" for header in headers.values()) else "compact"


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
        arrays = _read_arrays(archive, top, headers, EMBEDDINGS)
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


def _write_zip(scene: Scene, stream: BinaryIO, precision: Precision) -> None:
    if not _write_members(scene, stream, precision, zipfile.ZIP_DEFLATED):  # synthetic scenes with many equal rows
        stream.seek(0)
        stream.truncate()
        _write_members(scene, stream, precision, zipfile.ZIP_STORED)


def _write_members(scene: Scene, stream: BinaryIO, precision: Precision, compression: int) -> bool:
    """Write the zip; returns False if it compresses so well that readers would reject it as a zip bomb."""
    with zipfile.ZipFile(stream, "w") as archive:
        still = _TRACKS if len(scene.tracks.times) == 1 else ()  # every pose is then the identity
        given = scene.arrays()
        arrays = {
            name: np.ascontiguousarray(given[name], DTYPES[name]) for name in DTYPES if name in given.keys() - {*still}
        }
        stored, steps = _stored(scene, arrays, precision)
        head = {
            "format": FORMAT,
            "format_version": format_features.version(scene, steps is not None),
            "arrays": list(stored),
            **format_features.to_json(scene, steps),
        }
        text = scene_json.dump(scene, head)
        _add(archive, JSON_MEMBER, text, compression)
        for name, array in stored.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, array, version=(1, 0), allow_pickle=False)
            _add(archive, f"{name}.npy", buffer.getvalue(), compression, 6 if steps is None else _QUANTISED_LEVEL)
        content = sum(info.file_size for info in archive.infolist())
        packed = archive.getinfo(JSON_MEMBER).compress_size
    return content <= max_content_bytes(stream.tell()) and strict_json.memory_of(text) <= max_content_bytes(packed)


def _stored(
    scene: Scene, arrays: dict[str, np.ndarray], precision: Precision
) -> tuple[dict[str, np.ndarray], quantised_arrays.Steps | None]:
    """Arrays as they are stored, and the steps of quantised ones. Raises ValueError for an unknown precision."""
    if precision == "quantised":
        return quantised_arrays.encode(arrays, [item.count for item in scene.objects])
    if precision not in ("exact", "compact"):
        raise ValueError(f"precision: expected one of {', '.join(get_args(Precision))}, got {precision!r}")
    exact = precision == "exact"
    return {name: array if exact else array_encoding.encode(name, array) for name, array in arrays.items()}, None


def _add(archive: zipfile.ZipFile, name: str, data: bytes, compression: int, level: int = 6) -> None:
    # A fixed date gives equal scenes identical files.
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.compress_type = compression
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, data, compresslevel=level)


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
    arrays = _read_arrays(archive, top, headers.keys() & sound, DTYPES, guard)
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
    dtypes = _dtypes(top)
    headers: dict[str, Header] = {}
    for name in wanted:
        with guard():
            if f"{name}.npy" not in archive:
                headers[name] = findings.UNREAD
                raise errors.SceneFileError(f"{archive.place}: {name}.npy: expected in a .r5dgs file, not found")
    for name in wanted:
        if name not in headers:
            headers[name] = findings.attempt(guard, lambda name=name: archive.header(f"{name}.npy", dtypes[name]))
    return headers


def _shapes(headers: dict[str, Header]) -> dict[str, tuple[int, ...]]:
    return {name: findings.UNREAD if header is findings.UNREAD else header.shape for name, header in headers.items()}


def _dtypes(top: scene_json.Row) -> dict[str, set[str]]:
    """Dtypes that stored arrays may have, by name."""
    quantised = top.data is findings.UNREAD or format_features.is_quantised(top.data)
    return _QUANTISED_DTYPES if quantised else _STORED_DTYPES


def _read_arrays(
    archive: Archive,
    top: scene_json.Row,
    there: Collection[str],
    names: Iterable[str],
    guard: findings.Guard = findings.STRICT,
) -> dict[str, np.ndarray | None]:
    """Arrays in their in-memory dtypes, None for those that the file lacks."""
    dtypes, place = _dtypes(top), archive.place
    steps = findings.UNREAD
    if top.data is not findings.UNREAD:
        quantised = format_features.is_quantised(top.data)
        steps = findings.attempt(guard, lambda: quantised_arrays.read(top) if quantised else None)

    def read_one(name: str) -> np.ndarray:
        array = archive.array(f"{name}.npy", dtypes[name])
        if steps is None or (steps is findings.UNREAD and array.dtype.str in _STORED_DTYPES[name]):
            return array_encoding.decode(name, array)
        return findings.UNREAD if steps is findings.UNREAD else quantised_arrays.decode(name, array, steps, place)

    return {
        name: findings.attempt(guard, lambda name=name: read_one(name)) if name in there else None for name in names
    }
