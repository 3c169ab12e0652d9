"""Run `tests/blender/run.py` in every Blender that the extension is tested on: `python tests/blender/versions.py`.

Each version of the bpy module gets an environment in ``--folder`` (about 1.5 GB), which later calls reuse. Its Python
has to be installed (3.11 up to 5.0, 3.13 from 5.1 on). ``--blender PROGRAM`` adds Blender programs. Previews use the
Python of ``--worker``, by default the running one. ``--torch`` installs torch in each environment; without it, tests
that render in Blender's process are left out. Arguments after ``--`` are passed to `run.py`. Exits with 1 if a version
failed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RUN = Path(__file__).with_name("run.py")
MODULES = {"4.2.23": "3.11", "4.5.15": "3.11", "5.0.1": "3.11", "5.2.3": "3.13"}  # version of bpy to version of Python
PINS = (ROOT / "constraints.txt").read_text().splitlines()
HEAVY = tuple(line for line in PINS if line.startswith(("torch==", "numba==", "llvmlite==")))
BESIDE = ("pytest", "hypothesis", "OpenImageIO", "rich", "packaging", "scipy", "trimesh")


def python_of(version: str) -> str:
    """Path of a Python of a version such as "3.13"."""
    found = shutil.which(f"python{version}")
    if (
        found is None or subprocess.run([found, "-c", ""], capture_output=True).returncode
    ):  # a shim may point to a missing Python
        raise SystemExit(f"python{version}: not found; the bpy module of this version is for it alone, so install it")
    return found


def environment(bpy: str, folder: Path, torch: bool) -> Path:
    """Python of an environment with a version of bpy, which is created if missing."""
    place = folder / bpy
    python = place / "bin" / "python"
    done = place / "installed"
    wanted = [f"bpy=={bpy}", *BESIDE, *(HEAVY if torch else ())]
    if not done.exists() or done.read_text() != " ".join(wanted):
        subprocess.run([python_of(MODULES[bpy]), "-m", "venv", str(place)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "-q", *wanted], check=True)
        if torch:  # optional in torch; its LLVM crashes beside Blender's
            subprocess.run([str(python), "-m", "pip", "uninstall", "-q", "-y", "triton"], check=True)
        done.write_text(" ".join(wanted))
    return python


def main(arguments: list[str]) -> int:
    """Run all versions. Returns the exit code."""
    split = arguments.index("--") if "--" in arguments else len(arguments)
    parser = argparse.ArgumentParser(description="The extension's figures and tests in every version of Blender.")
    parser.add_argument("versions", nargs="*", help=f"versions of bpy, by default {', '.join(MODULES)}")
    parser.add_argument("--folder", type=Path, default=Path.home() / ".cache" / "r5dgs-blenders")
    parser.add_argument("--blender", action="append", default=[], help="a Blender program to run it in, too")
    parser.add_argument("--worker", default=sys.executable, help="Python with torch for the previews")
    parser.add_argument("--torch", action="store_true", help="install torch beside the modules")
    options = parser.parse_args(arguments[:split])
    rest = arguments[split + 1 :]
    unknown = [version for version in options.versions if version not in MODULES]
    if unknown:
        parser.error(f"unknown versions {', '.join(unknown)}; known are {', '.join(MODULES)}")
    settings = {**os.environ, "R5DGS_PYTHON": options.worker}
    codes = {}
    for version in options.versions or MODULES:
        command = [str(environment(version, options.folder, options.torch)), str(RUN), *rest]
        codes[f"bpy {version}"] = subprocess.run(command, env=settings, cwd=ROOT).returncode
    for program in options.blender:
        command = [program, "-b", "--factory-startup", "--python-exit-code", "1", "--python", str(RUN), "--", *rest]
        codes[program] = subprocess.run(command, env=settings, cwd=ROOT).returncode
    print("\n".join(f"{name:<40} {'ok' if code == 0 else f'FAILED with code {code}'}" for name, code in codes.items()))
    return int(any(codes.values()))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
