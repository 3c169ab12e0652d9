"""Reading and writing `.r5dgs`: one zip of `.npy` arrays and a `scene.json` (docs/scene_format.md).

Members hold what `Scene` holds, under the same names. Some are stored with fewer bits and restored to float32 on
reading: quats, log_scales and opacity_logits as int16 fixed point, sh, shading and residuals as float16 (rotations of
residuals as int16).
"""

from __future__ import annotations

import io
import json
import logging
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors, input_paths
from . import features, files, meanings, playback, scene_json, validation
from .scene import Scene

FORMAT = "r5dgs scene"
JSON_MEMBER = "scene.json"

# Fixed point: stored int16 i stands for i / scale.
FIXED_POINT = {"quats": 32767.0, "residual_quats": 32767.0, "log_scales": 2048.0, "opacity_logits": 1024.0}
_QUATS = ("quats", "residual_quats")
_READ_BEFORE = 1e-7  # float32 rounding of what was read
_QUATS_AT_ONCE = 1 << 15  # what the processor's cache holds
_HALF = ("sh", "shading", "residual_offsets", "residual_log_scales")
_MEMORY_DTYPES: dict[str, type] = {
    "means": np.float32,
    "quats": np.float32,
    "log_scales": np.float32,
    "opacity_logits": np.float32,
    "sh": np.float32,
    "object_ids": np.int32,
    "motion_ids": np.int32,
    "track_times": np.float64,
    "track_poses": np.float64,
    "background_sh": np.float32,
    "identities": np.float16,
    "classifier_weight": np.float32,
    "classifier_bias": np.float32,
    "residual_rows": np.int32,
    "residual_offsets": np.float32,
    "residual_quats": np.float32,
    "residual_log_scales": np.float32,
    "dynamics": np.float32,
    "canonical_means": np.float32,
    "shading": np.float32,
    "shading_rest": np.float32,
    "embeddings": np.float32,
    "vocabulary_embeddings": np.float32,
    "canonical_embeddings": np.float32,
    "view_embeddings": np.float32,
}
_TRACKS = ("track_times", "track_poses")  # left out where nothing moves
_OPTIONAL = (
    *_TRACKS,
    "identities",
    "classifier_weight",
    "classifier_bias",
    "residual_rows",
    "residual_offsets",
    "residual_quats",
    "residual_log_scales",
    "dynamics",
    "canonical_means",
    "shading",
    "shading_rest",
    "embeddings",
    "vocabulary_embeddings",
    "canonical_embeddings",
    "view_embeddings",
)
_STORED_DTYPES = {name: {np.dtype(dtype).newbyteorder("<").str} for name, dtype in _MEMORY_DTYPES.items()}
for _name in FIXED_POINT:
    _STORED_DTYPES[_name].add("<i2")
for _name in _HALF:
    _STORED_DTYPES[_name].add("<f2")
# What zipfile, zlib and numpy raise on damaged bytes; the encrypted flag is a RuntimeError, odd names a ValueError.
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError, ValueError, KeyError)

_log = logging.getLogger(__name__)


def write(scene: Scene, path: str | Path, *, exact: bool = False) -> Path:
    """Write a scene, atomically: the old file stays until the new one is complete and on the disk.

    Args:
        scene: The scene; checked first.
        path: Where to, its folder must exist.
        exact: Store everything in the precision of memory instead of the compact one.

    Returns:
        The path written.
    """
    path = Path(path)
    validation.check(scene, f"{path} (not written)")
    if not path.parent.is_dir():
        raise errors.SceneFileError(f"{path}: expected an existing folder, found none; make {path.parent} first")
    try:
        with files.replacing(path) as stream:
            _write_zip(scene, stream, exact)
    except OSError as error:
        raise errors.SceneFileError(f"{path}: cannot be written: {error}") from error
    return path


def read(path: str | Path) -> Scene:
    """Read and check a scene. Raises `SceneFileError` naming the member and what was expected."""
    with _open(Path(path)) as archive:
        scene = _read_zip(archive, str(path))
    validation.check(scene, str(path))
    return scene


def is_exact(path: str | Path) -> bool:
    """Whether a file stores anything in the precision of memory that the compact form would round: who writes what was
    read of it loses nothing with ``exact``."""
    with _open(Path(path)) as archive:
        listed = scene_json.words(_read_json(archive, str(path)), "arrays", f"{path}: {JSON_MEMBER}")
        for name in (*FIXED_POINT, *_HALF):
            if name in listed and f"{name}.npy" in archive.namelist():
                with archive.open(f"{name}.npy") as stream:
                    np.lib.format.read_magic(stream)
                    if np.lib.format.read_array_header_1_0(stream)[2].itemsize == 4:
                        return True
    return False


