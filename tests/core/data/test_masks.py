"""Object id images in the formats of common tools."""

import struct
import zlib

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.data import images, masks

IDS = np.array([[0, 1, 2, 3, 0], [0, 1, 1, 3, 3], [7, 7, 0, 0, 1]], np.int32)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def filtered(rows: np.ndarray, kinds: list[int]) -> bytes:
    """PNG's filters, written as the specification states them: raw minus the prediction, modulo 256."""
    out = bytearray()
    rows = rows.astype(int)
    for y, kind in enumerate(kinds):
        out.append(kind)
        for x in range(rows.shape[1]):
            a = rows[y, x - 1] if x else 0
            b = rows[y - 1, x] if y else 0
            c = rows[y - 1, x - 1] if x and y else 0
            paeth = min((a, b, c), key=lambda v: abs(a + b - c - v))
            guess = (0, a, b, (a + b) // 2, paeth)[kind]
            out.append(int(rows[y, x] - guess) % 256)
    return bytes(out)


def write_indexed(
    path, ids: np.ndarray, depth: int = 8, kinds: list[int] | None = None, color_type: int = 3, interlace=0
):
    """A palette PNG by hand, as image libraries only give its colours."""
    height, width = ids.shape
    if depth < 8:
        bits = (ids[..., None] >> np.arange(depth - 1, -1, -1)) & 1
        rows = np.packbits(bits.reshape(height, -1).astype(np.uint8), axis=1)
    else:
        rows = ids.astype(np.uint8)
    data = b"\x89PNG\r\n\x1a\n" + chunk(
        b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, interlace)
    )
    if color_type == 3:
        rng = np.random.default_rng(0)
        data += chunk(b"PLTE", rng.integers(0, 255, 3 * 2**depth).astype(np.uint8).tobytes())
    packed = zlib.compress(filtered(rows, kinds or [0] * height))
    middle = len(packed) // 2
    data += chunk(b"IDAT", packed[:middle]) + chunk(b"IDAT", packed[middle:]) + chunk(b"IEND", b"")
    path.write_bytes(data)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_values_of_one_channel_are_the_ids(tmp_path, dtype):
    ids = IDS * (300 if dtype == np.uint16 else 30)
    images.write_png(tmp_path / "m.png", ids.astype(dtype))
    read = masks.read(tmp_path / "m.png")
    assert read.dtype == np.int32
    np.testing.assert_array_equal(read, ids)


@pytest.mark.parametrize("kinds", [[0, 0, 0], [1, 2, 3], [4, 4, 4], [3, 4, 1], [2, 3, 4]])
def test_a_palette_image_holds_indices_whatever_its_filters(tmp_path, kinds):
    ids = IDS * 31
    write_indexed(tmp_path / "m.png", ids, kinds=kinds)
    np.testing.assert_array_equal(masks.read(tmp_path / "m.png"), ids)


@pytest.mark.parametrize("depth", [1, 2, 4])
@pytest.mark.parametrize("color_type", [0, 3])
def test_images_of_few_bits_are_not_stretched(tmp_path, depth, color_type):
    ids = IDS % 2**depth
    write_indexed(tmp_path / "m.png", ids, depth=depth, color_type=color_type)
    np.testing.assert_array_equal(masks.read(tmp_path / "m.png"), ids)


def test_the_palette_reader_agrees_with_the_image_library(tmp_path):
    rng = np.random.default_rng(3)
    ids = rng.integers(0, 200, (40, 33))
    write_indexed(tmp_path / "m.png", ids, kinds=rng.integers(0, 5, 40).tolist())
    colors = images.read_png(tmp_path / "m.png")[..., :3].reshape(-1, 3)
    palette = {}
    for index, color in zip(masks.read(tmp_path / "m.png").ravel().tolist(), colors.tolist(), strict=True):
        assert palette.setdefault(index, color) == color
    np.testing.assert_array_equal(masks.read(tmp_path / "m.png"), ids)


