"""Image files: written files can be read, and unreadable files are named."""

import subprocess
import sys

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core import errors
from r5dgs_core.data import images


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_png_keeps_every_integer(tmp_path, dtype, channels):
    rng = np.random.default_rng(channels)
    pixels = rng.integers(0, np.iinfo(dtype).max + 1, (7, 5, channels)).astype(dtype)
    if channels in (2, 4):
        pixels[0, :, -1] = 0  # colours under transparent pixels are kept too
    images.write_png(tmp_path / "a.png", pixels)
    read = images.read_png(tmp_path / "a.png")
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, pixels)
    assert images.size(tmp_path / "a.png") == (5, 7, channels)


def test_floats_are_rounded_to_the_nearest_eight_bits(tmp_path):
    levels = np.arange(256, dtype=np.float32).reshape(16, 16) / 255
    images.write_png(tmp_path / "a.png", levels + 0.4 / 255)
    np.testing.assert_array_equal(images.read_png(tmp_path / "a.png")[..., 0].ravel(), np.arange(256))
    np.testing.assert_allclose(images.read(tmp_path / "a.png")[..., 0], levels, atol=1e-7)


def test_floats_outside_the_range_are_clipped():
    np.testing.assert_array_equal(
        images.to_uint8(np.array([-1.0, 0.0, 1.0, 7.0, np.inf, np.nan])), [0, 0, 255, 255, 255, 0]
    )


def test_sixteen_bits_read_as_the_same_colour(tmp_path):
    images.write_png(tmp_path / "a.png", np.full((2, 2, 3), 32768, np.uint16))
    np.testing.assert_allclose(images.read(tmp_path / "a.png"), 32768 / 65535, atol=1e-6)


def test_linear_float_files_go_through_the_srgb_curve(tmp_path):
    path = tmp_path / "a.exr"
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), oiio.ImageSpec(2, 1, 3, oiio.FLOAT))
    assert output.write_image(np.array([[[0.0, 0.0031308, 0.2140411], [1.0, 4.0, -1.0]]], np.float32))
    output.close()
    expected = [[[0.0, 0.04045, 0.5], [1.0, 1.0, 0.0]]]
    np.testing.assert_allclose(images.read(path), expected, atol=2e-4)


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_compositing_is_linear_in_alpha(color, behind, alpha):
    pixel = np.array([[[color, color, color, alpha]]], np.float32)
    got = images.composite(pixel, np.full(3, behind))
    np.testing.assert_allclose(got, color * alpha + behind * (1 - alpha), atol=1e-6)


def test_compositing_defaults_to_white():
    np.testing.assert_array_equal(images.composite(np.zeros((1, 1, 4), np.float32)), np.ones((1, 1, 3)))


def test_gray_becomes_opaque_rgba():
    pixels = images.to_rgba(np.full((2, 3, 1), 0.25, np.float32))
    assert pixels.shape == (2, 3, 4)
    np.testing.assert_allclose(pixels[0, 0], [0.25, 0.25, 0.25, 1.0])


@pytest.mark.parametrize("content", [b"", b"not an image at all", b"\x89PNG\r\n\x1a\n"])
def test_a_file_that_is_not_an_image_is_named(tmp_path, content):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(errors.DatasetError, match=r"a\.png"):
        images.read(tmp_path / "a.png")


def test_a_truncated_image_is_named(tmp_path):
    rng = np.random.default_rng(0)
    images.write_png(tmp_path / "a.png", rng.integers(0, 255, (64, 64, 3)).astype(np.uint8))
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(errors.DatasetError, match=r"a\.png.*hit end of file"):
        images.read(tmp_path / "a.png")


def test_a_missing_image_is_named(tmp_path):
    with pytest.raises(errors.DatasetError, match="nowhere.png: the image is missing"):
        images.read(tmp_path / "nowhere.png")


def test_writing_leaves_no_temporary_file_and_replaces_the_old_one(tmp_path):
    for value in (1, 2):
        images.write_png(tmp_path / "sub" / "a.png", np.full((2, 2), value, np.uint8))
    assert [path.name for path in (tmp_path / "sub").iterdir()] == ["a.png"]
    assert images.read_png(tmp_path / "sub" / "a.png").max() == 2


@pytest.mark.parametrize("pixels", [np.zeros((2, 2, 5)), np.zeros((0, 2, 3)), np.zeros(3), np.zeros((2, 2), np.int64)])
def test_arrays_that_are_not_pictures_are_refused(tmp_path, pixels):
    with pytest.raises(ValueError, match="expected"):
        images.write_png(tmp_path / "a.png", pixels)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of files")
def test_a_full_disk_is_an_error_and_leaves_the_old_image(tmp_path):
    path = tmp_path / "picture.png"
    old = np.zeros((4, 4, 3), np.uint8)
    images.write_png(path, old)
    code = (
        "import resource, sys; import numpy as np; from pathlib import Path\n"
        "from r5dgs_core import errors; from r5dgs_core.data import images\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (5000, resource.RLIM_INFINITY))\n"
        "noise = np.random.default_rng(0).integers(0, 255, (100, 100, 3)).astype(np.uint8)\n"
        "try: images.write_png(Path(sys.argv[1]), noise)\n"
        "except errors.DatasetError as error: print(error)"
    )
    shown = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True).stdout
    assert f"{path}: cannot write the image" in shown and "check the free disk space" in shown
    assert (images.read_raw(path) == old).all() and [p.name for p in tmp_path.iterdir()] == ["picture.png"]


def test_a_folder_that_cannot_be_created_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(errors.DatasetError, match="x.png: cannot write the image"):
        images.write_png(tmp_path / "file" / "x.png", np.zeros((2, 2), np.uint8))
