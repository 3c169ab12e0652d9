"""Tables of finished benchmarks of several networks and lengths: quality by mode, and PSNR against steps.

    python -m benchmarks.training full_length BENCH... [--out FILE]

``BENCH`` are output folders of ``r5dgs bench``; unfinished runs appear only in the table of PSNR against steps. That
table needs ``--set train.probe_every=N``: it holds the PSNR of held-out views that the log has. Results:
docs/results/field.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from r5dgs_core.bench.benchmark import RESULT_FILE
from r5dgs_core.config.config import Config
from r5dgs_core.model import deformation, trd
from r5dgs_core.train import run_folder

NOTE = "Our implementation, reduced networks."
POINTS = 12  # most columns of the table of PSNR against steps


def networks(config: Config) -> str:
    """Return depth and width of deformation field and TRD, "8 x 256, 10 x 256"; "-" without them."""
    if config.train.representation != "field":
        return "-"
    field, dynamics = deformation.SHAPES[config.field.size], trd.SHAPES[config.field.size]
    # As in the paper, the depth of the TRD counts its first layer and its head.
    widths = (config.field.width or field.width, config.field.width or dynamics.width)
    return f"{field.depth} x {widths[0]}, {dynamics.layers + 2} x {widths[1]}"


def probes(run: Path) -> dict[int, float]:
    """Return the PSNR of the held-out views by step, from the log of a run."""
    path = run / run_folder.LOG_FILE
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    events = [json.loads(line) for line in lines if line.endswith("}")]
    return {event["iteration"]: event["val_psnr"] for event in events if "val_psnr" in event}


def rows(bench: Path) -> list[dict[str, Any]]:
    """Return a row per run of a benchmark, with ``modes`` by mode (empty if unfinished) and ``probes`` by step."""
    found = bench / RESULT_FILE
    results = json.loads(found.read_text(encoding="utf-8"))["results"] if found.exists() else []
    made = []
    for path in sorted(bench.glob(f"*/*/{run_folder.RUN_FILE}")):
        run, (scene, name) = path.parent, path.parts[-3:-1]
        config = run_folder.open_run(run).config
        own = [r for r in results if (r["scene"], f"{r['variant']}_seed{r['seed']}") == (scene, name)]
        made.append(
            {
                "run": [scene, name, config.losses.rigid_form if name.startswith("r5dgs_extra") else "-"],
                "networks": networks(config),
                "steps": config.train.iterations,
                "modes": {r["mode"]: r["splits"] for r in own},
                "cpu_seconds": own[0]["train"]["cpu_seconds"] if own else None,
                "probes": probes(run),
            }
        )
    return made


def quality(found: Sequence[dict[str, Any]]) -> str:
    """Return the table of the finished runs as Markdown."""
    modes = list(dict.fromkeys(mode for row in found for mode in row["modes"]))
    head = ["scene", "run", "L_rigid", "networks", "steps", "CPU min", "val", *(f"test `{mode}`" for mode in modes)]
    lines = []
    for row in found:
        if not row["modes"]:
            continue
        val = next(iter(row["modes"].values()))["val"]["psnr"]
        tests = [row["modes"].get(mode, {}).get("test", {}).get("psnr") for mode in modes]
        minutes = None if row["cpu_seconds"] is None else row["cpu_seconds"] / 60
        lines.append([*row["run"], row["networks"], row["steps"], *map(_cell, (minutes, val, *tests))])
    return _markdown(head, lines)


def against_steps(found: Sequence[dict[str, Any]]) -> str:
    """Return the PSNR of held-out views against steps, of all runs with probes, as Markdown."""
    steps = sorted({step for row in found for step in row["probes"]})
    steps = steps[:: -(-len(steps) // POINTS) or 1]
    lines = [
        [*row["run"][:2], row["networks"], *(_cell(row["probes"].get(step)) for step in steps)]
        for row in found
        if row["probes"]
    ]
    return _markdown(["scene", "run", "networks", *(f"{step}" for step in steps)], lines)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _markdown(head: Sequence[str], lines: Sequence[Sequence[Any]]) -> str:
    rule = ["---"] * len(head)
    return "".join("| " + " | ".join(map(str, line)) + " |\n" for line in (head, rule, *lines))


def main() -> None:
    """Print or write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bench", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, help="Markdown file (default: print)")
    args = parser.parse_args()
    found = [row for bench in args.bench for row in rows(bench)]
    steps = f"PSNR of held-out views in the observed time, dB, against steps:\n\n{against_steps(found)}"
    text = f"{NOTE} PSNR in dB.\n\n{quality(found)}\n{steps}"
    if args.out:
        args.out.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
