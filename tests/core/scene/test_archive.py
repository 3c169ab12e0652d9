import dataclasses
import io
import json
import os
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.scene import archive, scene_file
from tests.support.scenes import make_scene

pytestmark = pytest.mark.heavy

READERS = (scene_file.read, scene_file.read_embeddings, scene_file.precision_of)
SPENT = 24 << 20  # bytes that a refusal may take


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return scene_file.write(make_scene(n=60), tmp_path_factory.mktemp("archive") / "scene.r5dgs")


def members(path):
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def write(target, content, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(target, "w", compression, compresslevel=9) as file:
        for name, data in content.items():
            file.writestr(name, data)
    return target


def array(shape, dtype, data=b""):
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + data


def stream_zeros(target, others, name, head, size):
    """A zip with a member of a head and so many zero bytes, which is never held in memory."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file:
        for other, data in others.items():
            file.writestr(other, data)
        with file.open(name, "w", force_zip64=True) as stream:
            stream.write(head)
            for _ in range(size >> 20):
                stream.write(bytes(1 << 20))
    return target


def assert_refused_cheaply(path, message, readers=READERS):
    for reader in readers:
        tracemalloc.start()
        try:
            with pytest.raises(errors.SceneFileError, match=message) as caught:
                reader(path)
            assert tracemalloc.get_traced_memory()[1] < SPENT
        finally:
            tracemalloc.stop()
        assert str(path) in str(caught.value)


def test_a_bomb_of_consistent_zeros_is_refused_before_it_is_inflated(path, tmp_path):
    content, count = members(path), (300 << 20) // 12
    tree = json.loads(content["scene.json"]) | {"gaussians": count}
    others = content | {"scene.json": json.dumps(tree).encode()}
    del others["means.npy"]
    bomb = stream_zeros(tmp_path / "bomb.r5dgs", others, "means.npy", array((count, 3), "<f4"), 300 << 20)
    assert bomb.stat().st_size < 1 << 20
    assert_refused_cheaply(bomb, "declared")


@pytest.mark.slow
def test_a_scene_json_of_gigabytes_is_refused(path, tmp_path):
    others = members(path)
    text = others.pop("scene.json")
    assert_refused_cheaply(stream_zeros(tmp_path / "a.r5dgs", others, "scene.json", text, 300 << 20), "declared")


@pytest.mark.parametrize("unit", [b"{},", b"[],", b"0,", b'{"a":0},'])
def test_a_scene_json_whose_values_take_more_memory_than_a_scene_of_its_size_is_refused(path, tmp_path, unit):
    text = b'{"format": "r5dgs scene", "provenance": [' + unit * 600_000 + b"0]}"
    bomb = write(tmp_path / "bomb.r5dgs", members(path) | {"scene.json": text})
    assert_refused_cheaply(bomb, "MiB of memory")


@pytest.mark.parametrize(
    "head",
    [
        array((10**12, 3), "<f4"),
        array("(1000000000000000000, 1000000000000000000, 1000000000000000000)", "<f4"),
        array((-1, 3), "<f4"),
        array("(True, 3)", "<f4"),
        array("(" + "9" * 400 + ", 3)", "<f4"),
        array("(" + "1, " * 60 + ")", "<f4"),
        array((), "<f4", b"0000"),
        array((60, 3), "<Q4", bytes(720)),
        array((60, 3), "|V12", bytes(720)),
        array("(60, 3", "<f4", bytes(720)),
        array("[60, 3]", "<f4", bytes(720)),
        array("(60, 3)\n  (", "<f4", bytes(720)),
        array("((60, 3)", "<f4", bytes(720)),
        b"\x93NUMPY\x01\x00\x10\x00" + b"(" * 16,
        b"\x93NUMPY\x02\x00" + array((60, 3), "<f4", bytes(720))[8:],
        b"",
    ],
)
def test_an_odd_array_header_is_one_error_that_names_the_member(path, tmp_path, head):
    broken = write(tmp_path / "broken.r5dgs", members(path) | {"means.npy": head})
    assert_refused_cheaply(broken, r"means\.npy", (scene_file.read,))


def test_shapes_are_compared_with_the_counts_before_any_array_is_read(path, tmp_path, monkeypatch):
    monkeypatch.setattr(archive.Archive, "array", None)
    content = members(path)
    for name, wrong in {"quats": (61, 4), "sh": (60, 5, 3), "track_poses": (9, 13, 7), "motion_ids": (60, 1)}.items():
        data = np.zeros(wrong, {"quats": "<i2", "motion_ids": "<i4", "track_poses": "<f8"}.get(name, "<f4"))
        stream = io.BytesIO()
        np.save(stream, data)
        broken = write(tmp_path / "broken.r5dgs", content | {f"{name}.npy": stream.getvalue()})
        with pytest.raises(errors.SceneFileError, match=f"{name}: expected"):
            scene_file.read(broken)


def with_false_size(path, target, member, change):
    """Copy a file with the declared size of a member changed in both of its headers, and with the CRC that fits."""
    data, content = bytearray(path.read_bytes()), members(path)[member]
    with zipfile.ZipFile(path) as file:
        info = file.getinfo(member)
    size, crc = info.file_size + change, zlib.crc32((content + bytes(max(change, 0)))[: info.file_size + change])
    at = data.rindex(b"PK\x01\x02", 0, data.rindex(member.encode()))
    for start in (info.header_offset + 14, at + 16):
        data[start : start + 4] = crc.to_bytes(4, "little")
        data[start + 8 : start + 12] = size.to_bytes(4, "little")
    target.write_bytes(data)
    return target


@pytest.mark.parametrize("change", [-10, 10])
@pytest.mark.parametrize("member", ["scene.json", "means.npy"])
def test_a_member_that_inflates_to_another_size_than_declared_is_an_error(path, tmp_path, member, change):
    broken = with_false_size(path, tmp_path / "broken.r5dgs", member, change)
    with pytest.raises(errors.SceneFileError, match=member):
        scene_file.read(broken)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_duplicate_members_are_refused(path, tmp_path):
    target = tmp_path / "double.r5dgs"
    target.write_bytes(path.read_bytes())
    with zipfile.ZipFile(target, "a") as file:
        file.writestr("means.npy", members(path)["means.npy"])
    assert_refused_cheaply(target, r"'means\.npy' twice")


@pytest.mark.slow
def test_a_scene_whose_json_compresses_like_a_bomb_can_be_read_again(tmp_path):
    scene = dataclasses.replace(make_scene(n=60), provenance={"zeros": [0] * 600_000})
    assert scene_file.read(scene_file.write(scene, tmp_path / "zeros.r5dgs")).provenance == scene.provenance


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_duplicate_among_many_members_is_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "many.r5dgs", "w") as file:
        for name in (*map(str, range(2000)), "z", "z"):
            file.writestr(name, b"")
    with pytest.raises(errors.SceneFileError, match="'z' twice"):
        scene_file.read(tmp_path / "many.r5dgs")


def test_members_that_overlap_are_refused(path, tmp_path):
    data = bytearray(write(tmp_path / "a.r5dgs", members(path), zipfile.ZIP_STORED).read_bytes())
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        infos = file.infolist()
    at = data.index(b"PK\x01\x02")
    for info in infos:  # each member from its own start to the end of the last one
        size = data.index(b"PK\x01\x02") - info.header_offset - 30 - len(info.filename)
        for start in (info.header_offset + 18, at + 20):
            data[start : start + 8] = size.to_bytes(4, "little") * 2
        at += 46 + len(info.filename)
    (tmp_path / "a.r5dgs").write_bytes(data)
    assert_refused_cheaply(tmp_path / "a.r5dgs", "overlap|expected")


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_unbounded_compression_methods_are_refused(path, tmp_path, compression):
    assert_refused_cheaply(write(tmp_path / "a.r5dgs", members(path), compression), "stored or deflated")


def test_a_directory_of_very_many_members_is_not_read(path, tmp_path):
    content = {f"{number:0100d}": b"" for number in range(9000)}
    assert_refused_cheaply(write(tmp_path / "many.r5dgs", content, zipfile.ZIP_STORED), "a directory or piece of")


def test_a_pipe_and_an_unreadable_place_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.r5dgs")
    assert_refused_cheaply(tmp_path / "pipe.r5dgs", "expected a .r5dgs file")


@pytest.mark.slow
def test_scenes_that_compress_too_well_remain_readable(tmp_path):
    count = 1_500_000
    scene = make_scene(n=1, objects=0, unassigned=0, shadows=False, shading=False, identities=False)
    arrays = {
        name: np.repeat(scene.arrays()[name], count, axis=0)
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh", "object_ids", "motion_ids")
    }
    table = (dataclasses.replace(scene.objects[0], count=count),)
    path = scene_file.write(dataclasses.replace(scene.with_arrays(**arrays), objects=table), tmp_path / "equal.r5dgs")
    assert len(scene_file.read(path).gaussians.means) == count
