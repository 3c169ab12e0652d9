"""Error against run time of the rasterizer's own settings.

    python -m benchmarks.raster error [--workloads W1,tabletop-small] [--json FILE] [--plot FILE]

Settings are changed one at a time, and a few together; the others are those of 3DGS. The ground truth is the reference
in float64 with minimal cut-offs (`IDEAL`). Errors are those of the colors of the whole image: largest and root mean
square difference, and PSNR. Times are of whole forward calls on one thread, from Gaussians with spherical harmonics to
pixels, in interleaved rounds: minimum processor time and median wall time. A point is on the Pareto front of its
workload if no point with less processor time has at most its error.

Rows have the shape of ``r5dgs report``: ``ms`` is the smallest processor time, ``error_kind`` max_abs, rms or psnr_db.
Results: docs/results/rasterizer.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch.nn.functional import interpolate

from r5dgs_core.raster import rasterize, thread_pool
from r5dgs_core.scene import spherical_harmonics
from r5dgs_core.scene.cameras import Camera

from .. import timing
from . import polynomials, tabletop, workloads

IDEAL = {"alpha_min": 1e-4, "transmittance_min": 1e-8}
DEFAULT = "defaults"
GROUPS = ("cut-offs", "harmonics", "resolution", "precision", "exponential")
ERROR_KINDS = ("max_abs", "rms", "psnr_db")


@dataclass(frozen=True)
class Variant:
    """One way to draw a workload.

    Attributes:
        group: Group of the varied setting, one of `GROUPS`.
        setting: Description of the differences from the defaults.
        changes: Changed `RasterSettings`.
        sh_degree: Highest degree of the spherical harmonics that are evaluated.
        scale: Share of the resolution at which the image is drawn before it is enlarged.
        backend: Backend of the rasterizer.
        dtype: Dtype of the tensors.
        exp2_degree: Degree of the polynomial of the exponential, or None for that of the rasterizer.
    """

    group: str
    setting: str
    changes: dict[str, float] = dataclasses.field(default_factory=dict)
    sh_degree: int = 3
    scale: float = 1.0
    backend: str = "cpu"
    dtype: torch.dtype = torch.float32
    exp2_degree: int | None = None


VARIANTS = (
    Variant("", DEFAULT),
    *(Variant("cut-offs", f"alpha_min 1/{n}", {"alpha_min": 1 / n}) for n in (4096, 1024, 512, 128, 64, 32, 16)),
    *(
        Variant("cut-offs", f"transmittance_min {t:g}", {"transmittance_min": t})
        for t in (1e-6, 1e-5, 1e-3, 1e-2, 3e-2, 1e-1)
    ),
    *(
        Variant("cut-offs", f"alpha_min 1/{n}, transmittance_min {t:g}", {"alpha_min": 1 / n, "transmittance_min": t})
        for n, t in ((1024, 1e-6), (1024, 1e-2), (512, 1e-3), (512, 1e-2), (128, 1e-3), (64, 1e-2))
    ),
    *(Variant("harmonics", f"SH degree {degree}", sh_degree=degree) for degree in (2, 1, 0)),
    *(
        Variant("resolution", f"resolution {name}, dilation {dilation:g}", {"dilation": dilation}, scale=scale)
        for name, scale, dilation in (("3/4", 0.75, 0.3), ("1/2", 0.5, 0.3), ("1/2", 0.5, 0.075))
    ),
    Variant("precision", "plain torch, float32", backend="reference"),
    Variant("precision", "plain torch, float64", backend="reference", dtype=torch.float64),
    *(Variant("exponential", f"exp2 of degree {degree}", exp2_degree=degree) for degree in (2, 3, 4, 6)),
)


@dataclass
class Point:
    """A variant measured on a workload: errors by kind, smallest processor and median wall milliseconds."""

    task: str
    variant: Variant
    errors: dict[str, float]
    ms: float
    wall_ms: float
    pareto: dict[str, bool] = dataclasses.field(default_factory=dict)


def main(arguments: list[str] | None = None) -> None:
    """Measure, print the table, write rows and plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workloads", type=workloads.name_list, nargs="+", default=[["W1", "tabletop-small"]])
    parser.add_argument(
        "--groups", type=workloads.name_list, nargs="+", default=[list(GROUPS)], help="settings to vary"
    )
    parser.add_argument("--repeats", type=int, default=15, help="rounds; default 15")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--plot", type=Path, help="write the plot to this file")
    options = parser.parse_args(arguments)
    if options.json and not options.json.parent.is_dir():
        parser.error(f"--json: no folder {options.json.parent}")
    groups = [group for part in options.groups for group in part]
    if not set(groups) <= set(GROUPS):
        parser.error(f"--groups: expected of {', '.join(GROUPS)}, got {', '.join(sorted(set(groups) - set(GROUPS)))}")
    points: list[Point] = []
    try:
        for name in [name for part in options.workloads for name in part]:
            workloads.check(name)
            new = measure(name, [v for v in VARIANTS if v.group in ("", *groups)], options.repeats)
            print(table(new), flush=True)
            points += new
    except ValueError as error:
        parser.error(str(error))
    if options.json:
        options.json.write_text(json.dumps([row for point in points for row in to_rows(point)], indent=1) + "\n")
    if options.plot:
        plot(points, options.plot)


