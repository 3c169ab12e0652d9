import dataclasses

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.formats import ply, registry
from r5dgs_core.motion.history import Band, History
from r5dgs_core.scene.splats import Splats
from tests.support.scenes import make_scene


def splats(degree=0, n=50, groups=True):
    scene = make_scene(n=n, sh_degree=degree)
    return Splats(
        scene.gaussians.means,
        scene.gaussians.quats,
        scene.gaussians.log_scales,
        scene.gaussians.opacity_logits,
        scene.gaussians.sh,
        scene.gaussians.identities.astype(np.float32) if groups else None,
        scene.gaussians.object_ids if groups else None,
    )


def assert_equal(a, b, **tolerance):
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if x is None:
            assert y is None, field.name
        else:
            assert y.dtype == x.dtype
            np.testing.assert_allclose(x, y, err_msg=field.name, **({"rtol": 0, "atol": 2e-7} | tolerance))


@pytest.mark.parametrize("groups", [True, False])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_reading_restores_the_written_scene(tmp_path, degree, groups):
    original = splats(degree, groups=groups)
    assert_equal(original, ply.read(ply.write(original, tmp_path / "a.ply")))


def test_plain_files_have_the_columns_of_3dgs_only(tmp_path):
    data = ply.write(splats(1), tmp_path / "a.ply", plain=True).read_bytes()
    header = data[: data.index(b"end_header")].decode().splitlines()
    columns = [line.split()[-1] for line in header if line.startswith("property float")]
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9))]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert columns == expected
    assert not any("obj_id" in line for line in header)
    back = ply.read(tmp_path / "a.ply")
    assert back.identities is None
    assert back.object_ids is None


def test_a_reader_for_floats_alone_finds_all_columns(tmp_path):
    gsply = pytest.importorskip("gsply", reason="gsply is not installed; it comes with the extra 'export'")
    original = splats(1)
    found = gsply.plyread(str(ply.write(original, tmp_path / "a.ply")))
    np.testing.assert_array_equal(found.means, original.means)
    np.testing.assert_array_equal(found.quats, original.quats)


def test_coefficients_are_stored_channel_by_channel(tmp_path):
    original = splats(1, n=30)
    data = ply.write(original, tmp_path / "a.ply", plain=True).read_bytes()
    table = np.frombuffer(data, "<f4", offset=data.index(b"end_header\n") + 11).reshape(30, -1)
    # f_rest_0..2 are the three degree 1 coefficients of red, 3..5 of green, 6..8 of blue.
    np.testing.assert_array_equal(table[:, 9:12], original.sh[:, 1:, 0])
    np.testing.assert_array_equal(table[:, 15:18], original.sh[:, 1:, 2])


def header(layout, columns, count, extra=()):
    lines = ["ply", f"format {layout} 1.0", "comment made by hand", *extra, f"element vertex {count}"]
    return "\n".join([*lines, *(f"property {kind} {name}" for name, kind in columns), "end_header\n"]).encode()


COLUMNS = [(name, "float") for name in ("rot_0", "rot_1", "rot_2", "rot_3", "y", "x", "z", "opacity")]
COLUMNS += [(f"scale_{i}", "double") for i in range(3)] + [(f"f_dc_{i}", "float") for i in range(3)]
COLUMNS += [("confidence", "uchar")]
ROW = [2.0, 0, 0, 0, 5, 4, 6, 0.5, -1, -2, -3, 0.1, 0.2, 0.3, 7]


def expect_row(read):
    np.testing.assert_allclose(read.means, [[4, 5, 6]])
    np.testing.assert_allclose(read.quats, [[1, 0, 0, 0]])
    np.testing.assert_allclose(read.log_scales, [[-1, -2, -3]])
    np.testing.assert_allclose(read.sh, [[[0.1, 0.2, 0.3]]], rtol=1e-6)


