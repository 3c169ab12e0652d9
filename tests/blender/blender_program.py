"""The options of Blender's command line that farms use, for the bpy module: a stand-in for the program `blender`.

    python tests/blender/blender_program.py -b -y FILE.blend -o OUTPUT --command NAME ARGUMENTS

It registers the extension of this repository.
"""

import argparse
import importlib
import os
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.blender import check_playback  # noqa: E402  (the line before finds it)


def main(arguments: list[str]) -> int:
    """Open a file, set its output and run the command. Returns the exit status."""
    parser = argparse.ArgumentParser()
    parser.add_argument("-b", action="store_true")
    parser.add_argument("-y", action="store_true")
    parser.add_argument("file")
    parser.add_argument("-o", dest="output")
    parser.add_argument("--command", nargs=argparse.REMAINDER)
    options = parser.parse_args(arguments)
    package = check_playback.extension_package()
    command = importlib.import_module(f"{package}.r5dgs_addon.engine.render_command")
    bpy.ops.wm.open_mainfile(filepath=options.file)
    bpy.context.scene.render.filepath = options.output
    name, *rest = options.command
    return command.run(rest) if name == command.NAME else 1


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stdout.flush()
    os._exit(code)  # the module of 4.5 beside torch hangs while its libraries are unloaded
