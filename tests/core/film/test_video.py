"""Videos, read back frame by frame."""

import av
import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.film import settings, video

H, W, COUNT = 48, 64, 7


def pictures(channels):
    """Smooth pictures that differ from frame to frame, with colours of all hues and all alphas."""
    y, x = np.mgrid[0:H, 0:W]
    for k in range(COUNT):
        waves = [0.5 + 0.4 * np.sin(0.04 * x + 0.03 * y + 0.3 * k + 2.1 * c) for c in range(3)]
        alpha = [np.clip((x - 8 - 2 * k) / 32, 0, 1)]
        yield np.stack((waves + alpha)[:channels], -1).astype(np.float32)


def decoded(path, pixel_format, decoder=None):
    """All frames of a video, and the first one's tags and time stamps."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        if decoder is not None:  # FFmpeg's own VP9 decoder has no alpha
            context = av.codec.CodecContext.create(decoder, "r")
        packets = list(container.demux(stream))
        found = [frame for packet in packets for frame in context.decode(packet)]
        tags = tuple(
            int(getattr(stream.codec_context, n)) for n in ("color_primaries", "color_trc", "colorspace", "color_range")
        )
        stamps = [float(p.pts * p.time_base) for p in packets if p.pts is not None]
        return [frame.to_ndarray(format=pixel_format) for frame in found], tags, sorted(stamps)


def psnr(a, b, most):
    return -10 * np.log10(np.mean(((a.astype(float) - b) / most) ** 2))


@pytest.mark.parametrize(("suffix", "channels"), [(".mp4", 3), (".mov", 3), (".mov", 4), (".webm", 3), (".webm", 4)])
def test_every_frame_is_read_back(tmp_path, suffix, channels):
    path, made = tmp_path / f"a{suffix}", list(pictures(channels))
    with video.writing(path, 25.0, alpha=channels == 4) as append:
        for picture in made:
            append(picture)
    deep = suffix == ".mov"
    kind = ("rgba64le" if channels == 4 else "rgb48le") if deep else ("rgba" if channels == 4 else "rgb24")
    found, tags, stamps = decoded(path, kind, "libvpx-vp9" if (suffix, channels) == (".webm", 4) else None)
    assert len(found) == COUNT and tags == (1, 13, 1, 1)
    np.testing.assert_allclose(stamps, np.arange(COUNT) / 25, atol=1.1e-3)
    most = 65535 if deep else 255
    for frame, picture in zip(found, made, strict=True):
        assert psnr(frame[..., :3], picture[..., :3] * most, most) > (45 if deep else 36)
        if channels == 4:
            assert psnr(frame[..., 3], picture[..., 3] * most, most) > 40


def test_colors_are_stored_by_the_matrix_that_the_tags_name(tmp_path):
    red = np.zeros((H, W, 3), np.float32) + np.array([1, 0, 0], np.float32)
    with video.writing(tmp_path / "a.mp4", 24.0) as append:
        append(red)
    with av.open(str(tmp_path / "a.mp4")) as container:
        (frame,) = container.decode(video=0)
    luma = np.frombuffer(frame.planes[0], np.uint8)[0]
    assert luma == pytest.approx(16 + 219 * 0.2126, abs=1)  # BT.709 of limited range; BT.601 gives 81


def test_frame_rates_of_television_are_exact(tmp_path):
    with video.writing(tmp_path / "a.mp4", 30000 / 1001) as append:
        append(next(pictures(3)))
    with av.open(str(tmp_path / "a.mp4")) as container:
        rate = container.streams.video[0].average_rate
        assert (rate.numerator, rate.denominator) == (30000, 1001)


def test_the_slowest_frame_rate_is_stored(tmp_path):
    for suffix in video.CODECS:
        with video.writing(tmp_path / f"a{suffix}", settings.FPS_RANGE[0]) as append:
            for picture in pictures(3):
                append(picture)
        assert decoded(tmp_path / f"a{suffix}", "rgb24")[2][1] == pytest.approx(1 / settings.FPS_RANGE[0], rel=1e-3)


def test_an_error_leaves_nothing_and_keeps_the_old_file(tmp_path):
    (tmp_path / "a.mp4").write_text("mine")
    with pytest.raises(RuntimeError), video.writing(tmp_path / "a.mp4", 24.0) as append:
        append(next(pictures(3)))
        raise RuntimeError
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.mp4", "mine")]


def test_an_error_of_the_block_stays_what_it_is(tmp_path):
    with pytest.raises(OSError, match="image") as raised, video.writing(tmp_path / "a.mp4", 24.0) as append:
        append(next(pictures(3)))
        raise OSError(5, "the image cannot be read")
    assert type(raised.value) is OSError and list(tmp_path.iterdir()) == []


def test_a_picture_that_the_encoder_refuses_is_one_error(tmp_path):
    with (
        pytest.raises(errors.ConfigError, match="cannot be written"),
        video.writing(tmp_path / "a.mp4", 24.0) as append,
    ):
        append(np.zeros((33, 17, 3), np.float32))
    assert list(tmp_path.iterdir()) == []


def test_a_missing_codec_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(video.CODECS, ".mp4", video.Codec("no_such_codec", "yuv420p", None))
    with pytest.raises(errors.BackendError, match="no encoder no_such_codec"), video.writing(tmp_path / "a.mp4", 24.0):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_one_error(tmp_path):
    with pytest.raises(errors.ConfigError, match="cannot be written"), video.writing(tmp_path / "no" / "a.mp4", 24.0):
        pass