def measure(name: str, variants: Sequence[Variant], repeats: int) -> list[Point]:
    """Times and errors of variants of a workload, the Pareto front marked."""
    drawers = Drawers(name)
    print(f"{name}: drawing the truth in float64, alpha_min 1e-4, transmittance_min 1e-8", flush=True)
    truth = drawers.make(Variant("", "ideal", IDEAL, backend="reference", dtype=torch.float64))()
    contenders: list[timing.Contender] = []
    threads = thread_pool.threads()
    thread_pool.set_threads(1)
    try:
        for variant in variants:
            label = {"setting": variant.setting}
            if variant.exp2_degree is None:
                contenders.append(timing.Contender(label, drawers.make(variant)))
            else:
                coefficients = polynomials.fit(variant.exp2_degree)
                make_run = functools.partial(make_drawer, name, variant)
                contenders.append(polynomials.Remote(label, coefficients, make_run))
        timing.take_turns(contenders, repeats, memory=False)
        points = [
            Point(
                f"rasterize {name}",
                variant,
                errors_of(contender.run(), truth),
                contender.times.cpu[0],
                contender.times.ms(),
            )
            for variant, contender in zip(variants, contenders, strict=True)
        ]
    finally:
        thread_pool.set_threads(threads)
        for contender in contenders:
            if isinstance(contender, polynomials.Remote):
                contender.close()
    for kind in ERROR_KINDS:
        for point, on_front in zip(points, front([(p.ms, _badness(p, kind)) for p in points]), strict=True):
            point.pareto[kind] = on_front
    return points


class Drawers:
    """A workload with spherical harmonics, ready to be drawn in any `Variant`."""

    def __init__(self, name: str):
        self.workload = workloads.make(name)
        means, quats, scales, opacities, channels = self.workload.inputs
        if self.workload.scene is not None:
            sh = torch.from_numpy(self.workload.scene.gaussians.sh)
        else:
            sh = _harmonics(channels[:, :3])
        self.params = {
            "means": means,
            "quats": quats,
            "log_scales": scales.log(),
            "opacity_logits": opacities.logit(),
            "sh": sh,
        }

    def make(self, variant: Variant) -> Callable[[], torch.Tensor]:
        """The function that draws the variant's colour image. [H, W, 3]"""
        count = (variant.sh_degree + 1) ** 2
        params = {name: tensor.to(variant.dtype) for name, tensor in self.params.items()}
        gaussians = SimpleNamespace(**{**params, "sh": params["sh"][:, :count].contiguous()})
        settings = dataclasses.replace(self.workload.settings, **variant.changes)
        full = self.workload.camera
        camera = full if variant.scale == 1 else _shrink(full, variant.scale)

        @torch.no_grad()
        def draw() -> torch.Tensor:
            color = rasterize(gaussians, camera, settings=settings, backend=variant.backend).color
            if camera is full:
                return color
            planes = color.permute(2, 0, 1)[None]
            return interpolate(planes, (full.height, full.width), mode="bilinear")[0].permute(1, 2, 0)

        return draw


