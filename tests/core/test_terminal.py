"""Names and messages reach a terminal without control characters, and JSON keeps them exactly."""

import dataclasses
import json
import logging
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core import progress, terminal
from r5dgs_core.cli import main
from r5dgs_core.scene import scene_file
from tests.support import scenes

EVIL = "[red] mug\x1b[2J\x1b]0;owned\x07\r\nr5dgs: all is well\x9b31m\u202e"


@given(st.text())
def test_printable_text_has_no_control_characters_and_stays_as_it_is(text):
    made = terminal.printable(text)
    assert made.replace("\u200c", "").replace("\u200d", "").isprintable()
    assert terminal.printable(made) == made
    assert made == text or not text.isprintable()


def test_half_a_surrogate_pair_is_escaped():
    assert terminal.printable("a\ud800b") == "a\\ud800b"


def test_a_printed_text_is_one_line(capsys):
    terminal.print_lines([f"{EVIL}: not predictable past 0.85", "mug"])
    captured = capsys.readouterr()
    assert_harmless(captured)
    assert len(captured.out.splitlines()) == 2


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    scene = scenes.make_scene(n=120, objects=2)
    objects = tuple(dataclasses.replace(item, name=EVIL) if item.id == 1 else item for item in scene.objects)
    return scene_file.write(
        dataclasses.replace(scene, objects=objects), tmp_path_factory.mktemp("evil") / "scene.r5dgs"
    )


def assert_harmless(captured):
    for text in captured:
        assert not set(text) & {"\x1b", "\x07", "\r", "\x9b", "\u202e"}
        assert not any(line.startswith("r5dgs: all is well") for line in text.splitlines())


@pytest.mark.parametrize("command", [["info"], ["check"], ["objects"], ["query", "mug"]])
def test_no_command_prints_control_sequences(path, capsys, command):
    main.main([command[0], str(path), *command[1:]])
    captured = capsys.readouterr()
    assert "mug" in captured.out + captured.err
    assert_harmless(captured)


def test_json_keeps_the_name_exactly(path, capsys):
    assert main.main(["info", str(path), "--json"]) == 0
    captured = capsys.readouterr()
    assert EVIL in {item["name"] for item in json.loads(captured.out)["objects"]}
    assert_harmless(captured)


def test_an_error_is_one_line_for_any_path(tmp_path, capsys):
    assert main.main(["info", str(tmp_path / EVIL)]) != 0
    captured = capsys.readouterr()
    assert_harmless(captured)
    assert captured.err.count("\n") == 1


def test_logs_are_one_line_each_and_the_streams_come_back(capsys):
    before = sys.stdout, sys.stderr
    with terminal.safe_output():
        logger = logging.Logger("hostile")  # without handlers: as on the command line
        logger.warning("found %s", EVIL)
        print("two\nlines\tof ours")
    assert (sys.stdout, sys.stderr) == before
    captured = capsys.readouterr()
    assert_harmless(captured)
    assert captured.err.count("\n") == 1 and captured.out == "two\nlines\tof ours\n"


@pytest.mark.parametrize("styled", [True, False])
def test_tables_and_bars_keep_their_style_and_show_names_as_they_are(capsys, styled):
    from rich.table import Table
    from rich.text import Text

    table = Table()
    table.add_column("name")
    table.add_row(Text(EVIL))
    table.add_row("[bold]ours[/bold]")
    with terminal.safe_output():
        terminal.console(force_terminal=styled, width=200).print(table)
    out = capsys.readouterr().out
    assert "[red]" in out and ("\x1b[1m" in out) == styled
    assert "\x1b[2J" not in out and "\x1b]0;" not in out and "\x07" not in out and "\x9b" not in out


@pytest.mark.parametrize("kind", ["auto", "terminal"])
def test_progress_shows_names_without_control_characters(capsys, monkeypatch, kind):
    if kind == "terminal":
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    with progress.make("auto") as show:
        show({"event": "prepare", "text": EVIL})
    out = capsys.readouterr().out
    assert "\x1b[2J" not in out and "\x1b]0;" not in out and "\x07" not in out and "[red]" in out
