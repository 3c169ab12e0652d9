"""Conversion of decoded video to sRGB: HDR transfer curves, tone mapping and wide primaries.

Video with the primaries and the curve of BT.709 is display-referred as decoded, and needs no conversion. HDR is mapped
to sRGB with reference white, 203 cd/m^2, at 0.75 of sRGB's linear range; brighter light is compressed smoothly.

Sources: ITU-R BT.2100 (PQ, HLG), BT.2408 (reference white), BT.2087 (primaries).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ..color import srgb

# Codes of ISO/IEC 23091-2.
BT2020, DISPLAY_P3, DCI_P3 = 9, 12, 11
PQ, HLG = 16, 18
WHITE_NITS = 203.0
WHITE = 0.75  # linear sRGB value of reference white; the rest is for highlights
PEAK = 1000.0 / WHITE_NITS * WHITE  # light that is mapped to 1
_HLG_NITS = 1000.0

_TO_BT709 = {
    BT2020: np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]),
    DISPLAY_P3: np.array([[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]]),
}


@dataclass(frozen=True)
class Conversion:
    """Conversion of a video's colours.

    Attributes:
        transfer: `PQ`, `HLG`, or 0 for a standard range.
        primaries: `BT2020` or `DISPLAY_P3`, or 0 for BT.709.
    """

    transfer: int
    primaries: int

    @property
    def label(self) -> str:
        """Short description for messages, such as "HDR (HLG), BT.2020"."""
        curve = {PQ: "HDR (PQ)", HLG: "HDR (HLG)"}.get(self.transfer, "standard range")
        return f"{curve}, {({BT2020: 'BT.2020', DISPLAY_P3: 'Display P3'}).get(self.primaries, 'BT.709')}"

    def apply(self, pixels: np.ndarray) -> np.ndarray:
        """Convert decoded RGB to sRGB. [H, W, 3] uint16 -> [H, W, 3] uint8"""
        light = _decoding(self.transfer)[pixels]
        if self.primaries:
            light = light @ _TO_BT709[self.primaries].T.astype(np.float32)
        if self.transfer:
            light = tone_map(light)
        return _encoding()[(np.clip(light, 0.0, 1.0) * 4095.0 + 0.5).astype(np.uint16)]


def of(transfer: int, primaries: int) -> Conversion | None:
    """Return the conversion for a video's codes of ISO/IEC 23091-2; None if it needs none."""
    wide = {BT2020: BT2020, DISPLAY_P3: DISPLAY_P3, DCI_P3: DISPLAY_P3}.get(primaries, 0)
    hdr = transfer if transfer in (PQ, HLG) else 0
    return Conversion(hdr, wide) if hdr or wide else None


def tone_map(light: np.ndarray) -> np.ndarray:
    """Compress linear light above `WHITE` to the range up to 1, at `PEAK`, with a continuous slope.

    The largest channel is compressed and the others follow, so that hues stay.
    """
    light = np.maximum(light, 0.0)
    top = light.max(axis=-1, keepdims=True)
    rest, span = 1.0 - WHITE, PEAK - WHITE
    # x / (1 + x (1/rest - 1/span)) has slope 1 at 0, and the value `rest` at `span`.
    over = np.clip(top - WHITE, 0.0, span)
    mapped = np.where(top > WHITE, WHITE + over / (1.0 + over * (1.0 / rest - 1.0 / span)), top)
    return light * (mapped / np.maximum(top, 1e-6))


@functools.cache
def _decoding(transfer: int) -> np.ndarray:
    """Linear light for each 16-bit value, 1 being the white of sRGB. [65536] float32"""
    value = np.arange(65536) / 65535.0
    if transfer == PQ:
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        power = value ** (1 / m2)
        nits = 10000.0 * (np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1 / m1)
        return (nits / WHITE_NITS * WHITE).astype(np.float32)
    if transfer == HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        scene = np.where(value <= 0.5, value**2 / 3, (np.exp((value - c) / a) + b) / 12)
        # The display's system gamma of 1.2 is applied per channel instead of by luminance.
        return (_HLG_NITS * scene**1.2 / WHITE_NITS * WHITE).astype(np.float32)
    return srgb.to_linear(value).astype(np.float32)


@functools.cache
def _encoding() -> np.ndarray:
    """sRGB value for each of 4096 levels of linear light. [4096] uint8"""
    return np.rint(srgb.from_linear(np.arange(4096) / 4095.0) * 255.0).astype(np.uint8)
