"""``r5dgs objects`` and ``r5dgs query --render``: output, files, and arguments that are refused before any work."""

import dataclasses
import json

import numpy as np
import pytest

from r5dgs_core.cli import main, pictures
from r5dgs_core.cli.commands import query
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.data import images
from r5dgs_core.errors import ConfigError
from r5dgs_core.scene import scene_file
from tests.support import scenes
from tests.support.command_line import complaint


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    scene = scenes.make_scene(n=240, objects=3, seed=5)
    return scene_file.write(scene, tmp_path_factory.mktemp("objects") / "toys.r5dgs")


def said(capsys, *arguments):
    assert main.main([str(a) for a in arguments]) == 0
    return capsys.readouterr().out


def test_objects_prints_the_same_values_as_text_and_json(path, capsys):
    found = json.loads(said(capsys, "objects", path, "--json"))
    scene = scene_file.read(path)
    assert [row["name"] for row in found["objects"]] == [item.name for item in scene.objects]
    assert found["views"] == len(scene.cameras) and found["scene"] == scene.name
    text = said(capsys, "objects", path)
    assert all(item.name in text for item in scene.objects) and "slide" in text


def test_a_run_is_measured_on_its_own_data(trained, capsys):
    found = json.loads(said(capsys, "objects", trained.folder, "--json"))
    rows = {row["name"]: row for row in found["objects"]}
    assert found["views"] == 6 and rows["brick"]["pixels"] > 0
    assert 0 < rows["ball"]["iou"] <= 1 and 0 < rows["ball"]["confidence"] <= 1


def test_the_legend_uses_the_requested_camera_time_and_size(path, capsys, tmp_path):
    text = said(capsys, "objects", path, "--legend", tmp_path / "l.png", "--camera", 1, "--time", 1.2, "--size", 120)
    camera = scene_file.read(path).cameras[1]
    assert f"camera {camera.name}, t = 1.2" in text.replace("\n", " ")
    assert images.size(tmp_path / "l.png")[0] == 120
    said(capsys, "objects", path, "--legend", tmp_path / "best.png", "--json")
    assert images.size(tmp_path / "best.png")[0] >= 1024


def test_a_query_reads_its_scene_once(path, tmp_path, monkeypatch):
    read, opened = scene_file.read, []
    monkeypatch.setattr(scene_file, "read", lambda *given: opened.append(given) or read(*given))
    query.run_query(path, "mug", render=tmp_path / "mug.png", camera="0", t=0.4)
    assert len(opened) == 1 and (tmp_path / "mug.png").exists()


def test_a_query_draws_its_matches(path, capsys, tmp_path):
    names = [item.name for item in scene_file.read(path).objects if item.id > 0]
    text = said(capsys, "query", path, names[0], "--render", tmp_path / "one.png", "--camera", 0, "--time", 0.4)
    assert "written" in text
    one = images.read(tmp_path / "one.png")
    assert one.shape[2] == 4 and one[..., 3].max() > 0.5 and one[..., 3].min() == 0
    both = " and ".join(names[:2])
    said(capsys, "query", path, both, "--render", tmp_path / "two.png", "--camera", 0, "--time", 0.4)
    two = images.read(tmp_path / "two.png")
    assert two[..., 3].sum() > 1.2 * one[..., 3].sum() and (two[..., 3] >= one[..., 3] - 0.01).all()
    wide = said(capsys, "query", path, names[0], "--render", tmp_path / "c.png", "--context", "--size", 64, "--json")
    assert json.loads(wide)["matches"][0]["name"] == names[0]
    assert images.size(tmp_path / "c.png") == (64, 48, 3)


def test_an_object_moves_in_its_pictures_and_goes_on_past_t_max(path, tmp_path):
    scene = scene_file.read(path)
    places = []
    for k, t in enumerate((0.2, scene.t_max, 1.1)):
        pictures.draw(scene, [2], tmp_path / f"{k}.png", camera="0", t=t)
        alpha = images.read(tmp_path / f"{k}.png")[..., 3]
        places.append(alpha.sum(0) @ np.arange(alpha.shape[1]) / alpha.sum())
    assert abs(places[1] - places[0]) > 2 and abs(places[2] - places[1]) > 2


def test_without_a_match_no_picture_is_written(path, capsys, tmp_path):
    assert main.main(["query", str(path), "elephant", "--render", str(tmp_path / "none.png")]) == ExitStatus.NEGATIVE
    assert "nothing matches" in capsys.readouterr().out
    assert not (tmp_path / "none.png").exists()


def test_invalid_picture_paths_are_rejected_before_the_work(path, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(scene_file, "read", lambda *_: pytest.fail("work began"))
    for option, command in (("--legend", ["objects", path]), ("--render", ["query", path, "mug"])):
        assert "ends in .png" in complaint(capsys, *command, option, tmp_path / "x.jpg", status=ExitStatus.USAGE)
        assert "create it first" in complaint(capsys, *command, option, tmp_path / "no" / "x.png")
        (tmp_path / "folder.png").mkdir(exist_ok=True)
        assert "expected a file" in complaint(capsys, *command, option, tmp_path / "folder.png")
        small = (*command, option, tmp_path / "x.png", "--size", 5)
        assert "16 to 8192" in complaint(capsys, *small, status=ExitStatus.USAGE)
        for lone in (["--camera", "1"], ["--time", "1"], ["--size", "64"]):
            assert f"{option} FILE.png" in complaint(capsys, *command, *lone, status=ExitStatus.USAGE)
    assert "--render FILE.png" in complaint(capsys, "query", path, "mug", "--context", status=ExitStatus.USAGE)
    for command in (["objects", path], ["query", path, "mug"]):
        assert "--mode wild: expected one of" in complaint(capsys, *command, "--mode", "wild", status=ExitStatus.USAGE)


def test_an_unknown_camera_mode_or_time_is_named(path, capsys, tmp_path):
    out = tmp_path / "x.png"
    assert "expected 0 to 1, or a name" in complaint(capsys, "objects", path, "--legend", out, "--camera", "left")
    assert "--time nan" in complaint(capsys, "objects", path, "--legend", out, "--time", "nan")
    line = complaint(capsys, "objects", path, "--mode", "stiff", status=ExitStatus.USAGE)
    assert "expected one of rigid" in line
    assert "has data for rigid only" in complaint(capsys, "objects", path, "--mode", "standard")
    assert not out.exists()


def test_an_object_without_gaussians_cannot_be_drawn(path, tmp_path):
    scene = scene_file.read(path)
    ghost = dataclasses.replace(scene.objects[-1], id=9, name="ghost", start=len(scene.gaussians.means), count=0)
    haunted = dataclasses.replace(scene, objects=(*scene.objects, ghost))
    with pytest.raises(ConfigError, match="ghost: no Gaussians"):
        pictures.draw(haunted, [9], tmp_path / "g.png")
    pictures.draw(haunted, [9, 1], tmp_path / "g.png")
    assert images.read(tmp_path / "g.png")[..., 3].max() > 0.5
