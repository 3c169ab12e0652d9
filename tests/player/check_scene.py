"""Compare the player's pictures, picking and search with the core on given scenes; fails outside the bounds.

python -m tests.player.check_scene demo.r5dgs... [--out DIR]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from r5dgs_core.cli.commands import export
from r5dgs_core.scene import predictability, scene_file
from r5dgs_core.scene.scene import Scene
from tests.support import player_checks
from tests.support.player import Browser

SIDE = 512
MIN_PSNR, MAX_MEDIAN, MAX_SHIFT = 43.0, 1.0, 0.5  # dB, steps of 255, pixels
SCREENS = {"desktop": (1280, 800), "phone": (360, 640)}


def main() -> None:
    """Check the scenes of the command line."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("scenes", type=Path, nargs="+")
    p.add_argument("--out", type=Path, help="existing folder for pages and screenshots")
    args = p.parse_args()
    browser = Browser()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.out or Path(temporary)
        faults = [fault for path in args.scenes for fault in check(browser, path, folder)]
    browser.close()
    sys.exit("\n".join(faults) or 0)


def check(browser: Browser, path: Path, folder: Path) -> list[str]:
    """Print the figures of one scene and return what is outside the bounds."""
    (page,) = export.run_export(path, "html", folder / f"{path.stem}.html", overwrite=True)
    scene, url = scene_file.read(path), page.as_uri()
    found = player_checks.compare(browser, scene, url, SIDE, predictability.horizon(scene), folder)
    psnr, median, shift = (np.array([getattr(one, name) for one in found]) for name in ("psnr", "median", "shift"))
    print(f"{path.name}: {len(found)} pictures, {page.stat().st_size / 1e6:.2f} MB")
    print(f"  PSNR {psnr.mean():.2f} dB, at least {psnr.min():.2f}; median error at most {median.max():.2f}/255")
    print(f"  objects displaced by at most {shift.max():.3f} px")
    faults = [f"{path}: PSNR {psnr.min():.2f} dB"] if psnr.min() < MIN_PSNR else []
    faults += [f"{path}: median error {median.max():.2f}/255"] if median.max() > MAX_MEDIAN + 1e-6 else []
    faults += [f"{path}: objects displaced by {shift.max():.2f} px"] if shift.max() > MAX_SHIFT else []
    picks = player_checks.picks(browser, scene, url, SIDE)
    print("  picked right: " + ", ".join(f"object {k}: {right} of {tried}" for k, (right, tried) in picks.items()))
    faults += [f"{path}: object {k}: {right} of {tried} picked" for k, (right, tried) in picks.items() if right < tried]
    faults += [f"{path}: {text!r} is ranked differently" for text in different(browser, scene, url)]
    for name, (width, height) in SCREENS.items():
        first = next((item.name for item in scene.objects if item.id > 0), "")
        browser.open(f"{url}?t={0.5 * (scene.t_max + predictability.horizon(scene))}&object={first}", width, height)
        browser.eval("r5dgs.engine.settle()")
        browser.send(shot=str(folder / f"{path.stem}_{name}.png"))
    return faults


def different(browser: Browser, scene: Scene, url: str) -> list[str]:
    """Prompts that the page answers otherwise than `r5dgs query`."""
    texts = player_checks.prompts(scene)
    browser.open(url + "?t=0")
    answers = player_checks.rankings_of_page(browser, texts)
    wanted = [[one[0] for one in player_checks.ranking(scene, text)] for text in texts]
    missed = [t for t, a, w in zip(texts, answers, wanted, strict=True) if [one[0] for one in a] != w]
    print(f"  {len(texts) - len(missed)} of {len(texts)} prompts ranked alike, {sum(map(bool, wanted))} with matches")
    return missed


if __name__ == "__main__":
    main()
