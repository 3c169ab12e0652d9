"""OpenImageIO reads the images that the standard library writes."""

import numpy as np
import OpenImageIO as oiio
import pytest

from r5dgs_core.data import images
from r5dgs_core.formats import image_files


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (48, 33)])
def test_png_holds_the_integers(tmp_path, dtype, shape):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, shape).astype(dtype)
    read = images.read_png(image_files.write_png(tmp_path / "mask.png", pixels))
    assert read.dtype == dtype
    np.testing.assert_array_equal(read[..., 0], pixels)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_holds_colors(tmp_path, dtype):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, (7, 5, 3)).astype(dtype)
    np.testing.assert_array_equal(images.read_png(image_files.write_png(tmp_path / "a.png", pixels)), pixels)


@pytest.mark.parametrize("shape", [(1, 1), (16, 4), (37, 21), (64, 64)])
@pytest.mark.parametrize("names", [("Y",), ("B", "G", "R"), ("ViewLayer.Depth.Z", "ViewLayer.Object Index of All.X")])
def test_exr_holds_the_channels(tmp_path, shape, names):
    random = np.random.default_rng(1)
    channels = {name: (random.normal(size=shape) * 1e3).astype(np.float32) for name in names}
    channels[names[0]] = np.zeros(shape, np.float32)  # a block that packs well beside one that does not
    path = image_files.write_exr(tmp_path / "index.exr", channels)
    source = oiio.ImageInput.open(str(path))
    assert source is not None, oiio.geterror()
    spec = source.spec()
    assert (spec.height, spec.width) == shape
    assert sorted(spec.channelnames) == sorted(names)
    pixels = source.read_image("float")
    source.close()
    for index, name in enumerate(spec.channelnames):
        np.testing.assert_array_equal(pixels[..., index], channels[name], err_msg=name)


def test_other_shapes_and_types_are_refused(tmp_path):
    with pytest.raises(ValueError, match="uint8 or uint16"):
        image_files.write_png(tmp_path / "a.png", np.zeros((4, 4), np.int32))
    with pytest.raises(ValueError, match="expected"):
        image_files.write_exr(tmp_path / "a.exr", {"A": np.zeros((4, 4)), "B": np.zeros((4, 5))})
    assert list(tmp_path.iterdir()) == []
