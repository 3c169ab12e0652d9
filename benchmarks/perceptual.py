"""LPIPS of the package ``lpips`` on seeded random weights, with which the tests compare ours.

    pip install --no-deps --target FOLDER lpips torchvision tqdm
    PYTHONPATH=FOLDER python -m benchmarks.perceptual [--json FILE]

torchvision from PyPI needs CUDA; `shim` makes its networks work with torch for the CPU. The numbers are in
benchmarks/results/lpips.json.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

import numpy as np
import torch

from r5dgs_core.evaluation import lpips as ours
from tests.support import lpips_weights


def shim() -> torch.library.Library:
    """Declare the operators that torchvision looks for when it is imported; the result must be kept."""
    library = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    return library


def package_value(name: str, image: np.ndarray, truth: np.ndarray) -> float:
    """Return the distance of two images by the package."""
    import lpips

    module = lpips.LPIPS(pretrained=False, net=name, pnet_rand=True, verbose=False)
    module.load_state_dict(_state(module, lpips_weights.tensors(name)))
    pair = [torch.from_numpy(values).permute(2, 0, 1)[None] for values in (image, truth)]
    with torch.no_grad():
        return float(module(*pair, normalize=True))


def _state(module: torch.nn.Module, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return a state dictionary of the package's module."""
    found = module.state_dict()
    for key in found:
        name = re.sub(r"^net\.slice\d\.(\d+)\.", r"features.\1.", key)
        name = re.sub(r"^lins?\.?(\d)\.model\.1\.", r"lin\1.", name)
        found[key] = tensors.get(name, found[key])
    return found


def main() -> None:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--json", type=Path, metavar="FILE")
    args = p.parse_args()
    kept = shim()
    rows = []
    for network in ours.NETWORKS:
        own = ours.Lpips(ours.NETWORKS[network], lpips_weights.tensors(network))
        for name, (image, truth) in lpips_weights.pairs().items():
            value = package_value(network, image, truth)
            rows.append({"network": network, "pair": name, "lpips": value})
            print(f"{network:5} {name:14} lpips {value:.7f}  ours {own.distance(image, truth):.7f}")
    del kept
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
