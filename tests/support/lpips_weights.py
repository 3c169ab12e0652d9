"""Seeded random weights of LPIPS, equal on all machines, and images to compare."""

import numpy as np
import torch

from r5dgs_core.evaluation import lpips


def tensors(name: str) -> dict[str, torch.Tensor]:
    """Random tensors of a network by the names of `lpips.Network.shapes`; the heads are not negative."""
    rng = np.random.default_rng(7)
    found = {}
    for key, shape in lpips.NETWORKS[name].shapes.items():
        if key.startswith("lin"):
            values = rng.random(shape, np.float32)
        elif key.endswith("bias"):
            values = 0.1 * rng.standard_normal(shape, np.float32)
        else:
            values = np.float32(np.sqrt(2 / np.prod(shape[1:]))) * rng.standard_normal(shape, np.float32)
        found[key] = torch.from_numpy(values)
    return found


def pairs() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Pairs of images by name, in [0, 1]. [H, W, 3] float32 each"""
    rng = np.random.default_rng(3)
    found = {}
    for name, (height, width) in {"square": (64, 64), "odd": (71, 95)}.items():
        y, x = np.mgrid[0:height, 0:width]
        waves = [0.5 + 0.5 * np.sin(0.2 * x + 0.1 * k * y + k) for k in range(3)]
        image = np.stack(waves, -1)
        noise = np.clip(image + 0.2 * rng.standard_normal(image.shape), 0, 1)
        found[f"{name}, noise"] = image.astype(np.float32), noise.astype(np.float32)
        found[f"{name}, shift"] = image.astype(np.float32), np.roll(image, 3, 1).astype(np.float32)
    return found