def read_meanings(path: str | Path) -> meanings.Meanings | None:
    """Only the stored embeddings of a scene, None where it has none. Raises as `read` does."""
    place = str(path)
    with _open(Path(path)) as archive:
        data = _read_json(archive, place)
        json_place = f"{place}: {JSON_MEMBER}"
        listed = scene_json.words(data, "arrays", json_place)
        arrays = {name: _read_array(archive, name, place, name in listed) for name in validation.EMBEDDINGS}
    objects, words = arrays["embeddings"], arrays["vocabulary_embeddings"]
    if objects is None or words is None:
        return None
    ids = tuple(scene_json.each(data, "objects", lambda row, at: scene_json.get(row, "id", int, at), json_place))
    vocabulary = tuple(scene_json.words(data, "vocabulary", json_place))
    table = scene_json.table(data, json_place)
    validation.check_meanings(arrays, len(ids), len(vocabulary), table, place)
    return meanings.Meanings(
        ids, objects, vocabulary, words, table, arrays["canonical_embeddings"], arrays["view_embeddings"]
    )


def _open(path: Path) -> zipfile.ZipFile:
    try:
        input_paths.check_scene(path)
        return zipfile.ZipFile(path)
    except PermissionError as error:
        raise errors.SceneFileError(f"{path}: cannot be read: {error}; ask for the right to read it") from error
    except (*_BROKEN, struct.error) as error:
        raise errors.SceneFileError(
            f"{path}: expected a .r5dgs file (a zip), found a truncated or foreign file ({error}); "
            "bake or copy it again"
        ) from error


def info(scene: Scene) -> dict[str, Any]:
    """What `r5dgs info` prints, as JSON types."""
    return {
        "name": scene.name,
        "gaussians": len(scene.means),
        "sh_degree": int(np.sqrt(scene.sh.shape[1])) - 1,
        "objects": [
            {"id": o.id, "name": o.name, "aliases": list(o.aliases), "gaussians": o.count} for o in scene.objects
        ],
        "motion_groups": [
            {
                "id": g.id,
                "object": g.object_id,
                "role": g.role,
                "gaussians": int((scene.motion_ids == g.id).sum()),
                "model": g.model.kind if g.follows is None else f"follows {g.follows}",
                "rigid_rms": g.rigid_rms,
            }
            for g in scene.groups
        ],
        "times": [float(scene.track_times[0]), scene.t_max],
        "knots": len(scene.track_times),
        "frames_per_unit": scene.frames_per_unit,
        "world_convention": scene.world_convention,
        "cameras": len(scene.cameras),
        "extent": scene.extent,
        **({"origin": scene.origin.tolist()} if scene.origin.any() else {}),
        "identities": scene.identities is not None,
        "shading": scene.shading is not None,
        "residuals": 0 if scene.residual_rows is None else len(scene.residual_rows),
        "modes": list(playback.modes(scene)),
        "vocabulary": len(scene.vocabulary),
        "lookup": None if scene.lookup is None else f"{scene.lookup.encoder.kind} {scene.lookup.encoder.name}",
        "needs": list(scene.needs),
    }


def _write_zip(scene: Scene, stream: Any, exact: bool) -> None:
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        still = _TRACKS if len(scene.track_times) == 1 else ()  # then every pose is the identity
        arrays = [name for name in _MEMORY_DTYPES if getattr(scene, name) is not None and name not in still]
        head = {"format": FORMAT, "format_version": features.version(scene), "arrays": arrays, **features.dump(scene)}
        _add(archive, JSON_MEMBER, scene_json.dump(scene, head))
        for name in arrays:
            array, dtype = getattr(scene, name), _MEMORY_DTYPES[name]
            buffer = io.BytesIO()
            stored = np.ascontiguousarray(array, dtype) if exact else _encode(name, np.ascontiguousarray(array, dtype))
            np.lib.format.write_array(buffer, stored, version=(1, 0), allow_pickle=False)
            _add(archive, f"{name}.npy", buffer.getvalue())


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    # A fixed date makes equal scenes equal files.
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, data)


