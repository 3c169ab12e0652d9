"""The public functions: the code of docs/reference/python.md runs, and importing the package loads nothing."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

import r5dgs_core
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import pages, tiny_datasets

pytestmark = pytest.mark.heavy

PAGE = "docs/reference/python.md"
PLAY, TRAIN, RASTERIZE = pages.blocks(PAGE)


def test_the_page_plays_a_scene(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene_file.write(scene, tmp_path / "demo.r5dgs", precision="exact")
    names: dict = {}
    exec(PLAY, names)
    camera, image = scene.cameras[0], names["image"]
    assert image.shape == (camera.height, camera.width, 3) and image.min() >= 0 and 0.2 < image.max() <= 1


def test_the_readme_predicts_a_scene(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()
    scene_file.write(scene, tmp_path / "demo" / "demo.r5dgs", precision="exact")
    (code,) = pages.blocks("README.md")
    names: dict = {}
    exec(code, names)
    assert names["image"].ndim == 3 and 0.2 < names["image"].max() <= 1
    assert all(matrix.shape == (4, 4) for matrix in names["matrices"].values())


def test_the_page_trains_and_evaluates_a_scene(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(tiny.root, tmp_path / "my_images")
    few = [*tiny_datasets.SETTINGS, "train.iterations=5", "identity.iterations=2"]
    assert '["train.iterations=3000"]' in TRAIN
    names: dict = {}
    exec(TRAIN.replace('["train.iterations=3000"]', repr(few)), names)
    assert r5dgs_core.load("scene.r5dgs").objects == names["scene"].objects
    assert names["result"]["splits"]["test"]["rigid"]["images"] == 4


def test_the_page_rasterizes_with_gradients():
    names: dict = {}
    exec(RASTERIZE, names)
    assert names["picture"].image.shape == (300, 400, 5) and names["picture"].alpha.max() > 0.1
    for name in ("means", "quats", "scales", "channels"):
        gradient = names[name].grad
        assert gradient.isfinite().all() and gradient.abs().max() > 0


def test_poses_move_the_gaussians_of_their_objects(scene):
    t = scene.t_max + 0.2
    found, means = r5dgs_core.poses(scene, t), scene_player.Player(scene).frame(t).means
    assert list(found) == [item.name for item in scene.objects if item.id > 0]
    for item in scene.objects:
        if item.id > 0:
            rows = slice(item.start, item.start + item.count)
            matrix = found[item.name]
            expected = scene.gaussians.means[rows] @ matrix[:3, :3].T + matrix[:3, 3]
            np.testing.assert_allclose(means[rows], expected, atol=1e-5)


def test_every_public_name_is_on_the_page_and_others_are_refused():
    page = (pages.ROOT / PAGE).read_text()
    for name in r5dgs_core.__all__:
        assert callable(getattr(r5dgs_core, name)) and f"| `{name}(" in page
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = r5dgs_core.nonsense


def test_the_package_is_imported_without_numpy():
    code = "import sys, r5dgs_core; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
