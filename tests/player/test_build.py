"""The committed page is what its sources build."""

import subprocess

import pytest

from r5dgs_core.formats import html
from tests.support import player


@pytest.mark.browser
def test_the_sources_build_the_committed_page(tmp_path):
    built = tmp_path / "player.html"
    subprocess.run([player.node(), player.FOLDER / "build.mjs", built], check=True, capture_output=True)
    assert built.read_bytes() == html.PAGE.read_bytes()
