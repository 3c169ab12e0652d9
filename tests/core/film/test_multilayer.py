"""Multilayer EXR pictures, read back with OpenImageIO."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest

from r5dgs_core import errors
from r5dgs_core.color import srgb
from r5dgs_core.film import frame_renderer, multilayer
from r5dgs_core.film.settings import PASSES
from r5dgs_core.formats import cryptomatte


@pytest.fixture
def drawn(scene):
    renderer = frame_renderer.FrameRenderer(scene, transparent=True)
    return renderer.picture(scene.cameras[0], 1.0), renderer.layers(scene.cameras[0], 1.0)


def read(path):
    image = oiio.ImageBuf(str(path))
    return dict(
        zip(image.spec().channelnames, np.moveaxis(image.get_pixels(oiio.FLOAT), -1, 0), strict=True)
    ), image.spec()


def test_every_layer_is_read_back(scene, drawn, tmp_path):
    picture, layers = drawn
    multilayer.write(tmp_path / "a.exr", multilayer.channels(scene, picture, layers, PASSES), scene)
    found, spec = read(tmp_path / "a.exr")
    np.testing.assert_array_equal(found["ViewLayer.Depth.Z"], layers.depth)
    np.testing.assert_array_equal(found["ViewLayer.IndexOB.X"], layers.index)
    np.testing.assert_array_equal(found["ViewLayer.Alpha.V"], layers.alpha)
    color = np.stack([found[f"ViewLayer.Combined.{name}"] for name in "RGBA"], -1)
    straight = np.divide(color[..., :3], color[..., 3:], out=np.zeros_like(picture[..., :3]), where=color[..., 3:] > 0)
    seen = picture[..., 3] > 0.01
    np.testing.assert_allclose(srgb.from_linear(straight)[seen], np.maximum(picture[..., :3], 0)[seen], atol=1e-4)
    (manifest,) = (a.value for a in spec.extra_attribs if a.name.endswith("/manifest"))
    assert json.loads(manifest)["mug"] == f"{cryptomatte.hash_of('mug'):08x}"
    for item in scene.objects:
        if item.id < 0:
            continue
        share = np.zeros_like(layers.alpha)
        for number in range(3):
            for name, amount in ("RG", "BA"):
                layer = f"ViewLayer.CryptoObject{number:02d}"
                share += np.where(
                    found[f"{layer}.{name}"] == cryptomatte.value_of(item.name), found[f"{layer}.{amount}"], 0
                )
        expected = np.where(layers.objects == item.id, layers.shares, 0).sum(-1)
        np.testing.assert_allclose(share, expected, atol=1e-6)


def test_only_the_wanted_layers_are_written(scene, drawn, tmp_path):
    multilayer.write(tmp_path / "a.exr", multilayer.channels(scene, *drawn, ("depth",)), scene)
    found, spec = read(tmp_path / "a.exr")
    assert set(found) == {*(f"ViewLayer.Combined.{name}" for name in "RGBA"), "ViewLayer.Depth.Z"}
    assert not any("cryptomatte" in a.name for a in spec.extra_attribs)


def test_a_file_in_place_of_the_folder_is_an_error_and_leaves_nothing(scene, drawn, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(errors.DatasetError, match="cannot write the image"):
        multilayer.write(tmp_path / "file" / "a.exr", multilayer.channels(scene, *drawn, ()), scene)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
