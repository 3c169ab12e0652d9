"""The command ``r5dgs view``."""

import http.client
import socket
import threading

import pytest

from r5dgs_core.cli import page_server
from r5dgs_core.scene import scene_file
from tests.support import scenes
from tests.support.command_line import complaint


@pytest.fixture
def port():
    with page_server.serving({"/": page_server.Page(b"the page")}.get) as server:
        assert server.server_address[0] == "127.0.0.1"
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


def asked(port, method, target, host=None):
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request(method, target, headers={"Host": host or f"127.0.0.1:{port}"})
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_only_the_page_is_served(port):
    assert asked(port, "GET", "/?t=0.5") == (200, b"the page") and asked(port, "HEAD", "/") == (200, b"")
    for target in ("/index.html", "/../etc/passwd", "/favicon.ico"):
        assert asked(port, "GET", target) == (404, b"")
    assert asked(port, "POST", "/")[0] == 501


def test_requests_for_another_host_are_refused(port):
    assert asked(port, "GET", "/", f"localhost:{port}")[0] == 200
    assert asked(port, "GET", "/", "attacker.example") == (404, b"")


def test_a_dropped_connection_prints_nothing(capsys):
    content = b"x" * (1 << 24)  # more than the buffers of the system hold
    with page_server.serving({"/": page_server.Page(content)}.get) as server:
        server.daemon_threads = False  # so that its end waits for them
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        with socket.create_connection(("127.0.0.1", server.server_port)) as connection:
            connection.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode())
            connection.recv(1)
        thread.join()
    assert capsys.readouterr().err == ""


def test_wrong_arguments_are_named(port, tmp_path, capsys):
    path = scene_file.write(scenes.make_scene(n=60), tmp_path / "a.r5dgs")
    assert "--port 70000" in complaint(capsys, "view", path, "--port", "70000", status=2)
    assert "--until" in complaint(capsys, "view", path, "--until", "0.1", status=2)
    assert "zebra" in complaint(capsys, "view", path, "--objects", "zebra")
    assert f"--port {port}: cannot be used" in complaint(capsys, "view", path, "--port", port)
    (tmp_path / "run.json").write_text("{}")
    assert "found a run folder; show it with --live" in complaint(capsys, "view", tmp_path)
