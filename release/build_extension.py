"""Build the Blender extension with the wheels that pictures need: one zip per platform and version of Python.

    python release/build_extension.py --out DIR                             # all zips of release/wheels.toml
    python release/build_extension.py --out DIR --platform linux-x64 --python 3.11 --blender blender

Wheels are downloaded by pip and compared with the SHA-256 in `wheels.toml`. Zips are built and validated by Blender's
extension command, of the program ``--blender`` or of the installed ``bpy``.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PINS = ROOT / "release" / "wheels.toml"
MANIFEST = "blender_manifest.toml"


@dataclass(frozen=True)
class Target:
    """One zip.

    Attributes:
        platform: Platform in Blender's notation, such as "linux-x64".
        python: Version of Blender's Python, such as "3.11".
        oldest: First version of Blender.
        until: First version of Blender with a newer Python, or "".
        wheels: Entries of `wheels.toml`.
    """

    platform: str
    python: str
    oldest: str
    until: str
    wheels: tuple[dict[str, str], ...]


def targets(platforms: Sequence[str], pythons: Sequence[str]) -> list[Target]:
    """Return the pinned targets of some platforms and versions of Python; of all if none are given."""
    pins = tomllib.loads(PINS.read_text(encoding="utf-8"))
    found: dict[tuple[str, str], list[dict[str, str]]] = {}
    for wheel in pins["wheel"]:
        found.setdefault((wheel["platform"], wheel["python"]), []).append(wheel)
    made = []
    for (platform, python), wheels in found.items():
        if (not platforms or platform in platforms) and (not pythons or python in pythons):
            versions = pins["blender"][python]
            made.append(Target(platform, python, versions["from"], versions.get("until", ""), tuple(wheels)))
    if not made:
        raise SystemExit(f"{PINS}: no wheels for {', '.join(platforms) or 'any platform'}, Python {', '.join(pythons)}")
    return made


def download(wheel: dict[str, str], folder: Path) -> Path:
    """Download a wheel unless the folder has it, and compare its SHA-256.

    Raises:
        SystemExit: The download failed, or the file is another one than pinned.
    """
    path = folder / wheel["file"]
    if not path.exists():
        tags = path.stem.split("-")
        options = [word for tag in tags[-1].split(".") for word in ("--platform", tag)]
        options += [
            "--python-version",
            wheel["python"],
            "--implementation",
            "cp",
            "--only-binary",
            ":all:",
            "--no-deps",
        ]
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--dest", str(folder), *options]
        if subprocess.run([*pip, f"{wheel['name']}=={wheel['version']}"]).returncode or not path.exists():
            raise SystemExit(f"{wheel['file']}: pip could not download it; see its message above")
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != wheel["sha256"]:
        raise SystemExit(f"{path}: expected SHA-256 {wheel['sha256']}, found {found}; delete it and check the pin")
    return path


def manifest(text: str, target: Target) -> str:
    """Return the manifest for a target: its versions of Blender, platform and wheels."""
    wheels = "".join(f'  "./wheels/{wheel["file"]}",\n' for wheel in target.wheels)
    lines = [f'blender_version_min = "{target.oldest}"']
    lines += [f'blender_version_max = "{target.until}"'] if target.until else []
    lines += [f'platforms = ["{target.platform}"]', f"wheels = [\n{wheels}]"]
    kept = [line for line in text.splitlines() if not line.startswith(("platforms", "wheels", "blender_version_max"))]
    (place,) = [i for i, line in enumerate(kept) if line.startswith("blender_version_min")]
    return "\n".join([*kept[:place], *lines, *kept[place + 1 :], ""])


def extension_command(blender: str | None) -> list[str]:
    """Return the start of Blender's extension command line."""
    if blender is not None:
        return [blender, "--command", "extension"]
    import bpy  # puts the folders of Blender's add-ons on the path

    assert bpy
    import bl_pkg

    return [sys.executable, str(Path(bl_pkg.__file__).parent / "cli" / "blender_ext.py")]


def build(target: Target, out: Path, wheels: Path, command: Sequence[str]) -> Path:
    """Build and validate the zip of a target.

    Args:
        target: The target.
        out: Folder for the zip.
        wheels: Folder for downloaded wheels.
        command: Result of `extension_command`.
    """
    with tempfile.TemporaryDirectory() as temporary:
        plain, source = Path(temporary) / "plain.zip", Path(temporary) / "source"
        _run([*command, "build", "--source-dir", str(ROOT), "--output-filepath", str(plain)])
        with zipfile.ZipFile(plain) as archive:
            archive.extractall(source)
        (source / MANIFEST).write_text(manifest((ROOT / MANIFEST).read_text("utf-8"), target), encoding="utf-8")
        (source / "wheels").mkdir()
        for wheel in target.wheels:
            (source / "wheels" / wheel["file"]).symlink_to(download(wheel, wheels).resolve())
        version = tomllib.loads((ROOT / MANIFEST).read_text("utf-8"))["version"]
        result = out / f"r5dgs-{version}-{target.platform}-py{target.python.replace('.', '')}.zip"
        _run([*command, "build", "--source-dir", str(source), "--output-filepath", str(result)])
    _run([*command, "validate", str(result)])
    return result


def _run(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: failed\n{done.stdout}{done.stderr}")


def main() -> None:
    """Build the requested zips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the zips")
    parser.add_argument("--platform", nargs="+", default=[], help="linux-x64, windows-x64, macos-arm64; default: all")
    parser.add_argument("--python", nargs="+", default=[], help="versions of Blender's Python; default: all")
    parser.add_argument("--wheels", type=Path, help="folder for downloaded wheels; default: OUT/wheels")
    parser.add_argument("--blender", help="Blender program; default: the installed bpy")
    args = parser.parse_args()
    wheels = args.wheels or args.out / "wheels"
    wheels.mkdir(parents=True, exist_ok=True)
    command = extension_command(args.blender)
    for target in targets(args.platform, args.python):
        path = build(target, args.out, wheels, command)
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
