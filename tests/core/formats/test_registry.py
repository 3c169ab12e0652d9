"""Export formats: the registry, the user's page and a format that the developer's page adds."""

import dataclasses
import re
from pathlib import Path

import pytest

from r5dgs_core import errors
from r5dgs_core.cli import main
from r5dgs_core.formats import ply, registry, sog
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import pages, player
from tests.support.command_line import complaint

POSES = ("poses", "poses_csv", "tum")  # which hold the motion of an object without Gaussians
PAGE = Path(__file__).resolve().parents[3] / "docs" / "user" / "export.md"


@pytest.mark.parametrize("name", registry.MODULES)
def test_the_users_page_lists_each_format(name):
    found = registry.get(name)
    assert found.name == name
    row = f"| `{name}` | `{found.suffix}` | {found.keeps} | {found.loses} |"
    assert row in PAGE.read_text().splitlines()


def test_the_users_page_lists_no_other_format():
    assert re.findall(r"^\| `(\w+)` \|", PAGE.read_text(), re.MULTILINE) == list(registry.MODULES)


def test_the_developers_page_adds_a_format(scene, tmp_path, monkeypatch):
    pages.load("Export format", "r5dgs_core.formats.csv_points", monkeypatch)
    monkeypatch.setitem(registry.MODULES, "csv", "csv_points")
    path = scene_file.write(scene, tmp_path / "scene.r5dgs")
    assert main.main(["export", str(path), "--to", "csv", "--out", str(tmp_path / "a.csv"), "--time", "0.5"]) == 0
    head, *rows = (tmp_path / "a.csv").read_text().splitlines()
    means = scene_player.Player(scene_file.read(path)).frame(0.5).means
    assert head == "x,y,z" and len(rows) == len(means)
    assert [float(value) for value in rows[7].split(",")] == pytest.approx(means[7], rel=1e-5)


def test_a_format_without_its_package_is_refused_with_the_remedy(scene, tmp_path, monkeypatch, capsys):
    path = scene_file.write(scene, tmp_path / "scene.r5dgs")
    lacking = dataclasses.replace(ply.FORMAT, extra="tables", packages=("numpy", "no_such_package"))
    monkeypatch.setattr(ply, "FORMAT", lacking)
    line = complaint(capsys, "export", path, "--to", "ply", "--out", tmp_path / "a.ply")
    assert "no_such_package is not installed" in line and "pip install 'r5dgs[tables]'" in line
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize("name", registry.MODULES)
def test_folders_and_selections_that_do_not_suit_give_one_error_and_no_file(scene, tmp_path, name, monkeypatch):
    found = registry.get(name)
    if found.program == sog.PROGRAM:
        player.put_splat_transform_on_path(monkeypatch)
    if (reason := found.why_unavailable()) is not None:
        pytest.skip(reason)
    check_folders_and_selections(found, scene, tmp_path)


def test_the_format_of_the_developers_page_refuses_unsuitable_folders_and_selections(scene, tmp_path, monkeypatch):
    added = pages.load("Export format", "r5dgs_core.formats.csv_points", monkeypatch)
    check_folders_and_selections(added.FORMAT, scene, tmp_path)


def check_folders_and_selections(found, scene, tmp_path):
    missing = tmp_path / "missing" / f"a{found.suffix}"
    message = "expected an existing folder" if found.name == "r5dgs" else "cannot be written"
    with pytest.raises(errors.SceneFileError, match=message):
        list(found.write(scene, missing, registry.Options((0.3,))))
    if found.has_objects:
        item = scene.object(2)  # an object that has lost its Gaussians
        gone = dataclasses.replace(item, count=0)
        lost = dataclasses.replace(scene, objects=tuple(gone if one is item else one for one in scene.objects))
        for given, ids in ((scene, {77}), (lost, {2})):
            if found.name not in POSES or ids == {77}:
                with pytest.raises(errors.ConfigError, match="found none in the select"):
                    list(
                        found.write(
                            given, tmp_path / f"a{found.suffix}", registry.Options((0.3,), None, frozenset(ids))
                        )
                    )
    assert not list(tmp_path.iterdir())
