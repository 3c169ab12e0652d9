"""Print the PSNR of the demo, and fail if it is clearly lower than that of a normal run.

python .ci/demo_psnr.py evaluation.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from r5dgs_core.cli.commands import demo

TOLERANCE = 1.0  # dB below `demo.EXPECTED` from which on a run fails


def main(path: Path) -> None:
    """Print the PSNR of an evaluation, and exit with the shortfalls if there are any."""
    result = json.loads(path.read_text(encoding="utf-8"))
    for split in demo.EXPECTED:
        print(f"{split}: PSNR {result['splits'][split]['rigid']['psnr']:.2f} dB")
    print(demo.expectation())
    print(f"training took {result['train']['seconds']:.0f} s here")
    sys.exit("\n".join(shortfalls(result)) or 0)  # exit("") counts as a failure


def shortfalls(evaluation: dict[str, Any]) -> list[str]:
    """Return one line per split whose PSNR is more than `TOLERANCE` below `demo.EXPECTED`."""
    found = {split: evaluation["splits"][split]["rigid"]["psnr"] for split in demo.EXPECTED}
    return [
        f"{split}: PSNR {found[split]:.2f} dB, expected about {wanted:g} dB"
        for split, wanted in demo.EXPECTED.items()
        if not found[split] >= wanted - TOLERANCE
    ]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
