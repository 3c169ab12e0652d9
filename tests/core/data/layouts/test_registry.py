"""The layouts of data sets, and one that the developer's page adds."""

import re
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.data import dataset, images
from r5dgs_core.data.layouts import registry
from tests.support import pages


def write_table(root, rows):
    (root / "images").mkdir(parents=True)
    (root / "cameras.csv").write_text("".join(f"{row}\n" for row in rows))
    for number in range(3):
        images.write_png(root / "images" / f"{number}.png", np.full((8, 12, 3), number / 3, np.float32))


@pytest.fixture
def table_layout(monkeypatch):
    pages.load("Data set layout", "r5dgs_core.data.layouts.table", monkeypatch)
    monkeypatch.setattr(registry, "MODULES", [*registry.MODULES, "table"])


def test_the_developers_page_adds_a_layout(table_layout, tmp_path):
    write_table(tmp_path / "data", [f"{number}.png,{number / 2},10,{number},0,4" for number in range(3)])
    registry.check(tmp_path / "data")
    found = dataset.read(tmp_path / "data")
    assert [view.t for view in found.train] == [0, 0.5, 1] and found.val == ()
    np.testing.assert_allclose(found.train[2].camera.center, [2, 0, 4])
    assert found.train[1].camera.intrinsics[0, 0] == 10 and found.train[1].image_path.name == "1.png"


def test_a_damaged_row_of_that_layout_is_named(table_layout, tmp_path):
    write_table(tmp_path / "data", ["0.png,0,10,0,0"])
    with pytest.raises(errors.DatasetError, match="line 1"):
        dataset.read(tmp_path / "data")


def test_a_folder_without_a_known_layout_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(errors.DatasetError, match=str(path)):
            registry.check(path)


@pytest.mark.parametrize("video", ["cam0.mp4", "left/GX010042.MP4"])
def test_a_folder_of_videos_is_refused_with_the_command_that_prepares_it(tmp_path, video):
    (tmp_path / "my videos" / video).parent.mkdir(parents=True)
    (tmp_path / "my videos" / video).write_bytes(b"")
    with pytest.raises(errors.DatasetError, match="found videos.*r5dgs prepare '.*my videos' --out '.*my videos_data'"):
        registry.check(tmp_path / "my videos")


def test_a_video_and_folders_of_frames_are_refused_with_the_command_that_prepares_them(tmp_path):
    (tmp_path / "walk.mp4").write_bytes(b"")
    with pytest.raises(errors.DatasetError, match=r"found a file\. Remedy: .*prepare .*walk\.mp4 --out .*walk_data$"):
        registry.check(tmp_path / "walk.mp4")
    images.write_png(tmp_path / "frames" / "cam0" / "0.png", np.zeros((8, 12, 3), np.float32))
    with pytest.raises(
        errors.DatasetError, match="is it the right folder.*prepare .*frames --out .*frames_data' makes"
    ):
        registry.check(tmp_path / "frames")


@pytest.mark.parametrize("source", [".", ".."])
def test_the_command_for_the_present_folder_names_another_one(tmp_path, monkeypatch, source):
    (tmp_path / "walk" / "sub").mkdir(parents=True)
    (tmp_path / "walk" / "cam0.mp4").write_bytes(b"")
    monkeypatch.chdir(tmp_path / "walk" / ("" if source == "." else "sub"))
    with pytest.raises(errors.DatasetError, match=rf"r5dgs prepare {re.escape(source)} --out .*walk_data$"):
        registry.check(Path(source))
