"""Videos: times of frames, orientation and colours, and refusal of what cannot be used."""

import av
import numpy as np
import pytest

from r5dgs_core.errors import DatasetError
from r5dgs_core.prepare import camera_source, source_files, video_file, wide_color
from tests.support import recordings

SIZE = (32, 48)


def bars(pixels):
    """Column of the bar of `recordings.gray_frames` by its brightness."""
    return int(np.argmax(np.convolve(pixels[..., 1].mean(0), np.ones(4), "valid"))) // 2


def opened(path):
    (files,) = source_files.find(path)
    return camera_source.open_camera(files)


def test_variable_intervals_keep_their_times(tmp_path):
    times = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.08, 20))
    path = recordings.write_video(tmp_path / "a.mp4", recordings.gray_frames(20), times)
    found = video_file.probe(path)
    np.testing.assert_allclose(np.diff(found.times), np.diff(times), atol=2e-5)
    assert abs(found.times[0] - times[0]) < 1e-3  # the container stores the start in milliseconds
    assert (found.width, found.height) == SIZE[::-1] and found.declared == 20


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "mov"])
def test_requested_frames_are_read_in_order_and_exactly(tmp_path, suffix):
    path = recordings.write_video(tmp_path / f"a.{suffix}", recordings.gray_frames(20), np.arange(20) / 10 + 3)
    wanted = [0, 1, 7, 13, 19]
    got = list(video_file.read(video_file.probe(path), wanted))
    assert [index for index, _ in got] == wanted == [bars(pixels) for _, pixels in got]


def test_a_turned_video_is_read_upright(tmp_path):
    times = np.arange(4) / 10
    plain = opened(recordings.write_video(tmp_path / "a.mp4", recordings.gray_frames(4), times))
    turned = opened(recordings.write_video(tmp_path / "b.mp4", recordings.gray_frames(4), times, turn=90))
    assert (turned.width, turned.height) == SIZE and "turned by 90 degrees" in turned.notes[0]
    ((_, upright),) = turned.read([2])
    ((_, pixels),) = plain.read([2])
    np.testing.assert_array_equal(upright, np.rot90(pixels))


def test_full_range_is_converted_like_limited_range(tmp_path):
    frames = [np.full((32, 48, 3), 200, np.uint8)] * 2
    for range_code in (1, 2):  # limited, full
        with av.open(str(tmp_path / f"{range_code}.mp4"), "w") as container:
            stream = container.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
            stream.codec_context.color_range = range_code
            for pixels in frames:
                frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                container.mux(stream.encode(frame.reformat(format="yuv420p", dst_color_range=range_code)))
            container.mux(stream.encode(None))
        ((_, got),) = opened(tmp_path / f"{range_code}.mp4").read([1])
        assert abs(float(got.mean()) - 200) < 2, range_code


def test_chapters_continue_each_other(tmp_path):
    for chapter in (1, 2):
        name = f"GX0{chapter}0042.MP4"
        recordings.write_video(tmp_path / name, recordings.gray_frames(6), np.arange(6) / 10)
    source = opened(tmp_path)
    np.testing.assert_allclose(source.times, np.arange(12) / 10, atol=1e-5)
    assert [(index, bars(pixels)) for index, pixels in source.read([4, 5, 6, 9])] == [(4, 4), (5, 5), (6, 0), (9, 3)]
    assert "2 chapters joined" in source.notes[0]


def test_chapters_of_different_sizes_are_refused(tmp_path):
    recordings.write_video(tmp_path / "GX010042.MP4", recordings.gray_frames(3), np.arange(3) / 10)
    recordings.write_video(tmp_path / "GX020042.MP4", recordings.gray_frames(3, (64, 48)), np.arange(3) / 10)
    with pytest.raises(DatasetError, match="expected 48x32 like GX010042.MP4, found 48x64"):
        opened(tmp_path)


def test_interlaced_video_is_refused_with_the_remedy(tmp_path):
    options = {"x264-params": "interlaced=1:tff=1"}
    path = recordings.write_video(
        tmp_path / "a.mp4", recordings.gray_frames(4, (64, 64)), np.arange(4) / 25, options=options
    )
    with pytest.raises(DatasetError, match="interlaced.*deinterlace it, for example with 'ffmpeg"):
        video_file.probe(path)


def test_a_file_with_sound_only_is_refused(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=recordings.SOUND_RATE, layout="mono")
        recordings.write_sound(container, stream, np.zeros(9000, np.float32))
    with pytest.raises(DatasetError, match="a.mp4: expected a video, found sound only"):
        video_file.probe(tmp_path / "a.mp4")


def test_a_video_that_lacks_its_end_is_used_up_to_there_and_named(tmp_path):
    options = {"crf": "5", "movflags": "faststart"}
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (64, 96, 3), np.uint8) for _ in range(30)]
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": options["crf"]})
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode(None))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    source = opened(path)
    assert 5 < len(source.times) < 30
    assert f"the file ends early, with {len(source.times)} of 30 frames" in source.notes[0]


def test_a_matroska_file_that_lacks_its_end_is_named(tmp_path):
    """It has no number of frames."""
    frames = [np.random.default_rng(k).integers(0, 255, (*SIZE, 3), np.uint8) for k in range(60)]
    path = recordings.write_video(tmp_path / "a.mkv", frames, np.arange(60) / 30)
    assert not opened(path).notes
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = opened(path)
    assert 5 < len(source.times) < 45
    assert f"the file ends early, with {len(source.times)} of 60 frames" in source.notes[0]


