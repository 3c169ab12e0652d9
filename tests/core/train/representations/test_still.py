"""A scene at rest has no moving parts: not in the run, not in the file, not in memory."""

import dataclasses
import json
import zipfile

import numpy as np
import pytest

from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import SceneFileError
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from r5dgs_core.train import normalization
from r5dgs_core.train import train_views as training_views
from r5dgs_core.train.representations import still as representation
from tests.support import processes, tiny_datasets

MOVING_PARTS = (
    *("deformation", "trd", "encoding", "tracks", "track_state"),
    *("residual", "residual_trial", "residual_field"),
)
RUN = """
import json, sys
from pathlib import Path
from r5dgs_core.bake import bake
from r5dgs_core.train import run
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from r5dgs_core.train import learning_curves
from tests.support import tiny_datasets
learning_curves.LearningCurves.update = lambda self, *, finished=False: None
data, folder = Path(sys.argv[1]), Path(sys.argv[2])
for name in sys.argv[3:]:
    settings = tiny_datasets.settings("train.iterations=25", f"train.representation={name}")
    run.train(data, folder / name, settings)
    bake.run_bake(folder / name, folder / f"{name}.r5dgs")
    scene_player.Player(scene_file.read(folder / f"{name}.r5dgs")).frame(2.0)
print(json.dumps(sorted(name for name in sys.modules if name.startswith("r5dgs_core"))))
"""


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    return tiny_datasets.make_dataset(tmp_path_factory.mktemp("still"), still=True)


def train_views(data):
    read = datasets.read(data.root)
    return training_views.load(read, normalization.from_cameras([v.camera for v in read.train]), None)


@pytest.fixture(scope="module")
def baked_at_rest(still, tmp_path_factory):
    """Folder of the scenes that a fresh process trained in both representations, and the modules that it loaded."""
    folder = tmp_path_factory.mktemp("at rest")
    done = processes.run(RUN, still.root, folder, "tracks", "field")
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_training_a_scene_at_rest_loads_no_module_of_motion(baked_at_rest):
    parts = {name.rpartition(".")[2] for name in baked_at_rest[1]}
    assert not parts & set(MOVING_PARTS) and not [part for part in parts if part.startswith("field")]


@pytest.mark.slow
@pytest.mark.parametrize("representation", ["tracks", "field"])
def test_the_file_of_a_scene_at_rest_has_nothing_that_moves(baked_at_rest, representation):
    path = baked_at_rest[0] / f"{representation}.r5dgs"
    scene = scene_file.read(path)
    members = set(zipfile.ZipFile(path).namelist())
    moving = ("track_times", "track_poses", "dynamics", "canonical_means", "residual_rows", "shading")
    assert not members & {f"{name}.npy" for name in moving}
    decisions = {row["name"]: row["decision"] for row in scene.needs}
    assert {decisions[name] for name in ("tracks", "rotation", "shading", "shadows", "residuals")} == {"off"}
    assert [o.name for o in scene.objects] == ["background", "brick", "ball"]
    assert all(group.model.is_static for group in scene.groups)
    np.testing.assert_array_equal(scene_player.Player(scene).frame(7.0).means, scene.gaussians.means)


def test_small_motion_is_detected(still, tiny):
    at_rest, moving = train_views(still), train_views(tiny)
    assert representation.nothing_moves(at_rest) and not representation.nothing_moves(moving)
    draw = np.random.default_rng(0)

    def noisy(view, sigma):
        grain = draw.normal(0, sigma, view.image.shape)
        return view.with_arrays(np.clip(view.image + grain, 0, 255).astype(np.uint8))

    assert representation.nothing_moves([noisy(view, 4.0) for view in at_rest])
    changed = at_rest[-1].image.copy()
    changed[8:16, 8:16] = 255 - changed[8:16, 8:16]
    assert not representation.nothing_moves([*at_rest[:-1], at_rest[-1].with_arrays(changed)])


def test_cameras_that_show_one_time_each_leave_motion_undecided(still):
    seen = train_views(still)
    one_each = [next(v for v in seen if v.camera is not None and v.t == t) for t in sorted({v.t for v in seen})]
    turned = [
        dataclasses.replace(v, camera=dataclasses.replace(v.camera, T_cam_world=v.camera.T_cam_world + 1e-3 * k))
        for k, v in enumerate(one_each)
    ]
    assert not representation.nothing_moves(turned)
    assert representation.nothing_moves([v for v in seen if v.t == seen[0].t])


def test_overrides_of_the_user_win_over_the_images(still, tiny):
    at_rest, moving = train_views(still), train_views(tiny)
    assert not representation.applies(at_rest, config.Config().replace(**{"needs.tracks": "on"}))
    assert representation.applies(moving, config.Config().replace(**{"needs.tracks": "off"}))


def test_a_file_with_half_of_the_tracks_is_refused(still, tmp_path):
    made = tiny_datasets.make_truth()
    path = scene_file.write(made, tmp_path / "whole.r5dgs")
    with zipfile.ZipFile(path) as whole, zipfile.ZipFile(tmp_path / "half.r5dgs", "w") as half:
        for name in whole.namelist():
            data = whole.read(name)
            if name == "scene.json":
                tree = json.loads(data)
                tree["arrays"].remove("track_times")
                data = json.dumps(tree).encode()
            half.writestr(name, data)
    with pytest.raises(SceneFileError, match="expected both of track_times and track_poses"):
        scene_file.read(tmp_path / "half.r5dgs")
