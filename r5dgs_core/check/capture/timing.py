"""Differences between the cameras' clocks, and rolling shutters, measured on motion in their common view."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...findings import Collector
from ...prepare import motion_offsets, motion_tracks
from ...prepare.clock import Offset
from ...prepare.motion_tracks import MotionTrack
from ...scene.cameras import Camera
from . import pictures
from .pictures import Album
from .recording import Recording

SIGNIFICANT, SHARE = 4.0, 0.1  # least offset in standard deviations, and in intervals
READOUT = 0.25  # least readout time, intervals
GAIN = 0.15  # least reduction of the loss by offsets or by a readout time


def track_of(one: Recording) -> MotionTrack:
    """Return the path of the largest moving region of a camera, in scene time."""
    camera = one.views[0].camera
    centers = motion_tracks.centers(one.stack)
    seen = np.isfinite(centers[:, 0])
    pixels = (centers[seen] + 0.5) * one.step
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(camera.intrinsics).T
    rows = pixels[:, 1] / camera.height - 0.5
    return MotionTrack(one.times[seen], rays[:, :2], 1.0 / float(camera.intrinsics[0, 0]), rows)


class Clocks:
    """Comparison of the cameras' clocks.

    Args:
        place: The data set, for messages.
        seconds: Seconds per unit of scene time, or None.
        collect: Findings.
        album: Pictures.
    """

    def __init__(self, place: str, seconds: float | None, collect: Collector, album: Album):
        self._place, self._seconds, self._collect, self._album = place, seconds, collect, album
        self._tracks: list[MotionTrack] = []
        self._cameras: list[Camera] = []
        self._intervals: list[float] = []

    def add(self, one: Recording) -> None:
        """Add a static camera with at least two times."""
        self._tracks.append(track_of(one))
        self._cameras.append(one.views[0].camera)
        self._intervals.append(float(np.median(np.diff(one.times))))

    def check(self) -> None:
        """Check that all cameras see the same motion at the same times."""
        step = max(self._intervals, default=0.0)
        if len(self._tracks) < 2 or step <= 0:
            return
        reach = 5.0 if self._seconds is None else 5.0 / self._seconds
        poses = [camera.T_cam_world for camera in self._cameras]
        found = motion_offsets.measure([{0: track} for track in self._tracks], poses, self._intervals, reach)
        if found is None:
            return
        known = [k for k, one in enumerate(found) if one.sigma is not None and one.sigma < 0.5 * step]
        late = [k for k in known if abs(found[k].seconds) > max(SIGNIFICANT * (found[k].sigma or 0.0), SHARE * step)]
        offsets = np.array([one.seconds if k in known else 0.0 for k, one in enumerate(found)])
        if late and self._misfit(offsets) < (1 - GAIN) * self._misfit(0 * offsets):
            self._report(found, offsets, late)
        elif len(known) == len(found):
            self._check_shutter()

    def _misfit(self, offsets: np.ndarray, readout: float = 0.0) -> float:
        tracks = [{0: read_by_rows(one, readout) if readout else one} for one in self._tracks]
        poses = [camera.T_cam_world for camera in self._cameras]
        return motion_offsets.misfit(tracks, poses, max(self._intervals), offsets)

    def _unit(self) -> tuple[float, str]:
        """Factor from scene time to the unit of messages, and its name."""
        if self._seconds is None:
            return 1.0 / max(self._intervals), "intervals"
        return 1e3 * self._seconds, "ms"

    def _report(self, found: Sequence[Offset], offsets: np.ndarray, late: Sequence[int]) -> None:
        scale, unit = self._unit()
        names = [camera.name for camera in self._cameras]
        errors = [0.0 if one.sigma is None else one.sigma * scale for one in found]
        picture = self._album.write(
            "D67", lambda: pictures.bars(names, (offsets * scale).tolist(), errors, unit, "Clocks")
        )
        listed = ", ".join(f"{names[k]} by {offsets[k] * scale:+.3g} {unit}" for k in late)
        self._collect.add("D67", f"{self._place}: clocks differ from that of {names[0]}: {listed}", picture=picture)

    def _check_shutter(self) -> None:
        """Look for one readout time of all cameras that explains the motion better than none."""
        scale, unit = self._unit()
        step = max(self._intervals)
        trials = np.linspace(-1.0, 1.0, 41) * step
        zero = np.zeros(len(self._tracks))
        loss = np.array([self._misfit(zero, trial) for trial in trials])
        if not np.isfinite(loss).all():
            return
        best = int(np.argmin(loss))
        if abs(trials[best]) < READOUT * step or loss[best] > (1 - GAIN) * loss[len(trials) // 2]:
            return
        rows = [("all cameras", loss)]
        self._collect.add(
            "D65",
            f"{self._place}: the cameras agree better if the rows of an image are read within "
            f"{abs(trials[best]) * scale:.3g} {unit}",
            picture=self._album.write(
                "D65",
                lambda: pictures.curves(trials * scale, rows, f"readout time, {unit}", "misfit", "Rolling shutter"),
            ),
        )

    def check_record(self, record: Mapping[str, Any] | None) -> None:
        """Report offsets that ``r5dgs prepare`` could not measure, and gaps of the recordings."""
        cameras = [] if record is None else record.get("cameras", [])
        names = [one["name"] for one in cameras]
        unknown = [one["name"] for one in cameras if one.get("offset_sigma_ms") is None]
        if len(cameras) > 1 and unknown:
            values = [float(one["offset_ms"]) for one in cameras]
            errors = [float(one["offset_sigma_ms"] or 0.0) for one in cameras]
            picture = self._album.write(
                "D72", lambda: pictures.bars(names, values, errors, "ms", "Offsets that are known")
            )
            message = f"{self._place}: the clocks of {', '.join(unknown)} were not compared"
            self._collect.add("D72", message, picture=picture)
        for one in cameras:
            if gaps := one.get("gaps", []):
                rows = [("interval", np.array([gap["ms"] for gap in gaps]))]
                after = np.array([gap["after_frame"] for gap in gaps])
                draw = functools.partial(pictures.curves, after, rows, "frame", "ms", f"{one['name']}: gaps")
                self._collect.add(
                    "D66",
                    f"{self._place}: the recording of {one['name']} has {_counted(gaps)}, the first of "
                    f"{gaps[0]['ms']:.0f} ms after frame {gaps[0]['after_frame']}",
                    picture=self._album.write(f"D66_recording_{one['name']}", draw),
                )


def _counted(gaps: Sequence[Any]) -> str:
    return "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"


def read_by_rows(track: MotionTrack, readout: float) -> MotionTrack:
    """Return a track whose times follow a rolling shutter with a readout time."""
    times = track.times + readout * track.rows
    order = np.argsort(times, kind="stable")
    keep = order[np.concatenate([[True], np.diff(times[order]) > 0])] if len(order) else order
    return MotionTrack(times[keep], track.points[keep], track.pixel, track.rows[keep])
