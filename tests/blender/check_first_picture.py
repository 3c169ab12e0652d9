"""Install the extension with its wheels into a fresh Blender, and render a first picture with nothing else.

    python tests/blender/check_first_picture.py --out DIR [--scene demo.r5dgs] [--bpy 4.2.23]

Builds the zip of the running platform and Python, and installs ``bpy`` into a new environment without torch, numba and
scipy. There, with an empty PATH and empty user folders, it installs the zip, loads the scene, renders twice (F12) and
removes the extension. It prints the processor time until the first picture and the files that are left.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLATFORMS = {"linux": "linux-x64", "darwin": "macos-arm64", "win32": "windows-x64"}

SESSION = r"""
import os, sys, time

archive, scene, picture = sys.argv[1:]
import bpy
import addon_utils

module = "bl_ext.user_default.r5dgs"
for name in ("torch", "numba", "scipy"):
    try:
        __import__(name)
    except ImportError:
        continue
    sys.exit(f"{name} is importable without the extension")
bpy.ops.wm.read_homefile(app_template="")
assert bpy.ops.extensions.package_install_files(
    filepath=archive, repo="user_default", enable_on_install=True
) == {"FINISHED"}
assert bpy.ops.r5dgs.load_scene(filepath=scene) == {"FINISHED"}
render = bpy.context.scene.render
render.engine, render.filepath = "R5DGS", picture
render.resolution_x = render.resolution_y = 256
bpy.context.scene.frame_set(20)
for turn in ("first", "second"):
    began = time.perf_counter()
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    print(f"{turn} picture: {time.perf_counter() - began:.1f} s", flush=True)
jobs = sys.modules[module + ".r5dgs_addon.worker.jobs"]
preferences = sys.modules[module + ".r5dgs_addon.preferences"]
print("worker:", preferences.worker_python())
print("kernels:", len(list(os.scandir(preferences.choice().kernels))), "entries in", preferences.choice().kernels)
with open(f"/proc/{jobs.current().pid}/stat") as file:
    ticks = file.read().rsplit(")", 1)[1].split()
print("processor s of the worker:", sum(map(int, ticks[11:13])) / os.sysconf("SC_CLK_TCK"))
print("processor s of Blender:", time.process_time())
addon_utils.disable(module, default_set=True)
repositories = list(bpy.context.preferences.extensions.repos)
index = next(i for i, repository in enumerate(repositories) if repository.module == "user_default")
assert bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id="r5dgs") == {"FINISHED"}
"""


def main() -> None:
    """Run the check."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="empty or new folder for everything that is made")
    parser.add_argument("--scene", type=Path, default=ROOT / "tests" / "data" / "tracks_v1.r5dgs")
    parser.add_argument("--bpy", default="4.2.23", help="version of the bpy module, for the running Python")
    parser.add_argument("--with", dest="also", nargs="*", default=[], help="further packages, such as numpy==1.24.4")
    args = parser.parse_args()
    python = ".".join(map(str, sys.version_info[:2]))
    build = [sys.executable, str(ROOT / "release" / "build_extension.py"), "--out", str(args.out), "--python", python]
    args.out.mkdir(parents=True, exist_ok=True)
    if not list(args.out.glob("*.zip")):
        subprocess.run([*build, "--platform", PLATFORMS[sys.platform]], check=True)
    (archive,) = args.out.glob("*.zip")
    environment, user = args.out / "environment", args.out / "user"
    subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
    fresh = environment / ("Scripts" if os.name == "nt" else "bin") / "python"
    subprocess.run([fresh, "-m", "pip", "install", "-q", f"bpy=={args.bpy}", *args.also], check=True)
    for folder in (user, args.out / "home", args.out / "empty"):
        folder.mkdir(exist_ok=True)
    given = {"HOME": args.out / "home", "PATH": args.out / "empty", "BLENDER_USER_RESOURCES": user}
    picture = args.out / "picture.png"
    subprocess.run(
        [fresh, "-c", SESSION, archive.resolve(), args.scene.resolve(), picture.resolve()],
        env={name: str(path.resolve()) for name, path in given.items()},
        check=True,
    )
    left = [path for folder in (user, args.out / "home") for path in folder.rglob("*") if path.is_file()]
    print("left:", *left, sep="\n  ")
    ours = [
        path for path in left if "r5dgs" in str(path.relative_to(args.out)).lower() or path.suffix in (".nbi", ".nbc")
    ]
    sys.exit(f"the extension left {ours}" if ours else 0)


if __name__ == "__main__":
    main()