def test_equal_channels_are_one_channel_and_transparent_pixels_background(tmp_path):
    pixels = np.repeat(IDS.astype(np.uint8)[..., None], 4, axis=2)
    pixels[..., 3] = 255
    pixels[0, 1, 3] = 0
    images.write_png(tmp_path / "m.png", pixels)
    expected = IDS.copy()
    expected[0, 1] = 0
    np.testing.assert_array_equal(masks.read(tmp_path / "m.png"), expected)


def test_colours_get_the_same_ids_in_all_masks(tmp_path):
    red, blue, green = (255, 0, 0), (0, 0, 200), (1, 90, 1)
    first = np.array([[(0, 0, 0), red], [blue, red]], np.uint8)
    second = np.array([[green, green], [(0, 0, 0), red]], np.uint8)
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    for path, pixels in zip(paths, (first, second), strict=True):
        images.write_png(path, pixels)
    colors = masks.color_table(paths)
    np.testing.assert_array_equal(masks.read(paths[0], colors), [[0, 3], [1, 3]])
    np.testing.assert_array_equal(masks.read(paths[1], colors), [[2, 2], [0, 3]])


def test_the_kind_of_masks_is_decided_for_all_of_them_at_once(tmp_path):
    """A colour-coded mask that shows only white and gray objects is still read as colours."""
    gray, red, white = (90, 90, 90), (200, 0, 0), (255, 255, 255)
    pictures = {
        "all.png": np.array([[(0, 0, 0), gray], [red, white]], np.uint8),
        "white.png": np.array([[(0, 0, 0), white], [white, white]], np.uint8),
        "one_channel.png": np.array([[0, 90], [255, 90]], np.uint8)[..., None],
        "empty.png": np.zeros((2, 2, 3), np.uint8),
    }
    for name, pixels in pictures.items():
        images.write_png(tmp_path / name, pixels)
    colors = masks.color_table([tmp_path / name for name in reversed(pictures)])
    read = {name: masks.read(tmp_path / name, colors).tolist() for name in pictures}
    assert read == {
        "all.png": [[0, 1], [2, 3]],
        "white.png": [[0, 3], [3, 3]],
        "one_channel.png": [[0, 1], [3, 1]],
        "empty.png": [[0, 0], [0, 0]],
    }


def test_a_palette_file_among_coloured_ones_shows_its_colours(tmp_path):
    write_indexed(tmp_path / "palette.png", IDS)
    shown = images.read_png(tmp_path / "palette.png")[..., :3]
    images.write_png(tmp_path / "rgb.png", shown)
    colors = masks.color_table([tmp_path / "palette.png", tmp_path / "rgb.png"])
    as_palette, as_rgb = (masks.read(tmp_path / name, colors) for name in ("palette.png", "rgb.png"))
    np.testing.assert_array_equal(as_palette, as_rgb)
    assert len(np.unique(as_rgb)) == len(np.unique(IDS))


def test_transparent_pixels_of_coloured_masks_are_background(tmp_path):
    pixels = np.full((2, 3, 4), 255, np.uint8)
    pixels[0, :, :3] = (10, 20, 30)
    pixels[1, 1] = (77, 0, 0, 0)
    images.write_png(tmp_path / "m.png", pixels)
    colors = masks.color_table([tmp_path / "m.png"])
    np.testing.assert_array_equal(masks.read(tmp_path / "m.png", colors), [[1, 1, 1], [2, 0, 2]])


def test_masks_of_ids_need_no_colours(tmp_path):
    images.write_png(tmp_path / "m.png", IDS.astype(np.uint8))
    assert masks.color_table([tmp_path / "m.png"]) == {}


def test_a_colour_that_belongs_to_no_object_is_located(tmp_path):
    pixels = np.zeros((4, 4, 3), np.uint8)
    pixels[2, 1] = (9, 8, 7)
    images.write_png(tmp_path / "m.png", pixels)
    with pytest.raises(errors.DatasetError, match=r"m\.png.*2 colours.*\(9, 8, 7\) at pixel \(1, 2\)"):
        masks.read(tmp_path / "m.png", {0: 0, 255: 1})
    with pytest.raises(errors.DatasetError, match="one channel"):
        masks.read(tmp_path / "m.png")