def test_a_long_last_frame_is_no_early_end(tmp_path):
    """Recordings of a variable rate show their last frame for some intervals."""
    path = recordings.write_video(tmp_path / "a.mkv", recordings.gray_frames(20), np.arange(20) / 30)
    data = path.read_bytes()
    duration = b"00:00:00.666000000"
    assert duration in data
    path.write_bytes(data.replace(duration, b"00:00:01.033000000"))
    assert video_file.probe(path).declared == 20
    assert not opened(path).notes


def test_frames_after_damage_are_read_from_the_next_key_frame_on(tmp_path):
    path = recordings.write_video(tmp_path / "a.mp4", recordings.gray_frames(36), np.arange(36) / 10)
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    keys = [k for k, packet in enumerate(packets) if packet.is_keyframe]
    data = bytearray(path.read_bytes())
    for packet in packets[3 : keys[1]]:
        data[packet.pos : packet.pos + packet.size] = bytes(packet.size)
    path.write_bytes(bytes(data))
    found = dict(video_file.read(video_file.probe(path), range(36)))
    after = sorted(packet.pts for packet in packets).index(packets[keys[1]].pts)
    assert 5 < after < 20 and set(range(after, 36)) <= set(found) and len(found) < 36
    assert all(bars(pixels) == index % 24 for index, pixels in found.items() if index % 24 < 22)


@pytest.mark.parametrize("number", [4, 12])
def test_frames_that_depend_on_a_damaged_one_are_left_out(tmp_path, number):
    """The decoder returns a packet whose end is damaged as a corrupt frame, and later ones as if they were whole."""
    options = {"crf": "12", "x264-params": "keyint=12:scenecut=0:bframes=0"}
    rng = np.random.default_rng(0)
    texture = rng.integers(0, 256, (64, 160, 3), np.uint8)
    frames = [texture[:, k : k + 96] for k in range(36)]
    path = recordings.write_video(tmp_path / "a.mp4", frames, np.arange(36) / 10, options=options)
    whole = dict(video_file.read(video_file.probe(path), range(36)))
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    assert [k for k, packet in enumerate(packets) if packet.is_keyframe] == [0, 12, 24]
    data, packet = bytearray(path.read_bytes()), packets[number]
    data[packet.pos + packet.size // 2 : packet.pos + packet.size] = bytes(packet.size - packet.size // 2)
    path.write_bytes(bytes(data))
    found = dict(video_file.read(video_file.probe(path), range(36)))
    assert sorted(found) == [*range(number), *range(number // 12 * 12 + 12, 36)]
    assert all((whole[index] == pixels).all() for index, pixels in found.items())


@pytest.mark.parametrize("content", [b"", b"not a video", None])
def test_a_damaged_file_is_refused(tmp_path, content):
    path = tmp_path / "a.mp4"
    if content is None:  # the index at the end is missing
        recordings.write_video(path, recordings.gray_frames(10), np.arange(10) / 10)
        content = path.read_bytes()[: path.stat().st_size // 2]
    path.write_bytes(content)
    with pytest.raises(DatasetError, match="a.mp4: the video cannot be opened"):
        video_file.probe(path)


def pq(nits):
    """Inverse EOTF of SMPTE ST 2084."""
    y = (nits / 10000.0) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * y) / (1 + 2392 / 128 * y)) ** (2523 / 32)


def test_reference_white_of_hdr_becomes_a_light_gray_and_highlights_stay_distinct():
    conversion = wide_color.of(wide_color.PQ, wide_color.BT2020)
    levels = np.array([0.0, 20.0, 203.0, 600.0, 1000.0])
    pixels = np.repeat((pq(levels) * 65535).round().astype(np.uint16)[None, :, None], 3, axis=2)
    got = conversion.apply(pixels)[0, :, 0].astype(int)
    assert got[0] == 0 and 218 <= got[2] <= 228 and got[4] >= 254  # 0.75 of linear sRGB is 225
    assert (np.diff(got) > 1).all()


def test_wide_primaries_become_more_saturated_and_white_stays():
    conversion = wide_color.of(1, wide_color.DISPLAY_P3)
    white, red = conversion.apply(np.array([[[65535, 65535, 65535], [50000, 20000, 20000]]], np.uint16))[0]
    assert white.tolist() == [255, 255, 255]
    assert int(red[0]) - int(red[1]) > (50000 - 20000) / 257 and conversion.label == "standard range, Display P3"


def test_standard_video_needs_no_conversion_and_hdr_is_said(tmp_path):
    assert wide_color.of(1, 1) is None and wide_color.of(2, 2) is None
    color = {"color_trc": wide_color.HLG, "color_primaries": wide_color.BT2020, "colorspace": 9}
    options = {"x265-params": "log-level=none"}
    path = recordings.write_video(
        tmp_path / "a.mp4",
        recordings.gray_frames(3, (64, 96)),
        np.arange(3) / 10,
        codec="libx265",
        pixel_format="yuv420p10le",
        options=options,
        color=color,
    )
    source = opened(path)
    assert source.notes == ("a.mp4: HDR (HLG), BT.2020, tone-mapped to sRGB",)
    ((_, pixels),) = source.read([1])
    assert pixels.dtype == np.uint8 and pixels.shape == (64, 96, 3) and pixels.std() > 5
