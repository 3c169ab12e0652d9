"""Frames as images: kinds, orientation, transparency."""

import numpy as np
import OpenImageIO as oiio
import pytest

from r5dgs_core import errors
from r5dgs_core.data import images
from r5dgs_core.prepare import frame_file

PIXELS = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)


def write(path, pixels, orientation=None):
    output = oiio.ImageOutput.create(str(path))
    kind = oiio.FLOAT if pixels.dtype == np.float32 else oiio.UINT8
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    if orientation:
        spec.attribute("Orientation", orientation)
    assert output.open(str(path), spec) and output.write_image(pixels) and output.close()
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_frames_are_upright_whatever_their_orientation(tmp_path, orientation):
    turned = oiio.ImageBuf(write(tmp_path / "stored.tif", PIXELS, orientation).as_posix())
    expected = oiio.ImageBufAlgo.reorient(turned).get_pixels(oiio.UINT8)
    path = tmp_path / "stored.tif"
    np.testing.assert_array_equal(frame_file.read(path), expected)
    assert frame_file.size(path) == expected.shape[1::-1]


def test_linear_frames_become_srgb(tmp_path):
    path = write(tmp_path / "a.exr", np.full((4, 4, 3), 0.2158605, np.float32))
    assert (frame_file.read(path) == 128).all()


def test_transparent_pixels_are_white(tmp_path):
    images.write_png(tmp_path / "a.png", np.concatenate([PIXELS, np.zeros((6, 8, 1), np.uint8)], -1))
    assert (frame_file.read(tmp_path / "a.png") == 255).all()


def test_heic_frames_are_read(tmp_path):
    pillow_heif = pytest.importorskip(
        "pillow_heif", reason="pillow-heif is not installed; it comes with the extra 'heic'"
    )
    pixels = np.full((64, 96, 3), (200, 90, 40), np.uint8)
    pillow_heif.from_bytes("RGB", (96, 64), pixels.tobytes()).save(tmp_path / "a.heic", quality=95)
    assert frame_file.size(tmp_path / "a.heic") == (96, 64)
    assert np.abs(frame_file.read(tmp_path / "a.heic").astype(int) - pixels).max() < 8


def test_damaged_heic_is_refused(tmp_path):
    (tmp_path / "a.heic").write_bytes(b"damaged")
    with pytest.raises(errors.DatasetError, match="a.heic: the image cannot be decoded"):
        frame_file.read(tmp_path / "a.heic")


def test_the_missing_package_for_heic_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pillow_heif", None)
    with pytest.raises(errors.BackendError, match=r"HEIC frames.*pip install 'r5dgs\[heic\]'"):
        frame_file.read(tmp_path / "a.heic")
