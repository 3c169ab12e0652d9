"""Rasterizer for NVIDIA GPUs: projection in torch or by gsplat, blending by gsplat kernels (Apache-2.0).

Four functions of gsplat are used: `isect_tiles` and `isect_offset_encode` list the Gaussians of each tile,
`rasterize_to_pixels` blends them, and `fully_fused_projection` projects them if `RasterSettings.exact` is False.
Otherwise the projection is that of the reference, so that both backends draw the same Gaussians in the same order:
gsplat's projection lacks skew and a configurable clamp, and culls and sorts in float32.

gsplat is imported on the first call. Its thresholds are compile-time constants; `Kernels` records them, and
`check_settings` rejects settings that differ.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import sys

import numpy as np
import torch

from .. import errors, extras
from ..scene.cameras import Camera
from .arrays import Array
from .backend import Backend
from .cuda_projection import TILE, Inputs, Kernels, Projected, project
from .settings import RasterSettings, RasterStats, SplatImage
from .torch_backend import ArrayAdapter, TorchBackend

log = logging.getLogger(__name__)

# Compiled into gsplat 1.5 and 1.6. More than 32 channels need more shared memory than some GPUs have.
CHANNEL_COUNTS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32)
OLDEST_GSPLAT = (1, 5)  # first version with one radius per axis
ALPHA_MAX_SLACK = 0.01  # accepted difference of alpha_max, with a warning


def why_unavailable(device: torch.device, dtype: torch.dtype) -> str | None:
    """Return the reason why tensors of this device and dtype cannot be rasterized here, and the remedy, or None.

    The first call may take minutes, as gsplat compiles its kernels when they are first loaded on a machine.
    """
    if torch.version.cuda is None:
        return (
            f"torch {torch.__version__} is built without CUDA; remedy: install a CUDA build of torch "
            "(https://pytorch.org/get-started), or use backend='cpu'"
        )
    if not torch.cuda.is_available():
        return (
            "torch finds no CUDA device; remedy: check that nvidia-smi lists a GPU, that its driver is new enough for "
            f"CUDA {torch.version.cuda} and that CUDA_VISIBLE_DEVICES does not hide it, or use backend='cpu'"
        )
    if device.type != "cuda":
        return f"expected tensors on a CUDA device, got {device}; remedy: move them there, or use backend='cpu'"
    if dtype != torch.float32:
        return f"expected float32 tensors, got {dtype}; remedy: convert them, or use backend='reference'"
    kernels = find_kernels()
    return kernels if isinstance(kernels, str) else None


@functools.cache
def find_kernels() -> Kernels | str:
    """Return the kernels of gsplat, or why they cannot be loaded. Cached, as a failing build takes long."""
    log.info("rasterizer 'cuda': loading gsplat; the first time on a machine it compiles for minutes")
    version = "(unknown version)"
    try:
        # gsplat prints build messages to stdout, which `--progress json` uses.
        with contextlib.redirect_stdout(sys.stderr):
            import gsplat

            version = gsplat.__version__
            if tuple(int(part) for part in version.split(".")[:2]) < OLDEST_GSPLAT:
                oldest = ".".join(map(str, OLDEST_GSPLAT))
                return f"gsplat {version} is too old; remedy: pip install -U 'gsplat>={oldest}'"
            from gsplat.cuda import _backend
    except Exception as error:  # compiler, linker and loader raise many types
        if isinstance(error, ModuleNotFoundError) and error.name == "gsplat":
            return f"gsplat is not installed; remedy: {extras.command('cuda')}"
        what = (str(error).splitlines() or [""])[0]
        return (
            f"gsplat {version} does not load ({type(error).__name__}: {what}); remedy: check that nvcc of CUDA "
            f"{torch.version.cuda} and a compatible C++ compiler are installed; `python -c 'from gsplat.cuda import "
            "_backend'` shows the whole message"
        )
    if _backend._C is None:
        return (
            f"gsplat {version} finds no CUDA toolkit to compile its kernels with; remedy: install CUDA "
            f"{torch.version.cuda} with nvcc and set CUDA_HOME, or a gsplat wheel with compiled kernels"
        )
    return Kernels(
        gsplat.isect_tiles,
        gsplat.isect_offset_encode,
        gsplat.rasterize_to_pixels,
        gsplat.fully_fused_projection,
        version,
        **_read_thresholds(),
    )


def _read_thresholds() -> dict[str, float]:
    """Thresholds of the installed gsplat: 1.6 exports them, those of 1.5 are hard-coded in its kernels."""
    try:
        from gsplat.cuda import _constants as constants
    except ImportError:
        return {"alpha_min": 1 / 255, "alpha_max": 0.999, "transmittance_min": 1e-4}
    return {
        "alpha_min": constants.ALPHA_THRESHOLD,
        "alpha_max": constants.MAX_ALPHA,
        "transmittance_min": constants.TRANSMITTANCE_THRESHOLD,
    }


def check_settings(settings: RasterSettings, kernels: Kernels, opacities: torch.Tensor) -> None:
    """Raise BackendError for a setting that the kernels cannot meet; warn if they nearly meet it.

    Args:
        settings: Requested settings.
        kernels: Kernels with their compiled thresholds.
        opacities: If none exceeds either cap, ``alpha_max`` has no effect and any value is accepted. [N]
    """
    for name in ("alpha_min", "transmittance_min"):
        wanted, there = getattr(settings, name), getattr(kernels, name)
        if not math.isclose(wanted, there, rel_tol=1e-6):
            raise errors.BackendError(_cannot_meet(name, wanted, there, kernels))
    wanted, there = settings.alpha_max, kernels.alpha_max
    if math.isclose(wanted, there, rel_tol=1e-6) or not len(opacities):
        return
    if settings.exact and opacities.detach().max().item() <= min(wanted, there):
        return
    if abs(wanted - there) > ALPHA_MAX_SLACK:
        raise errors.BackendError(_cannot_meet("alpha_max", wanted, there, kernels))
    _warn_once(
        f"rasterizer 'cuda': gsplat {kernels.version} caps alpha at {there:g}, alpha_max is {wanted:g}: pixels in the "
        f"middle of Gaussians with a higher opacity differ by up to {ALPHA_MAX_SLACK:g} of a colour"
        + ("; gsplat 1.6 caps at 0.99" if there == 0.999 else "")
    )


def _cannot_meet(name: str, wanted: float, there: float, kernels: Kernels) -> str:
    return (
        f"rasterizer 'cuda': {name}: expected {there:g}, the value compiled into gsplat {kernels.version}, got "
        f"{wanted:g}; remedy: use that value, or use backend='cpu' or 'reference'"
    )


@functools.cache
def _warn_once(message: str) -> None:
    log.warning(message)


def _blend(splats: Projected, values: torch.Tensor, kernels: Kernels) -> tuple[torch.Tensor, torch.Tensor]:
    """Blend values [V, D] front to back: weighted sums [H, W, D] and alpha [H, W]."""
    if not len(values):
        # An empty sum is zero and keeps the result connected to the inputs' graph.
        nothing = sum(t.sum() for t in (splats.means2d, splats.conics, splats.opacities, values))
        zeros = values.new_zeros((splats.height, splats.width, values.shape[1] + 1)) + nothing
        return zeros[..., 1:], zeros[..., 0]
    sums, alpha = [], None
    for part in values.split(CHANNEL_COUNTS[-1], 1):
        n = part.shape[1]
        count = next(c for c in CHANNEL_COUNTS if c >= n)
        colors, alphas = kernels.rasterize_to_pixels(
            splats.means2d[None],
            splats.conics[None],
            torch.nn.functional.pad(part, (0, count - n))[None],
            splats.opacities[None],
            splats.width,
            splats.height,
            TILE,
            splats.tile_starts,
            splats.pairs,
        )
        sums.append(colors[0, ..., :n])
        alpha = alphas[0, ..., 0] if alpha is None else alpha
    assert alpha is not None
    return torch.cat(sums, -1), alpha


@torch.no_grad()
def _heaviest(
    splats: Projected,
    labels: torch.Tensor,  # [V]
    alpha: torch.Tensor,  # [H, W]
    kernels: Kernels,
    settings: RasterSettings,
) -> torch.Tensor:
    """Label with the largest sum of weights per pixel, the smallest on ties, -1 if alpha is small. [H, W] int32

    Each label is a channel that is 1 for its Gaussians, so one pass covers 32 labels.
    """
    known, members = torch.unique(labels.clamp_min(-1), return_inverse=True)
    ids = torch.full(alpha.shape, -1, dtype=torch.int32, device=alpha.device)
    most = torch.zeros_like(alpha)
    for first in range(0, len(known), CHANNEL_COUNTS[-1]):
        some = torch.arange(first, min(first + CHANNEL_COUNTS[-1], len(known)), device=alpha.device)
        votes, _ = _blend(splats, (members[:, None] == some).to(alpha.dtype), kernels)
        weight, which = votes.max(-1)  # returns the first maximum; labels ascend
        ids = torch.where(weight > most, known[some[which]].to(torch.int32), ids)
        most = torch.maximum(weight, most)
    return torch.where(alpha >= settings.id_alpha_min, ids, -1)


class CudaBackend(TorchBackend):
    """gsplat's kernels, for float32 tensors on a GPU."""

    name = "cuda"

    def hardware(self) -> str:
        """See `Backend.hardware`."""
        return torch.cuda.get_device_name()

    def for_inputs(self, like: Array) -> Backend:
        """See `Backend.for_inputs`; arrays are copied to the current GPU."""
        return ArrayAdapter(self, "cuda") if isinstance(like, np.ndarray) else self

    def suits(self, like: torch.Tensor) -> bool:
        """See `Backend.suits`."""
        return like.device.type == "cuda" and like.dtype == torch.float32

    def why_unavailable(self, like: torch.Tensor) -> str | None:
        """See `Backend.why_unavailable`."""
        return why_unavailable(like.device, like.dtype)

    def rasterize_splats(
        self,
        means: torch.Tensor,
        quats: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        channels: torch.Tensor,
        camera: Camera,
        background: torch.Tensor | None,
        labels: torch.Tensor | None,
        settings: RasterSettings,
        stats: RasterStats | None,
    ) -> SplatImage:
        """See `Backend.rasterize_splats`."""
        kernels = find_kernels()
        if isinstance(kernels, str):
            raise errors.BackendError(f"rasterizer 'cuda': {kernels}")
        check_settings(settings, kernels, opacities)
        splats = project(Inputs(means, quats, scales, opacities, camera, settings, stats, kernels))
        blended, alpha = _blend(splats, torch.cat([splats.of(channels), splats.depths[:, None]], 1), kernels)
        covered = alpha > 0
        depth = torch.where(covered, blended[..., -1] / torch.where(covered, alpha, 1), 0)
        image = blended[..., :-1]
        if background is not None:
            image = image + (1 - alpha)[..., None] * background
        ids = None
        if labels is not None:
            ids = _heaviest(splats, splats.of(labels.to(means.device)), alpha, kernels, settings)
        return SplatImage(image, alpha, depth, ids)


BACKEND = CudaBackend()