def _encode(name: str, array: np.ndarray) -> np.ndarray:
    """Compact form of a member, or the member itself where the compact one cannot hold it."""
    if name in FIXED_POINT:
        scaled = _whole_units(array) if name in _QUATS else np.rint(array.astype(np.float64) * FIXED_POINT[name])
        fits = len(array) == 0 or np.abs(scaled).max() <= 32767
        return scaled.astype("<i2") if fits else array
    if name in _HALF and (array.size == 0 or np.abs(array).max() < 6e4):
        return array.astype("<f2")
    return array


def _whole_units(quats: np.ndarray) -> np.ndarray:
    """Quaternions as whole numbers; those that they were read from, where they were.

    Reading normalises, so that the stored ones may be longer or shorter by their rounding, and others a step beside
    them would be written for what was read.
    """
    unit = FIXED_POINT["quats"]
    result = np.empty(quats.shape)
    for start in range(0, len(quats), _QUATS_AT_ONCE):
        wide = np.ascontiguousarray(
            quats[start : start + _QUATS_AT_ONCE].T, np.float64
        )  # columns: numpy is slow at fours
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
    return array.astype(_MEMORY_DTYPES[name])


def _read_zip(archive: zipfile.ZipFile, place: str) -> Scene:
    data = _read_json(archive, place)
    json_place = f"{place}: {JSON_MEMBER}"
    if skipped := features.skipped(data):
        _log.warning("%s: skipped what this release cannot read: %s", json_place, ", ".join(skipped))
    listed = scene_json.words(data, "arrays", json_place)
    arrays = {name: _read_array(archive, name, place, name in listed) for name in _MEMORY_DTYPES}
    count, means = scene_json.get(data, "gaussians", int, json_place), arrays["means"]
    if means is None or means.shape[:1] != (count,):
        found = None if means is None else means.shape
        raise errors.SceneFileError(
            f"{place}: means.npy: expected {count} rows as in {JSON_MEMBER}, found shape {found}"
        )
    fields = scene_json.fields(data, json_place) | features.fields(data, json_place)
    if not set(listed) & set(_TRACKS):
        arrays["track_times"] = np.array([fields["t_max"]])
        arrays["track_poses"] = np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(fields["groups"]), 1, 1))
    for name in _TRACKS:
        if arrays[name] is None:
            raise errors.SceneFileError(f"{json_place}: arrays: expected both of {' and '.join(_TRACKS)}, or none")
    return Scene(**arrays, **fields)  # type: ignore[arg-type]


def _read_json(archive: zipfile.ZipFile, place: str) -> dict[str, Any]:
    def refuse(constant: str) -> float:
        raise ValueError(f"the number {constant}")

    where = f"{place}: {JSON_MEMBER}"
    if JSON_MEMBER not in archive.namelist():
        raise errors.SceneFileError(f"{where}: expected in a .r5dgs file, not found; this is another kind of zip")
    try:
        data = json.loads(archive.read(JSON_MEMBER).decode("utf-8"), parse_constant=refuse)
    except (*_BROKEN, RecursionError) as error:
        raise errors.SceneFileError(f"{where}: expected readable JSON, found damage ({error})") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise errors.SceneFileError(f'{where}: expected "format": "{FORMAT}", not found; this is another kind of file')
    features.check(data, where)
    return data


def _read_array(archive: zipfile.ZipFile, name: str, place: str, listed: bool) -> np.ndarray | None:
    """One array. An optional one is absent where scene.json does not list it, so that a lost one is noticed."""
    member = f"{name}.npy"
    where = f"{place}: {member}"
    if name in _OPTIONAL and not listed:
        return None
    if member not in archive.namelist():
        raise errors.SceneFileError(f"{where}: expected in a .r5dgs file, not found")
    try:
        data = archive.read(member)
        stream = io.BytesIO(data)
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            raise ValueError(f"npy version {version} instead of (1, 0)")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    except _BROKEN as error:
        raise errors.SceneFileError(f"{where}: expected a readable array, found damage ({error})") from error
    if dtype.str not in _STORED_DTYPES[name] or fortran:
        raise errors.SceneFileError(
            f"{where}: expected dtype {' or '.join(sorted(_STORED_DTYPES[name]))} in C order, "
            f"found {dtype.str}{' in Fortran order' if fortran else ''}"
        )
    size = dtype.itemsize * int(np.prod(shape, dtype=object)) if shape else dtype.itemsize
    if len(data) - stream.tell() != size:
        raise errors.SceneFileError(
            f"{where}: expected {size} bytes for shape {shape}, found {len(data) - stream.tell()}"
        )
    return _decode(name, np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape))
