"""Fuzz the readers of files and print a table; the status is 1 if an input was not refused as it should be."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.fuzz import campaign, readers


def main() -> int:
    """Run the campaign and print its table."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=10_000, help="number of inputs of all readers together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", choices=sorted(readers.READERS), help="one reader; all without it")
    parser.add_argument("--save", type=Path, help="folder for the inputs that went wrong")
    parser.add_argument("--only", type=int, metavar="INDEX", help="one input of the reader")
    arguments = parser.parse_args()
    chosen = [arguments.reader] if arguments.reader else list(readers.READERS)
    total = sum(readers.SHARES[name] for name in chosen)
    print(campaign.HEAD)
    tallies = []
    for name in chosen:
        count = round(arguments.inputs * readers.SHARES[name] / total)
        indices = range(count) if arguments.only is None else range(arguments.only, arguments.only + 1)
        tallies.append(campaign.run(readers.READERS[name](), indices, arguments.seed, arguments.save))
        print(tallies[-1].row(), flush=True)
        for fault, number in tallies[-1].faults.most_common(12):
            print(f"    {number:6} {fault}", flush=True)
    print(
        f"all: {sum(t.inputs for t in tallies)} inputs, {sum(t.accepted for t in tallies)} accepted, "
        f"{sum(t.refused for t in tallies)} refused, {sum(t.uncaught for t in tallies)} uncaught, "
        f"{sum(t.hangs for t in tallies)} hangs, {sum(t.seconds for t in tallies):.0f} s of processor time"
    )
    return 0 if all(tally.good for tally in tallies) else 1


if __name__ == "__main__":
    sys.exit(main())