def make_drawer(name: str, variant: Variant) -> Callable[[], torch.Tensor]:
    """Return the function that draws a variant of a workload. It is created in the process that calls it."""
    return Drawers(name).make(variant)


def _harmonics(colors: torch.Tensor) -> torch.Tensor:
    """Coefficients of degree 3 around given colours, of the size that training gives. [N, 3] -> [N, 16, 3]"""
    generator = torch.Generator().manual_seed(3)
    sh = torch.randn((len(colors), 16, 3), generator=generator)
    for degree, spread in enumerate(tabletop.SH_SPREAD):
        sh[:, degree**2 : (degree + 1) ** 2] *= spread
    sh[:, 0] = spherical_harmonics.rgb_to_dc(colors)
    return sh


def _shrink(camera: Camera, scale: float) -> Camera:
    """The same view in fewer pixels."""
    width, height = round(scale * camera.width), round(scale * camera.height)
    factors = np.array([[width / camera.width], [height / camera.height], [1.0]])
    return Camera(width, height, camera.intrinsics * factors, camera.T_cam_world, camera.name)


def errors_of(image: torch.Tensor, truth: torch.Tensor) -> dict[str, float]:
    """Largest absolute difference, root mean square, and PSNR in dB."""
    difference = image.double() - truth
    rms = math.sqrt(difference.square().mean().item())
    psnr_db = -20 * math.log10(max(rms, 1e-12))
    return dict(zip(ERROR_KINDS, (difference.abs().max().item(), rms, psnr_db), strict=True))


def _badness(point: Point, kind: str) -> float:
    """The error with a sign such that smaller is better for all kinds."""
    return -point.errors[kind] if kind == "psnr_db" else point.errors[kind]


def front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """True for each point (time, error) on the Pareto front: no other has at most as much of both, and less of one."""
    return [not any(t <= time and e <= error and (t < time or e < error) for t, e in points) for time, error in points]


def table(points: Sequence[Point]) -> str:
    """Format all points, fastest first, and the verdict on the defaults."""
    lines = [f"{'cpu ms':>9} {'wall ms':>9} {'max abs':>9} {'rms':>9} {'PSNR dB':>8}  front (by rms)"]
    for point in sorted(points, key=lambda p: p.ms):
        e = point.errors
        mark = "*" if point.pareto["rms"] else " "
        lines.append(
            f"{point.ms:9.2f} {point.wall_ms:9.2f} {e['max_abs']:9.1e} {e['rms']:9.1e} {e['psnr_db']:8.2f}  "
            f"{mark} {point.variant.setting}"
        )
    return "\n".join([*lines, verdict(points)])


def verdict(points: Sequence[Point]) -> str:
    """Format the verdict: the defaults are on the front by rms, or the points that beat them."""
    own = next(point for point in points if point.variant.setting == DEFAULT)
    error = own.errors["rms"]
    better = [p for p in points if p.ms < own.ms and p.errors["rms"] <= error]
    task = f"{own.task}: the defaults (rms {error:.2e}, {own.ms:.2f} ms)"
    if not better:
        return f"{task} are on the front."
    found = {
        p.variant.setting: p for p in (min(better, key=lambda p: p.ms), min(better, key=lambda p: p.errors["rms"]))
    }
    rivals = [
        f"{name} takes {100 * (1 - p.ms / own.ms):.0f} % less time at {p.errors['rms'] / error:.2f} of the error"
        for name, p in found.items()
    ]
    return f"{task} are off the front: {'; '.join(rivals)}."