@pytest.mark.parametrize(("layout", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_columns_are_found_by_name_in_any_order_and_type(tmp_path, layout, order):
    kinds = {"float": "f4", "double": "f8", "uchar": "u1"}
    row = np.array([tuple(ROW)], [(name, order + kinds[kind]) for name, kind in COLUMNS])
    path = tmp_path / "a.ply"
    path.write_bytes(header(layout, COLUMNS, 1) + row.tobytes())
    expect_row(ply.read(path))


def test_ascii_files_are_read(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(header("ascii", COLUMNS, 1) + (" ".join(map(str, ROW)) + "\n").encode())
    expect_row(ply.read(path))
    path.write_bytes(header("ascii", COLUMNS, 1) + b"1 2 3\n" + b" " * 40)
    with pytest.raises(errors.SceneFileError, match="row 0: expected 15 numbers, found 3"):
        ply.read(path)
    path.write_bytes(header("ascii", COLUMNS, 1) + b"a " * 15 + b"\n")
    with pytest.raises(errors.SceneFileError, match="numbers"):
        ply.read(path)


def test_elements_before_the_vertices_are_skipped(tmp_path):
    path = tmp_path / "a.ply"
    row = np.array(ROW[:8], "<f4").tobytes() + np.array(ROW[8:11], "<f8").tobytes()
    row += np.array(ROW[11:14], "<f4").tobytes() + b"\x07"
    extra = ("element chunk 2", "property int first", "property uchar second")
    path.write_bytes(header("binary_little_endian", COLUMNS, 1, extra) + b"\0" * 10 + row)
    expect_row(ply.read(path))


def test_any_truncation_is_one_clear_error(tmp_path):
    data = ply.write(splats(n=12), tmp_path / "a.ply").read_bytes()
    path = tmp_path / "broken.ply"
    for length in [*range(0, 1200, 13), *range(len(data) - 300, len(data), 7)]:
        path.write_bytes(data[:length])
        with pytest.raises(errors.SceneFileError, match=r"broken\.ply"):
            ply.read(path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"PK\x03\x04 not a ply", "another kind"),
        (b"", "another kind"),
        (b"ply\nformat binary_middle_endian 1.0\n", "header"),
        (b"ply\nelement vertex 1\nproperty float x\nend_header\n0000", "formats"),
        (header("ascii", [("x", "float"), ("y", "float"), ("z", "float")], 1) + b"1 2 3\n", "f_dc_0"),
        (header("ascii", [("x", "quad")], 1), "quad"),
        (header("ascii", [("x", "float"), ("x", "float")], 1), "unique"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nend_header\n3 0 1 2\n", "lists"),
        (b"ply\nformat ascii 1.0\nelement face 0\nproperty int i\nend_header\n", "element 'vertex'"),
        (header("ascii", [*COLUMNS, ("f_rest_0", "float")], 0), "f_rest"),
    ],
)
def test_foreign_files_are_refused_with_the_reason(tmp_path, data, message):
    path = tmp_path / "a.ply"
    path.write_bytes(data)
    with pytest.raises(errors.SceneFileError, match=message) as caught:
        ply.read(path)
    assert str(path) in str(caught.value)


def test_nan_is_refused_with_its_row(tmp_path):
    original = splats()
    original.means[7, 1] = np.nan
    with pytest.raises(errors.SceneFileError, match="row 7"):
        ply.read(ply.write(original, tmp_path / "a.ply"))


def test_missing_files_and_folders_are_clear_errors(tmp_path):
    with pytest.raises(errors.SceneFileError, match="absent"):
        ply.read(tmp_path / "absent.ply")
    with pytest.raises(errors.SceneFileError, match="cannot be written"):
        ply.write(splats(), tmp_path / "absent" / "a.ply")


@pytest.mark.parametrize(
    ("count", "message"),
    [
        ("1000000000000", "truncated"),
        ("9" * 5000, "PLY statement"),
        ("-1", "PLY statement"),
        ("2", "truncated|row 0: expected"),
    ],
)
@pytest.mark.parametrize("layout", ["binary_little_endian", "ascii"])
def test_counts_beyond_the_file_are_refused_before_anything_is_allocated(tmp_path, layout, count, message):
    path = tmp_path / "a.ply"
    text = header(layout, COLUMNS, 1).replace(b"element vertex 1", f"element vertex {count}".encode())
    path.write_bytes(text + bytes(4 * len(COLUMNS)))
    with pytest.raises(errors.SceneFileError, match=message):
        ply.read(path)


@pytest.mark.parametrize(("column", "value"), [("x", 3e38), ("scale_1", 100.0), ("f_dc_0", 1e30), ("opacity", 1e20)])
def test_numbers_that_cannot_be_drawn_are_refused(tmp_path, column, value):
    path = tmp_path / "a.ply"
    row = [value if name == column else 0.5 for name, _ in COLUMNS]
    path.write_bytes(header("ascii", COLUMNS, 1) + (" ".join(map(str, row)) + "\n").encode())
    with pytest.raises(errors.SceneFileError, match="expected finite numbers up to"):
        ply.read(path)


@pytest.mark.parametrize("value", ["nan", "1e30"])
def test_ids_that_are_no_whole_numbers_of_32_bits_are_refused(tmp_path, value):
    path = tmp_path / "a.ply"
    row = ["0.5"] * len(COLUMNS) + [value]
    path.write_bytes(header("ascii", [*COLUMNS, ("obj_id", "float")], 1) + (" ".join(row) + "\n").encode())
    with pytest.raises(errors.SceneFileError, match="obj_id"):
        ply.read(path)


@pytest.mark.parametrize(("after", "object_ids", "expected"), [(0, None, 0), (1, None, 1), (1, frozenset({0}), 0)])
def test_predicted_frames_state_the_confidence_band(tmp_path, after, object_ids, expected):
    scene = make_scene()
    body = next(k for k, group in enumerate(scene.groups) if group.role == "body")
    groups = [dataclasses.replace(group, history=History()) for group in scene.groups]
    band = Band((scene.t_max, scene.t_max + 2), (0.1, 0.3), (0.5, 0.7))
    groups[body] = dataclasses.replace(groups[body], history=History(band=band))
    scene = dataclasses.replace(scene, groups=tuple(groups))
    options = registry.Options(times=(scene.t_max + after,), object_ids=object_ids)
    (path,) = ply.export(scene, tmp_path / "a.ply", options)
    lines = [line for line in path.read_bytes().split(b"end_header")[0].decode().splitlines() if "band" in line]
    assert lines == expected * [f"comment band {groups[body].object_id} 0.95 0.2 0.6"]
