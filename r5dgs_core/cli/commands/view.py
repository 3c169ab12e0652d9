"""The command ``r5dgs view``: show a scene in a web browser."""

from __future__ import annotations

import argparse
import http.server
import threading
import webbrowser
from pathlib import Path

from ... import errors, input_paths

NAME = "view"
SHORT = "show a scene in a web browser"
LONG = (
    "Show a scene file in a web browser: play it past t_max, pick objects and find them by words.\n"
    "The page is served on 127.0.0.1, which only this computer can reach, until you press Ctrl-C."
)
EXAMPLE = "scene.r5dgs"
PAGE = "user/player.md"

HOST = "127.0.0.1"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file")
    until = "last scene time (default: a third of the observed span after t_max, at least 1)"
    p.add_argument("--until", type=float, metavar="T", help=until)
    p.add_argument("--objects", metavar="WORDS", help="objects to show: 'red mug', 'all except the table'")
    p.add_argument("--port", type=int, default=0, metavar="N", help="port to listen on (default: a free one)")
    p.add_argument("--no-browser", action="store_true", help="print the address without opening a browser")


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    run_view(args.file, until=args.until, words=args.objects, port=args.port, browser=not args.no_browser)


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
        ConfigError: No object matches the words, or the port is taken.
    """
    if not 0 <= port < 1 << 16:
        raise errors.UsageError(f"--port {port}: expected a number from 0 to {(1 << 16) - 1}")
    input_paths.check_scene(path)
    from ...formats import html
    from ...scene import scene_file
    from . import export

    scene = scene_file.read(path)
    what = export.selection(html.FORMAT, scene, until=until, words=words)
    with serving(html.page(scene, what), port) as server:
        address = f"http://{HOST}:{server.server_port}/"
        print(f"{address} (end with Ctrl-C)", flush=True)
        if browser:
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()


def serving(page: bytes, port: int = 0) -> http.server.ThreadingHTTPServer:
    """Return a server of one page at the address / of 127.0.0.1; it answers nothing else.

    Requests for another host name are refused, so that no web site can read the page by a name that leads here.

    Raises:
        ConfigError: The port cannot be used.
    """

    class Handler(http.server.BaseHTTPRequestHandler):
        """Answers requests for the page."""

        def do_GET(self) -> None:
            """Send the page."""
            self._answer(with_body=True)

        def do_HEAD(self) -> None:
            """Send the head of the page."""
            self._answer(with_body=False)

        def _answer(self, *, with_body: bool) -> None:
            known = {f"{name}:{self.connection.getsockname()[1]}" for name in (HOST, "localhost")}
            found = self.path.partition("?")[0] == "/" and self.headers.get("Host") in known
            body = page if found else b""
            self.send_response(200 if found else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            if with_body:
                self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Print nothing."""

    try:
        return http.server.ThreadingHTTPServer((HOST, port), Handler)
    except OSError as error:
        raise errors.ConfigError(f"--port {port}: cannot be used: {error}; leave it out for a free one") from error
