"""Serve the extension from a repository of our own, and let Blender add, install and update it.

    python tests/blender/check_repository.py --out DIR [--blender blender]

Builds zips of two versions for several platforms and versions of Blender, writes the index with `server-generate` and
serves it on 127.0.0.1. A Blender with an empty user folder, of the program ``--blender`` or of the installed ``bpy``,
adds the repository and installs the extension. After the second version is published, a second session of the program
with the same user folder, or the same session of ``bpy``, updates it. Checks that Blender chooses the zip of its
platform and version among equal ids, and that the installed extension loads a scene.
"""

import argparse
import functools
import http.server
import json
import os
import subprocess
import sys
import tempfile
import threading
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from r5dgs_core.scene import scene_file  # noqa: E402  (the line before finds it)
from release import build_extension  # noqa: E402
from tests.support import scenes  # noqa: E402

PLATFORMS = {"linux": "linux-x64", "darwin": "macos-arm64", "win32": "windows-x64"}
MARK = "zip.txt"  # file in each zip that names it

SESSION = r"""
import json, os, sys
from pathlib import Path

address, scene, *steps = sys.argv[sys.argv.index("--") + 1:]
import bpy
import addon_utils

if "install" in steps:
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    assert bpy.ops.preferences.extension_repo_add(
        name="Own Repository", remote_url=address, type="REMOTE"
    ) == {"FINISHED"}
preferences = bpy.context.preferences
preferences.system.use_online_access = True
repositories = list(preferences.extensions.repos)
index = next(i for i, repository in enumerate(repositories) if repository.remote_url == address)
module = f"bl_ext.{repositories[index].module}.r5dgs"
mark = Path(repositories[index].directory) / "r5dgs" / "zip.txt"
for step in steps:
    if step == "install":
        assert bpy.ops.extensions.repo_sync(repo_index=index) == {"FINISHED"}
        assert bpy.ops.extensions.package_install(
            repo_index=index, pkg_id="r5dgs", enable_on_install=True
        ) == {"FINISHED"}
    else:
        sys.stdin.readline()
        assert addon_utils.check(module)[1], "not enabled before the update"
        assert bpy.ops.extensions.repo_sync(repo_index=index) == {"FINISHED"}
        assert bpy.ops.extensions.package_upgrade_all() == {"FINISHED"}
    assert addon_utils.check(module)[1], "not enabled"
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    assert bpy.ops.r5dgs.load_scene(filepath=scene) == {"FINISHED"}
    bpy.ops.wm.save_userpref()
    print("RESULT " + json.dumps({"blender": bpy.app.version_string, "zip": mark.read_text()}), flush=True)
os._exit(0)  # the bpy module of 4.2 may crash at its end after an extension was replaced
"""


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves a folder, and records the requested files."""

    asked: list[str] = []

    def log_message(self, format, *arguments):
        Quiet.asked.append(self.path)


def publish(version: str, repository: Path, plain: Path, command: list[str], blender: tuple[int, int]) -> None:
    """Build the zips of a version, and write the index of the repository.

    Args:
        version: Version of the extension.
        repository: Folder that is served.
        plain: Folder with the content of the extension.
        command: Blender's extension command.
        blender: Version of Blender that installs.
    """
    for old in repository.glob("*.zip"):  # Blender keeps one of the versions that an index lists, not the newest
        old.unlink()
    own = PLATFORMS[sys.platform]
    newer = f"{blender[0]}.{blender[1] + 1}.0"
    variants = {  # platform, first version of Blender, first version that is too new
        "own": (own, "4.2.0", newer),
        "newer-blender": (own, newer, ""),
        **{name: (name, "4.2.0", "") for name in PLATFORMS.values() if name != own},
    }
    for name, (platform, oldest, until) in variants.items():
        text = (ROOT / build_extension.MANIFEST).read_text("utf-8")
        shipped = tomllib.loads(text)["version"]
        text = text.replace(f'version = "{shipped}"', f'version = "{version}"')
        target = build_extension.Target(platform, "", oldest, until, ())
        text = build_extension.manifest(text, target).replace("wheels = [\n]\n", "")
        (plain / build_extension.MANIFEST).write_text(text, encoding="utf-8")
        (plain / MARK).write_text(f"{version} {name}", encoding="utf-8")
        path = repository / f"r5dgs-{version}-{name}.zip"
        run([*command, "build", "--source-dir", str(plain), "--output-filepath", str(path)])
    run([*command, "server-generate", "--repo-dir", str(repository), "--html"])


def run(command: list[str], **options) -> str:
    """Run a program and return its output; exits if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, **options)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: failed\n{done.stdout}{done.stderr}")
    return done.stdout


def start(blender: str | None, user: Path, *arguments: str) -> subprocess.Popen:
    """Start `SESSION` with a user folder."""
    script = user.parent / "session.py"
    script.write_text(SESSION)
    program = [blender, "-b", "--python-exit-code", "1", "--python"] if blender else [sys.executable]
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(user), "PYTHONPATH": ""}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen([*program, str(script), "--", *arguments], env=environment, **pipes)


def result(session: subprocess.Popen) -> dict:
    """Wait for the next result of a session; exits if it failed."""
    said = []
    while line := session.stdout.readline():
        if line.startswith("RESULT "):
            return json.loads(line.removeprefix("RESULT "))
        said.append(line)
    raise SystemExit("".join(said) + f"the session ended with code {session.wait()}")


def version_of(blender: str | None) -> tuple[int, int]:
    """First two numbers of the version of Blender."""
    if blender is None:
        import bpy

        return bpy.app.version[:2]
    major, minor = run([blender, "--version"]).split()[1].split(".")[:2]
    return int(major), int(minor)


def main() -> None:
    """Check the repository."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for zips and user folders; default: a temporary one")
    parser.add_argument("--blender", help="Blender program; default: the installed bpy")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        out = (args.out or Path(temporary)).resolve()
        repository, plain, user = out / "repository", out / "plain", out / "user"
        for folder in (repository, plain, user):
            folder.mkdir(parents=True)
        command = build_extension.extension_command(args.blender)
        run([*command, "build", "--source-dir", str(ROOT), "--output-filepath", str(out / "plain.zip")])
        with zipfile.ZipFile(out / "plain.zip") as archive:
            archive.extractall(plain)
        scene = scene_file.write(scenes.make_scene(n=200), out / "scene.r5dgs")
        handler = functools.partial(Quiet, directory=str(repository))
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_address[1]}/index.json"
        blender = version_of(args.blender)
        together = args.blender is None  # the bpy module cannot enable extensions of saved preferences
        running = None
        for step, version in (("install", "0.0.1"), ("update", "0.0.2")):
            publish(version, repository, plain, command, blender)
            index = json.loads((repository / "index.json").read_text())
            count = sum(entry["version"] == version for entry in index["data"])
            if running is None:
                steps = ("install", "update") if together else (step,)
                running = start(args.blender, user, address, str(scene), *steps)
            if step == "update":
                running.stdin.write("\n")
                running.stdin.flush()
            found = result(running)
            print(f"Blender {found['blender']}, {step}: '{found['zip']}' of {count} zips of its version")
            if found["zip"] != f"{version} own":
                raise SystemExit(f"expected '{version} own', got '{found['zip']}'")
            if not together or step == "update":
                running.communicate()
                running = None
        server.shutdown()
        served = [name for name in Quiet.asked if name.endswith(".zip")]
        print("served:", *served)


if __name__ == "__main__":
    main()
