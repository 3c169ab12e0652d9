"""The command ``r5dgs view``: show a scene or a training run in a web browser."""

from __future__ import annotations

import argparse
import contextlib
import signal
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path

from ... import errors, input_paths
from .. import live_run, page_server
from ..page_server import Page

NAME = "view"
SHORT = "show a scene or a training run in a web browser"
LONG = (
    "Show a scene file in a web browser: play it past t_max, pick objects and find them by words.\n"
    "With --live, show a training run, baked again at most once a minute, with its curves and contact sheet.\n"
    "The page is served from 127.0.0.1 to this computer alone, until Ctrl-C."
)
EXAMPLE = "scene.r5dgs"
PAGE = "user/player.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("file", type=Path, metavar="SCENE|RUN", help=".r5dgs file, or with --live a run folder")
    p.add_argument("--live", action="store_true", help="follow the training of a run folder")
    until = "last scene time (default: a third of the observed span after t_max, or scene time 1 if later)"
    p.add_argument("--until", type=float, metavar="T", help=until)
    p.add_argument("--objects", metavar="WORDS", help="objects to show: 'red mug', 'all except the background'")
    p.add_argument("--port", type=int, default=0, metavar="N", help="port to listen on (default: a free one)")
    p.add_argument("--no-browser", action="store_true", help="print the address without opening a browser")


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    show = run_live if args.live else run_view
    show(args.file, until=args.until, words=args.objects, port=args.port, browser=not args.no_browser)


def run_view(
    path: Path, *, until: float | None = None, words: str | None = None, port: int = 0, browser: bool = True
) -> None:
    """Serve the page of a scene file until the process is interrupted.

    Args:
        path: The scene file.
        until: Last scene time; see `formats.registry.Options`.
        words: Objects to show, as in ``r5dgs query``; all if None.
        port: Port of 127.0.0.1; 0 for a free one.
        browser: True to open the page in the user's browser.

    Raises:
        UsageError: ``until``, ``words`` or ``port`` cannot be used.
        SceneFileError: The path is not a scene file.
        ConfigError: No object matches the words, or the port is taken.
    """
    _check_port(port)
    if (path / input_paths.RUN_FILE).is_file():
        found = "found a run folder; show it with --live, or make a scene file with 'r5dgs bake'"
        raise errors.SceneFileError(f"{path}: expected a {input_paths.SCENE_SUFFIX} file, {found}")
    input_paths.check_scene(path)
    from ...formats import html
    from ...scene import scene_file
    from . import export

    scene = scene_file.read(path)
    what = export.selection(html.FORMAT, scene, until=until, words=words)
    _serve({"/": Page(html.page(scene, what))}.get, port, browser)


def run_live(
    run: Path, *, until: float | None = None, words: str | None = None, port: int = 0, browser: bool = True
) -> None:
    """Serve the live page of a run folder until the process is interrupted; the arguments are those of `run_view`.

    Raises:
        UsageError: ``port`` cannot be used.
        CheckpointError: The path is not a run folder.
        ConfigError: The port is taken.
    """
    _check_port(port)
    input_paths.check_run(run)
    arguments = [] if until is None else ["--until", str(until)]
    arguments += [] if words is None else ["--objects", words]
    with _signals_as_ctrl_c(), tempfile.TemporaryDirectory(prefix="r5dgs_live_") as folder:
        live = live_run.LiveRun(run.resolve(), Path(folder), arguments)
        thread = threading.Thread(target=live.watch)
        thread.start()
        try:
            _serve(live.find, port, browser)
        finally:
            live.stop()
            thread.join()


@contextlib.contextmanager
def _signals_as_ctrl_c() -> Iterator[None]:
    """Raise KeyboardInterrupt at the first SIGTERM or SIGHUP within the block, unless the signal is ignored."""

    def interrupt(number: int, frame: object) -> None:
        for one in before:
            signal.signal(one, signal.SIG_IGN)
        raise KeyboardInterrupt

    present = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    in_main = threading.current_thread() is threading.main_thread()  # the only one that may set handlers
    before = {one: signal.getsignal(one) for one in present if in_main and signal.getsignal(one) != signal.SIG_IGN}
    try:
        for one in before:
            signal.signal(one, interrupt)
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def _check_port(port: int) -> None:
    if not 0 <= port < 1 << 16:
        raise errors.UsageError(f"--port {port}: expected a number from 0 to {(1 << 16) - 1}")


def _serve(find: Callable[[str], Page | None], port: int, browser: bool) -> None:
    """Serve pages until Ctrl-C."""
    with page_server.serving(find, port) as server:
        address = f"http://{page_server.HOST}:{server.server_port}/"
        try:  # Ctrl-C may arrive as soon as the address is visible
            print(f"{address} (end with Ctrl-C)", flush=True)
            if browser:
                threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
            server.serve_forever()
        except KeyboardInterrupt:
            print()
