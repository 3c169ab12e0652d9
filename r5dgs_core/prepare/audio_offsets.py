"""Offsets between the clocks of cameras from their sound.

The loudness of the whole recordings gives offsets to some milliseconds, and the phase of the sound in a few windows
gives them to a fraction of a sample (GCC-PHAT). Sound that arrives later at a farther microphone is the limit:
3 ms per metre.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import signal

from .. import extras
from ..motion.robust_weights import MEDIAN_TO_SIGMA
from .camera_source import CameraSource
from .clock import Offset, solve_pairs

RATE = 16000  # Hz
ENVELOPE_RATE = 200  # Hz
WINDOW_S, WINDOWS = 10.0, 5
SEARCH_S = 0.05  # around the offset of the loudness
PEAK = 8.0  # minimum height of a peak, in standard deviations of the correlation
SPEED = 343.0  # of sound, m/s
SOUND_PATH_S = 0.003  # standard deviation of differences in the sound's travel time if the distances are unknown


def measure(sources: Sequence[CameraSource], distances: np.ndarray | None = None) -> list[Offset] | None:
    """Measure the offset of each camera's clock.

    Args:
        sources: Cameras with sound.
        distances: Distances between the cameras, metres; None if unknown. [C, C]

    Returns:
        One offset per camera as `clock.solve_pairs` returns them; None if no sounds match.
    """
    envelopes = [_envelope(source) for source in sources]
    pairs: list[tuple[int, int, float, float]] = []
    for a in range(len(sources)):
        for b in range(a + 1, len(sources)):
            found = _pair(sources[a], sources[b], envelopes[a], envelopes[b])
            if found is not None:
                apart = SOUND_PATH_S if distances is None else distances[a, b] / SPEED / 2
                pairs.append((a, b, found[0], float(np.hypot(found[1], apart))))
    return solve_pairs(len(sources), pairs, "audio")


def _pair(
    one: CameraSource, other: CameraSource, envelope: tuple[float, np.ndarray], other_envelope: tuple[float, np.ndarray]
) -> tuple[float, float] | None:
    """Return the offset to add to the other's times, and its standard deviation, seconds; None if unsure."""
    coarse, height = _correlate(envelope[1], other_envelope[1])
    if height < PEAK:
        return None
    offset = envelope[0] - other_envelope[0] + coarse / ENVELOPE_RATE
    begin = max(one.times[0], other.times[0] + offset)
    end = min(one.times[-1], other.times[-1] + offset)
    length = min(WINDOW_S, end - begin)
    if length < 0.5:
        return None
    fine = []
    for start in np.unique(np.linspace(begin, end - length, WINDOWS).round(3)):
        x = _samples(one, start, length)
        y = _samples(other, start - offset, length)
        delay = _phase_delay(x, y)
        if delay is not None:
            fine.append(offset + delay)
    if not fine:
        return None
    return float(np.median(fine)), max(_spread(np.array(fine)) / np.sqrt(len(fine)), 0.5 / RATE)


def _correlate(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return the shift of y that fits x best, in samples, and the peak's height in standard deviations."""
    found = signal.correlate(x - x.mean(), y - y.mean(), method="fft")
    # Short overlaps correlate by chance: the sum is what counts, not its mean.
    top = int(np.argmax(found))
    return float(top - (len(y) - 1)), float((found[top] - np.median(found)) / max(_spread(found), 1e-12))


def _spread(values: np.ndarray) -> float:
    """Return the standard deviation of values by their median deviation."""
    return MEDIAN_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))


def _phase_delay(x: np.ndarray, y: np.ndarray) -> float | None:
    """Return the delay to add to the times of y, within `SEARCH_S`, seconds; None without a clear peak."""
    count = min(len(x), len(y))
    if count < RATE // 4 or x[:count].std() < 1e-6 or y[:count].std() < 1e-6:
        return None
    size = 1 << (2 * count - 1).bit_length()
    cross = np.fft.rfft(x[:count], size) * np.fft.rfft(y[:count], size).conj()
    phase = np.fft.irfft(cross / (np.abs(cross) + 1e-9 * np.abs(cross).max()), size)
    most = int(SEARCH_S * RATE)
    lags = np.concatenate([phase[-most:], phase[: most + 1]])
    top = int(np.argmax(lags))
    if not 0 < top < len(lags) - 1 or lags[top] < PEAK * _spread(lags):
        return None
    left, middle, right = lags[top - 1 : top + 2]
    bend = left - 2 * middle + right
    part = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return (top - most + float(np.clip(part, -0.5, 0.5))) / RATE


def _envelope(source: CameraSource) -> tuple[float, np.ndarray]:
    """Return the time of the first value on the camera's clock, and rises of the logarithmic loudness."""
    step = RATE // ENVELOPE_RATE
    begin, rest, levels = None, np.zeros(0, np.float32), []
    for start, samples in _sound(source, 0.0, np.inf):
        begin = start if begin is None else begin
        joined = np.concatenate([rest, samples])
        whole = len(joined) // step * step
        levels.append(np.square(joined[:whole].reshape(-1, step)).mean(1))
        rest = joined[whole:]
    power = np.concatenate(levels) if levels else np.zeros(2, np.float32)
    loudness = np.log(power + 1e-8 + 1e-3 * power.mean())
    return begin or 0.0, np.maximum(np.diff(loudness, prepend=loudness[:1]), 0.0)


def _samples(source: CameraSource, start: float, length: float) -> np.ndarray:
    """Return mono sound that starts at a time on the camera's clock, at `RATE`."""
    result = np.zeros(int(length * RATE), np.float32)
    for begin, samples in _sound(source, start, start + length):
        at = round((begin - start) * RATE)
        low, high = max(at, 0), min(at + len(samples), len(result))
        if low < high:
            result[low:high] = samples[low - at : high - at]
    return result


def _sound(source: CameraSource, start: float, end: float) -> Iterator[tuple[float, np.ndarray]]:
    """Yield blocks of mono sound: the time of the first sample on the camera's clock, and samples at `RATE`."""
    with extras.required("sound", "video"):
        import av
        import av.error
    for video, first in zip(source.videos, source.first, strict=True):
        shift = float(source.times[first] - video.times[0])  # from the file's clock to the camera's
        if source.times[first] > end:
            return
        resampler = av.AudioResampler(format="fltp", layout="mono", rate=RATE)
        with av.open(str(video.path)) as container:
            stream = container.streams.audio[0]
            wanted = start - shift - 0.2
            if wanted > 0:
                container.seek(int(wanted / float(stream.time_base or 1)), stream=stream, backward=True)
            began, count = None, 0
            try:
                for frame in container.decode(stream):
                    if frame.time is None:
                        continue
                    began = frame.time if began is None else began
                    for block in resampler.resample(frame):
                        yield began + shift + count / RATE, block.to_ndarray()[0]
                        count += block.samples
                    if frame.time + shift > end:
                        break
            except av.error.FFmpegError:
                continue  # the sound ends early
