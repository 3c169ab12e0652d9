"""The command ``r5dgs import``: convert a run of another program, or an exported scene, to a scene file."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, folder_lock, input_paths
from .. import inputs, options

if TYPE_CHECKING:
    from ...scene.scene import Scene

NAME = "import"
SHORT = "convert a run of 3DGS or a related program, or an exported scene, to a scene file"
LONG = (
    "Read a run folder of 3DGS, Gaussian Grouping, Deformable-3DGS, TRACE or FreeGave, or a .glb or .4dgs file\n"
    "that 'r5dgs export' wrote, and write a scene file."
)
EXAMPLE = "OUTPUT --data DATA --out scene.r5dgs"
PAGE = "user/import.md"

FILES = {".glb": "glb_reader", ".4dgs": "fourdgs_reader"}  # module of `formats` that reads a file, by its suffix
WORLDS = ("blender", "colmap", "opengl")  # of `scene.cameras`


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("run", type=Path, help="run folder of the other program, or .glb or .4dgs file")
    p.add_argument("--out", type=Path, required=True, metavar="FILE.r5dgs", help="scene file to write")
    p.add_argument("--iteration", type=options.at_least(0), metavar="N", help="iteration to read (default: last)")
    data = "data set of the run, which provides cameras, times and axes"
    p.add_argument("--data", type=Path, metavar="DIR", help=data)
    knots = "number of times at which motion is sampled (default: those of the data set)"
    p.add_argument("--knots", type=options.at_least(2), metavar="N", help=knots)
    p.add_argument("--t-max", type=options.positive, metavar="T", help="last observed time (default: the run's)")
    p.add_argument("--world", choices=WORLDS, help="world axes (default: those of the data set)")
    still = "largest motion that counts as rest, as a share of the extent"
    p.add_argument("--still", type=options.not_negative, metavar="SHARE", help=still)
    p.add_argument("--overwrite", action="store_true", help="replace an existing scene file")
    options.add_progress(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    names = ("iteration", "data", "knots", "t_max", "world", "still")
    given = {name: getattr(args, name) for name in names}
    run_import(args.run, args.out, overwrite=args.overwrite, progress_kind=args.progress, **given)


@folder_lock.writes("out")
def run_import(
    run_folder: Path, out: Path, *, overwrite: bool = False, progress_kind: str = "none", **fields: Any
) -> None:
    """Convert a run folder of another program (`importing.importer.import_run`), or an exported file, to a scene file.

    Args:
        run_folder: Run folder of the other program, or file of ``r5dgs export --to glb`` or ``4dgs``.
        out: Scene file to write.
        overwrite: True to replace an existing file.
        progress_kind: Form of progress output (`progress.make`).
        **fields: Fields of `importing.importer.Options`; all None for a file.

    Raises:
        UsageError: ``out`` has another suffix, or an option does not apply to a file.
        ConfigError: ``out`` exists.
    """
    input_paths.check_scene_output(out)
    given = {name: value for name, value in fields.items() if value is not None}
    is_file = run_folder.suffix.lower() in FILES and run_folder.is_file()
    if is_file and given:
        option = f"--{next(iter(given)).replace('_', '-')}"
        raise errors.UsageError(f"{option}: applies to run folders only, and {run_folder} is a file; leave it out")
    if not is_file:
        input_paths.check_foreign_run(run_folder)
    if out.exists() and not overwrite:
        raise errors.ConfigError(f"{out}: the file exists; replace it with --overwrite, or choose another name")
    if "data" in given:
        inputs.check_dataset(given["data"])
    from ...progress import make
    from ...scene import scene_file

    with make(progress_kind) as progress:
        scene = _read_file(run_folder) if is_file else _convert(run_folder, given, progress)
        scene_file.write(scene, out)
        if progress_kind == "json":
            progress({"event": "imported", "path": str(out), "gaussians": len(scene.gaussians.means)})
    if progress_kind != "json":
        count = sum(o.id > 0 for o in scene.objects)
        objects = "1 object" if count == 1 else f"{count} objects"
        print(f"{out}: {len(scene.gaussians.means)} Gaussians, {objects}, t_max {scene.t_max:g}")


def _read_file(path: Path) -> Scene:
    return importlib.import_module(f"...formats.{FILES[path.suffix.lower()]}", __package__).read(path)


def _convert(run_folder: Path, given: dict[str, Any], progress: Any) -> Scene:
    from ...importing import importer

    return importer.import_run(
        run_folder,
        importer.Options(**given),
        lambda done, total: progress({"event": "import", "done": done, "total": total, "unit": "Gaussians"}),
    )
