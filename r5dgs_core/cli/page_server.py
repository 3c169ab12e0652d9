"""Web server of a few pages for this computer alone. Imports only the standard library."""

from __future__ import annotations

import http.server
import sys
from collections.abc import Callable
from dataclasses import dataclass

from .. import errors

HOST = "127.0.0.1"


@dataclass(frozen=True)
class Page:
    """Answer to a request.

    Attributes:
        content: Bytes of the answer.
        kind: Its MIME type.
    """

    content: bytes
    kind: str = "text/html; charset=utf-8"


class Server(http.server.ThreadingHTTPServer):
    """Web server that prints nothing if a browser drops a connection, for example by a reload of the page."""

    def handle_error(self, request: object, client_address: object) -> None:
        """Print the traceback of the current error, unless it is a dropped connection."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


def serving(find: Callable[[str], Page | None], port: int = 0) -> Server:
    """Return a server of pages at 127.0.0.1; ``find`` returns the page of a path such as "/", or None.

    Requests for another host name are refused, so that no web site can read a page by a name that leads here.

    Raises:
        ConfigError: The port cannot be used.
    """

    class Handler(http.server.BaseHTTPRequestHandler):
        """Answers requests for pages."""

        def do_GET(self) -> None:
            """Send a page."""
            self._answer(with_body=True)

        def do_HEAD(self) -> None:
            """Send the head of a page."""
            self._answer(with_body=False)

        def _answer(self, *, with_body: bool) -> None:
            known = {f"{name}:{self.connection.getsockname()[1]}" for name in (HOST, "localhost")}
            page = find(self.path.partition("?")[0]) if self.headers.get("Host") in known else None
            body = page or Page(b"")
            self.send_response(404 if page is None else 200)
            self.send_header("Content-Type", body.kind)
            self.send_header("Content-Length", str(len(body.content)))
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            if with_body:
                self.wfile.write(body.content)

        def log_message(self, format: str, *args: object) -> None:
            """Print nothing."""

    try:
        return Server((HOST, port), Handler)
    except OSError as error:
        raise errors.ConfigError(f"--port {port}: cannot be used: {error}; leave it out for a free one") from error
