"""Sizes and loading times of pages with the player, for scenes with more and more Gaussians.

    python -m benchmarks.player SCENE [--gaussians N ...] [--repeats N] [--json FILE]

``export`` is the time of writing the page, without reading the scene and without a still picture. ``loading`` is the
time from the address to the first picture of 1280 x 800 pixels in headless Chromium with software WebGL, ``picking``
that of finding the object at a pixel. All are the least of ``--repeats``. Needs Chromium and ``npm --prefix player ci
--ignore-scripts``. Results: docs/results/player.md.
"""

from __future__ import annotations

import argparse
import io
import json
import tempfile
import time
from pathlib import Path

from benchmarks.playback import scaled_scene
from r5dgs_core.formats import glb, gltf, html, registry
from r5dgs_core.scene import scene_file
from r5dgs_core.scene.scene import Scene
from tests.support.player import Browser

WIDTH, HEIGHT = 1280, 800
PICK = f"((before) => (r5dgs.pick({WIDTH} / 2, {HEIGHT} / 2), performance.now() - before))(performance.now())"


def measure(browser: Browser, scene: Scene, folder: Path, repeats: int) -> dict[str, float]:
    """Return sizes in MB and times of a scene's page."""
    what = registry.Options((scene.t_max,))
    stream = io.BytesIO()
    gltf.write(stream, *glb.build(scene, what))
    exporting, loading, picking = [], [], []
    for _ in range(repeats):
        start = time.perf_counter()
        (page,) = html.export(scene, folder / "page.html", what)
        exporting.append(time.perf_counter() - start)
        start = time.perf_counter()
        browser.open(f"{page.as_uri()}?t={scene.t_max}", WIDTH, HEIGHT)
        browser.eval("r5dgs.engine.frame()")
        loading.append(time.perf_counter() - start)
        picking.append(browser.eval(PICK))
    found = {"gaussians": len(scene.gaussians.means), "gltf_mb": len(stream.getvalue()) / 1e6}
    found |= {"page_mb": page.stat().st_size / 1e6, "export_s": min(exporting)}
    return found | {"loading_s": min(loading), "picking_ms": min(picking)}


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("scene", type=Path, help=".r5dgs file")
    p.add_argument("--gaussians", type=int, nargs="*", default=[40_000, 300_000], metavar="N")
    p.add_argument("--repeats", type=int, default=5, metavar="N")
    p.add_argument("--json", type=Path, metavar="FILE")
    args = p.parse_args()
    scene = scene_file.read(args.scene)
    browser = Browser()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for one in (scene, *(scaled_scene(scene, count) for count in args.gaussians)):
            rows.append(measure(browser, one, Path(folder), args.repeats))
            print("  ".join(f"{key} {value:.4g}" for key, value in rows[-1].items()))
    browser.close()
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