def to_rows(point: Point) -> list[dict[str, Any]]:
    """Rows of the report, one for each kind of error."""
    return [
        {
            "task": point.task,
            "mode": "forward",
            "method": point.variant.backend,
            "setting": point.variant.setting,
            "error_kind": kind,
            "error": point.errors[kind],
            "ms": round(point.ms, 3),
            "pareto": point.pareto[kind],
        }
        for kind in ERROR_KINDS
    ]


def plot(points: Sequence[Point], path: Path) -> None:
    """Plot root mean square error over milliseconds, one panel per workload; numbers refer to the list beside it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tasks = list(dict.fromkeys(point.task for point in points))
    variants = [point.variant for point in points if point.task == tasks[0]]
    shades = ("black", "tab:blue", "tab:green", "tab:orange", "tab:red", "tab:purple")
    colors = dict(zip(("", *GROUPS), shades, strict=True))
    ratios = [6.0] * len(tasks) + [3.4]
    figure, axes = plt.subplots(
        1, len(ratios), figsize=(sum(ratios), 7), layout="constrained", squeeze=False, width_ratios=ratios
    )
    for axis, task in zip(axes[0], tasks, strict=False):
        numbered = [(number, p) for number, p in enumerate((p for p in points if p.task == task), start=1)]
        shown = [(number, p) for number, p in numbered if p.variant.backend == "cpu"]
        line = sorted((p.ms, p.errors["rms"]) for _, p in shown if p.pareto["rms"])
        axis.plot([x for x, _ in line], [y for _, y in line], color="0.6", zorder=1, label="Pareto front")
        for _, point in shown:
            axis.scatter(point.ms, point.errors["rms"], s=28, color=colors[point.variant.group], zorder=2)
        axis.set(yscale="log", xlabel="one frame, processor ms, one thread", title=task)
        axis.set_ylabel("rms error of the image")
        axis.margins(x=0.1)
        axis.grid(alpha=0.3, which="both")
        for number, point in numbered:
            if point.variant.backend != "cpu":
                axis.plot(
                    [], [], " ", label=f"{number}: {point.ms:.0f} ms, {point.errors['rms']:.1e}, far to the right"
                )
        axis.legend(loc="upper right", fontsize=9)
        figure.canvas.draw()
        for at, text in _labels(axis, shown):
            axis.annotate(text, at, textcoords="offset points", xytext=(6, -3), fontsize=9)
    axes[0, -1].axis("off")
    for number, variant in enumerate(variants, start=1):
        at = 1 - number / (len(variants) + 1)
        text = f"{number}  {variant.setting}"
        axes[0, -1].text(0, at, text, fontsize=9, color=colors[variant.group], transform=axes[0, -1].transAxes)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _labels(axis: Any, numbered: Sequence[tuple[int, Point]]) -> list[tuple[tuple[float, float], str]]:
    """Numbers of the points and the positions of their labels. Close points share a label, at the rightmost of them."""
    clusters: list[list[tuple[float, float, int, Point]]] = []
    placed = [(*axis.transData.transform((p.ms, p.errors["rms"])), number, p) for number, p in numbered]
    for item in sorted(placed, key=lambda item: item[:2]):
        near = [c for c in clusters if any(abs(x - item[0]) < 45 and abs(y - item[1]) < 14 for x, y, _, _ in c)]
        merged = [item for cluster in near for item in cluster] + [item]
        clusters = [cluster for cluster in clusters if cluster not in near] + [merged]
    labels = []
    for cluster in clusters:
        point = max(cluster, key=lambda item: item[0])[3]
        text = ", ".join(str(number) for number in sorted(item[2] for item in cluster))
        labels.append(((point.ms, point.errors["rms"]), text))
    return labels


if __name__ == "__main__":
    main()
