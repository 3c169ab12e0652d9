"""Held-out cameras are aligned to the scene, and corrections of a run travel into the scene and its evaluation."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.bake import bake
from r5dgs_core.data import dataset as datasets
from r5dgs_core.evaluation import alignment, evaluate, scene_summary
from r5dgs_core.scene.camera_correction import Correction
from r5dgs_core.train import run
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

WRONG = Correction(rotvec=np.array([0.01, -0.012, 0.02]), shift=np.array([0.02, 0.0, 0.03]))


@pytest.fixture(scope="module")
def data(tiny):
    """The tiny data set with wrong held-out cameras."""
    given = datasets.read(tiny.root)
    val = tuple(dataclasses.replace(view, camera=WRONG.camera(view.camera)) for view in given.val)
    return dataclasses.replace(given, val=val, test=())


def test_a_wrong_camera_is_measured_as_well_as_the_right_one_after_alignment(tiny, data):
    scene = tiny_datasets.make_truth()
    found = evaluate.evaluate(scene, data, splits=("val",), align=True)["splits"]["val"]["rigid"]
    assert found["psnr"] < 30
    assert found["psnr_aligned"] > found["psnr"] + 12


def test_nothing_is_aligned_without_refinement_or_request(data):
    found = evaluate.evaluate(tiny_datasets.make_truth(), data, splits=("val",))["splits"]["val"]["rigid"]
    assert found["psnr_aligned"] is None


def test_refined_cameras_keep_their_corrections(data):
    stored = {"refined": ["camera_poses"], "corrections": {data.val[0].camera.name: WRONG.to_dict()}}
    scene = dataclasses.replace(tiny_datasets.make_truth(), provenance={"cameras": stored})
    found = alignment.corrections(scene, data.val, None)
    assert found[data.val[0].camera.name].to_dict() == WRONG.to_dict()


@pytest.mark.slow
def test_corrections_of_a_run_travel_into_the_scene(tiny, tmp_path):
    settings = tiny_datasets.settings("train.iterations=100", "needs.camera_poses=on", "needs.camera_colours=on")
    made = run.train(tiny.root, tmp_path / "run", settings)
    given = datasets.read(tiny.root)
    scene = bake.bake(made, given)
    record = scene.provenance["cameras"]
    assert record["refined"] == ["camera_poses", "camera_colours"]
    name = given.train[0].camera.name
    camera = next(camera for camera in scene.cameras if camera.name == name)
    changed = np.abs(camera.T_cam_world - given.train[0].camera.T_cam_world).max()
    assert 0 < changed < 0.1
    assert 0 < record["pixels"][name] < 3
    rows = {row["name"]: row["decision"] for row in scene.needs}
    assert (rows["camera_poses"], rows["time_offsets"]) == ("on", "off")
    assert "cameras    pictures moved by" in scene_summary.summary(scene)
    found = evaluate.evaluate(scene, given)["splits"]
    assert found["val"]["rigid"]["psnr_aligned"] > found["val"]["rigid"]["psnr"] - 0.5
