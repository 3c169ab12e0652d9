"""Frame rate with the networks in the loop, as the paper measures it, beside that of the baked scene.

    python -m benchmarks.training network_playback RUN [--turns 5]

``RUN`` is a run of the field. Every call draws all test views of the run. For each frame, the field moves Gaussians to
the end of the observed time, and the TRD moves them on with TRACE's integrator.

- 5DGS: the networks are evaluated for every moving Gaussian.
- R5DGS: the networks are evaluated for one Gaussian per object; the others move with it.
- baked: the motion comes from the scene file; no network is evaluated.

Results: docs/results/field.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import torch

from r5dgs_core import timing
from r5dgs_core.bake import bake
from r5dgs_core.data import dataset as datasets
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.train import checkpoint, run_folder, trainer, warm_up
from r5dgs_core.train.representations import field


def players(run: Path) -> tuple[dict[str, Callable[[], object]], int]:
    """Return functions that draw all test views, by label, and the number of these views."""
    opened = run_folder.open_run(run)
    dataset = datasets.read(opened.data())
    trained = trainer.Trainer(dataset, opened.config)
    trained.restore(checkpoint.load(run))
    scene = bake.bake(opened, dataset)
    views = sorted(dataset.test, key=lambda view: (view.camera.name, view.t))
    motion = trained.motion
    if not isinstance(motion, field.FieldRepresentation):
        raise SystemExit(f"{run}: has no networks; give a run of the field (train.representation='field')")
    rows = motion.movers(trained.gaussians)[: len(scene.groups)]
    representatives = trained.gaussians.means.detach()[rows]

    def networks() -> None:
        with torch.no_grad():
            for view in views:
                trained.render(trained.normalization.camera(view.camera), view.t)

    def baked(mode: str, with_networks: bool = False) -> Callable[[], None]:
        player = scene_player.Player(scene, mode)

        def run() -> None:
            for view in views:
                if with_networks:
                    with torch.no_grad():
                        motion.motion.at(representatives, view.t)
                scene_renderer.render_frame(scene, player.frame(view.t, view.camera.center), view.camera)

        return run

    made = {"5DGS, networks in the loop": networks, "R5DGS, networks in the loop": baked("rigid_paper", True)}
    return made | {f"baked, {mode}": baked(mode) for mode in ("standard", "rigid_paper", "rigid")}, len(views)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warm_up.warm_up()
    made, count = players(args.run)
    found = timing.take({label: timing.Contender(play) for label, play in made.items()}, args.turns)
    print(f"{'':30} {'wall ms':>8} {'FPS':>6} {'CPU ms':>7}")
    rows = []
    for label, times in found.items():
        each = times.scaled(1 / count)
        rows.append({"player": label, "ms_wall": each.ms(), "fps": 1e3 / each.ms(), "ms_cpu": each.ms("cpu")})
        print(f"{label:30} {each.ms():8.2f} {1e3 / each.ms():6.1f} {each.ms('cpu'):7.2f}")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main()
