"""Web pages with a scene."""

import base64
import dataclasses
import re

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.formats import glb_reader, html, image_files, registry
from tests.support import scenes

OPTIONS = registry.Options((0.0,), until=1.3)


def test_a_page_holds_the_scene_and_refers_to_nothing_outside(tmp_path):
    scene = dataclasses.replace(scenes.make_scene(n=200), name='<b>"A" & B</b>{{SCENE}}')
    still = image_files.png(np.zeros((2, 3, 3), np.uint8))
    (path,) = html.export(scene, tmp_path / "a.html", dataclasses.replace(OPTIONS, still=still))
    text = path.read_text()
    assert "<title>&lt;b&gt;&quot;A&quot; &amp; B&lt;/b&gt;" in text and "<b>" not in text
    (inside,) = re.findall(r'<script id="scene"[^>]*>([^<]*)</script>', text)
    (tmp_path / "a.glb").write_bytes(base64.b64decode(inside))
    assert len(glb_reader.read(tmp_path / "a.glb").gaussians.means) == 200
    assert base64.b64encode(still).decode() in text and "PlayCanvas" in text and "Permission is hereby granted" in text
    assert not re.findall(r"""(?:src|href)\s*=\s*["']?(?!data:)\w+[:/]""", text.partition("<script>")[0])


def test_the_player_is_smaller_than_two_megabytes():
    assert len(html.page(scenes.make_scene(n=50), OPTIONS)) < 2_000_000
    assert html.PAGE.stat().st_size < 1_900_000


def test_no_half_written_page_is_left(tmp_path):
    with pytest.raises(errors.SceneFileError, match="cannot be written"):
        list(html.export(scenes.make_scene(n=50), tmp_path / "missing" / "a.html", OPTIONS))
    with pytest.raises(errors.ConfigError, match="expected Gaussians"):
        list(html.export(scenes.make_scene(n=50), tmp_path / "a.html", dataclasses.replace(OPTIONS, object_ids={9})))
    assert not list(tmp_path.iterdir())


def test_losses_of_other_programs_are_not_those_of_the_page():
    scene = scenes.make_scene(n=50, identities=False)
    assert html.losses(scene, dataclasses.replace(OPTIONS, still=b"png")) == []
    assert html.losses(scene, OPTIONS) == [html.NO_PICTURE]
