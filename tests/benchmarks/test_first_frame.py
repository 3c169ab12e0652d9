"""The benchmark of first frames: fresh processes, of which the cold ones compile and the warm ones load."""

import json
import os
import subprocess
import sys
from pathlib import Path

from r5dgs_core.raster import compilation

ROOT = Path(__file__).parents[2]


def test_a_cold_process_compiles_and_a_warm_one_loads(tmp_path):
    target = tmp_path / "rows.json"
    options = ["--count", "200", "--size", "32", "--degrees", "0,0", "--repeats", "1", "--json", str(target)]
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "first_frame.py", *options, "--verbose"],
        env={**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path / "not this one")},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    cold, warm = json.loads(target.read_text())
    columns = ["cache", "sh_degree", "sky_degree", "import_s", "first_s", "second_s"]
    assert list(cold) == list(warm) == columns
    assert (cold["cache"], warm["cache"]) == ("cold", "warm")
    assert all(row[name] > 0 for row in (cold, warm) for name in columns[3:])
    assert done.stderr.splitlines() == [compilation.NOTICE]  # of the cold one alone
    assert not (tmp_path / "not this one").exists()
