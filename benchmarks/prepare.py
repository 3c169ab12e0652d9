"""Processor time and memory of `r5dgs prepare`, by number of frames.

    python -m benchmarks.prepare [--cameras 4] [--frames 100 300] [--size 1920 1080] [--lines 960] [--json FILE]

Videos (H.264, 30 per second, lens distortion) of a ball that swings over a texture are written first, with the smallest
number of frames; longer videos repeat their packets. Each number of frames is then prepared in a process of its own,
with clocks compared by motion.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from . import own_process

RATE = 30.0


def write_videos(folder: Path, cameras: int, frames: int, width: int, height: int) -> None:
    """Write videos of a number of frames, and their calibration."""
    from tests.support import recordings

    rig = recordings.make_rig(cameras, width, height, (-0.1, 0.02, 0.001, -0.001, 0.0))
    times = [np.arange(frames) / RATE] * cameras
    recordings.record(folder, rig, times, recordings.draw_ball)


def repeat(source: Path, target: Path, count: int, seconds: float) -> None:
    """Write a folder with videos that show those of another folder several times.

    Args:
        source: Folder of the videos and the calibration.
        target: Folder to write.
        count: Number of repetitions.
        seconds: Duration of the videos.
    """
    import av

    shutil.copytree(source, target, ignore=shutil.ignore_patterns("*.mp4"))
    for path in sorted(source.glob("*.mp4")):
        with av.open(str(target / path.name), "w") as written:
            stream = None
            for number in range(count):
                with av.open(str(path)) as read:
                    stream = stream or written.add_stream_from_template(read.streams.video[0])
                    for packet in read.demux(video=0):
                        if packet.dts is None or packet.pts is None or packet.time_base is None:
                            continue  # the flushing packet
                        shift = round(number * seconds / packet.time_base)
                        packet.pts, packet.dts, packet.stream = packet.pts + shift, packet.dts + shift, stream
                        written.mux(packet)


def measure(source: Path, out: Path, lines: int) -> dict[str, Any]:
    """Prepare a data set; returns processor seconds and the peak memory of this process."""
    from r5dgs_core.cli.commands import prepare

    before = resource.getrusage(resource.RUSAGE_SELF)
    began = time.monotonic()
    plan = prepare.run_prepare(source, out, lines=lines, sync="motion")
    after = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "images": sum(len(indices) for indices in plan.choice.indices),
        "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "wall_s": time.monotonic() - began,
        "peak_mb": after.ru_maxrss / 1024,
        "offset_error_ms": 1e3 * max(abs(offset.seconds) for offset in plan.offsets),
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 300], help="multiples of the smallest")
    parser.add_argument("--size", type=int, nargs=2, default=[1920, 1080], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--lines", type=int, default=960)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows, least = [], min(args.frames)
    if any(frames % least for frames in args.frames):
        parser.error(f"--frames: expected multiples of {least}, the smallest number")
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "written"
        own_process.run(write_videos, written, args.cameras, least, *args.size)
        for frames in args.frames:
            source, out = Path(folder) / f"videos_{frames}", Path(folder) / f"data_{frames}"
            repeat(written, source, frames // least, least / RATE)
            found = own_process.run(measure, source, out, args.lines)
            rows.append({"cameras": args.cameras, "frames": frames, **found})
            row = rows[-1]
            print(
                f"{row['cameras']} cameras x {frames} frames: {row['cpu_s']:.1f} s of processor time "
                f"({1e3 * row['cpu_s'] / row['images']:.0f} ms per image), {row['peak_mb']:.0f} MB",
                flush=True,
            )
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