def test_blended_colours_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    images.write_png(tmp_path / "m.png", rng.integers(0, 255, (80, 80, 3)).astype(np.uint8))
    with pytest.raises(errors.DatasetError, match="anti-aliasing"):
        masks.color_table([tmp_path / "m.png"])


def test_resizing_uses_nearest_neighbours():
    big = masks.resize(IDS, 10, 6, "m")
    np.testing.assert_array_equal(big, np.repeat(np.repeat(IDS, 2, 0), 2, 1))
    np.testing.assert_array_equal(masks.resize(big, 5, 3, "m"), IDS)
    assert masks.resize(IDS, 5, 3, "m") is IDS


def test_a_mask_of_another_shape_is_refused():
    with pytest.raises(errors.DatasetError, match="val/r_0: the mask is 5x3, its image 10x10"):
        masks.resize(IDS, 10, 10, "val/r_0")


def test_damaged_palette_masks_are_named(tmp_path):
    write_indexed(tmp_path / "m.png", IDS)
    data = (tmp_path / "m.png").read_bytes()
    (tmp_path / "m.png").write_bytes(data[:-30])
    with pytest.raises(errors.DatasetError, match=r"m\.png"):
        masks.read(tmp_path / "m.png")
    write_indexed(tmp_path / "m.png", IDS, interlace=1)
    with pytest.raises(errors.DatasetError, match="interlac"):
        masks.read(tmp_path / "m.png")
    with pytest.raises(errors.DatasetError, match=r"gone\.png"):
        masks.read(tmp_path / "gone.png")


@pytest.mark.parametrize(("highest", "kind"), [(7, np.uint8), (255, np.uint8), (256, np.uint16), (65535, np.uint16)])
def test_masks_are_written_with_as_few_bits_as_possible(tmp_path, highest, kind):
    ids = np.where(IDS == 7, highest, IDS)
    masks.write(tmp_path / "deep" / "m.png", ids)
    assert images.read_png(tmp_path / "deep" / "m.png").dtype == kind
    np.testing.assert_array_equal(masks.read(tmp_path / "deep" / "m.png"), ids)


def test_ids_among_colour_masks_are_refused_as_ambiguous(tmp_path):
    rgb = np.zeros((6, 6, 3), np.uint8)
    rgb[:3], rgb[3:] = (200, 0, 0), (90, 90, 90)
    images.write_png(tmp_path / "rgb.png", rgb)
    images.write_png(tmp_path / "ids.png", np.full((6, 6), 3, np.uint8))
    with pytest.raises(errors.DatasetError, match=r"ids\.png: contains \(3, 3, 3\).*rgb\.png.*one channel of ids"):
        masks.color_table([tmp_path / "ids.png", tmp_path / "rgb.png"])


def test_soft_edges_of_coloured_masks_are_refused(tmp_path):
    """Two discs drawn with anti-aliasing: they have few colours, but most of these fill no area."""

    def discs(softness):
        y, x = np.mgrid[:64, :64]
        rgb = np.zeros((64, 64, 3))
        for center, color in (((20, 20), (220, 30, 10)), ((44, 40), (20, 90, 210))):
            share = np.clip((14.3 - np.hypot(y - center[0], x - center[1])) / softness, 0, 1)[..., None]
            rgb = rgb * (1 - share) + share * np.array(color)
        return np.round(rgb).astype(np.uint8)

    images.write_png(tmp_path / "soft.png", discs(1.0))
    with pytest.raises(errors.DatasetError, match="fill no area; write them without anti-aliasing"):
        masks.color_table([tmp_path / "soft.png"])
    images.write_png(tmp_path / "hard.png", discs(1e-9))
    assert sorted(masks.color_table([tmp_path / "hard.png"]).values()) == [0, 1, 2]
