"""Neither the origin nor the unit of a data set's world changes training, baking, playback and evaluation."""

import dataclasses
import json
import zipfile

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.bake import bake
from r5dgs_core.cli import inputs
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images, origin
from r5dgs_core.evaluation import evaluate
from r5dgs_core.playback import scene_info, scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import cameras, scene_file
from r5dgs_core.train import checkpoint, run
from tests.support import colmap_files, scenes, tiny_datasets

pytestmark = pytest.mark.heavy

FAR = np.array([5e6, -3.5e6, 1.5e6])
RING = 4.0 * np.stack([np.cos(np.arange(8.0)), np.sin(np.arange(8.0)), np.full(8, 0.3)], axis=1)
HERE = np.zeros(3)
WORLDS = [(1.0, 20 * FAR), (1e-12, HERE), (1e12, HERE), (1e-6, 1e-4 * FAR)]


def made(folder, scale, shift):
    return tiny_datasets.make_dataset(folder, scale=scale, shift=tuple(shift))


def psnr(a, b):
    return -10 * np.log10(np.mean((np.asarray(a, np.float64) - b) ** 2) + 1e-12)


def drawn(scene, views):
    return [
        scene_renderer.render_frame(scene, scene_player.Player(scene).frame(view.t), view.camera).color
        for view in views
    ]


def test_near_scenes_keep_the_origin_of_their_world(tiny):
    assert datasets.read(tiny.root).origin.tolist() == [0, 0, 0]
    for shift in (0.0, 100.0, -900.0):
        assert origin.find(RING + shift, "here").tolist() == [0, 0, 0]
    assert origin.find(RING[:1] + 900.0, "here").tolist() == [0, 0, 0]  # one camera: its unit is not known


@pytest.mark.parametrize("scale", [1e-12, 1e-3, 1.0, 1e9])
def test_far_scenes_get_an_origin_among_their_cameras_that_is_short_to_write(scale):
    found = origin.find(scale * (RING + 123456.789 * np.array([1.0, -1.0, 0.0])), "here")
    assert np.abs(found / scale - [123456.789, -123456.789, 0]).max() <= 4
    assert all(float(f"{value:.6g}") == value for value in found)
    assert origin.find(RING[:1] + 1e5, "here").any()  # one camera, too


def test_cameras_indistinguishable_in_float64_are_refused(tmp_path):
    with pytest.raises(errors.DatasetError, match=r"data: .*too far for 64-bit numbers.*subtract a constant"):
        datasets.read(made(tmp_path / "data", 1.0, (1e12, 0.0, 0.0)).root)
    with pytest.raises(errors.DatasetError, match="within 1e"):
        origin.find(1e10 * RING + 2e15, "here")
    for scale in (1e-40, 1e14, 1e40, 1e300):
        with pytest.raises(errors.DatasetError, match="scale all positions"):
            origin.find(scale * RING, "here")


def test_positions_are_read_relative_to_the_origin_and_can_be_measured_from_any_other(tiny, tmp_path):
    near, far = datasets.read(tiny.root), datasets.read(made(tmp_path / "data", 1.0, FAR).root)
    offset = FAR - far.origin
    assert far.origin.any() and np.abs(offset).max() < 8
    for one, other in zip(near.train, far.train, strict=True):
        np.testing.assert_allclose(other.camera.center, one.camera.center + offset, atol=1e-8)
        assert one.camera.name == other.camera.name
    np.testing.assert_allclose(
        far.ground_truth.matrices[..., :3, 3], near.ground_truth.matrices[..., :3, 3] + offset, atol=1e-8
    )
    back = far.relative_to(FAR)
    np.testing.assert_allclose(back.train[3].camera.center, near.train[3].camera.center, atol=1e-8)
    np.testing.assert_allclose(back.ground_truth.matrices, near.ground_truth.matrices, atol=1e-8)
    assert back.origin.tolist() == FAR.tolist() and back.relative_to(FAR) is back


def test_cameras_named_by_position_are_the_same_at_any_distance(tiny, tmp_path):
    near, far = datasets.read(tiny.root), datasets.read(made(tmp_path / "data", 1.0, 20 * FAR).root)
    assert [view.camera.name for view in far.train] == [view.camera.name for view in near.train]
    assert len(far.cameras) == len(near.cameras) == 7


def test_points_of_a_reconstruction_move_with_the_cameras(tmp_path):
    orbit = [scenes.orbit_camera(angle, 16, 12) for angle in (0.1, 1.3, 2.5)]
    far = {f"{i}.png": cameras.translated(camera, FAR) for i, camera in enumerate(orbit)}
    (tmp_path / "images").mkdir()
    for name in far:
        images.write_png(tmp_path / "images" / name, np.full((12, 16, 3), 0.5, np.float32))
    colmap_files.write(tmp_path / "sparse" / "0", far, np.array([[0.5, 0.25, 0.125]]) + FAR)
    found = datasets.read(tmp_path)
    offset = FAR - found.origin
    np.testing.assert_allclose(found.points, [np.array([0.5, 0.25, 0.125]) + offset], atol=1e-8)
    for view, camera in zip(found.train, orbit, strict=True):
        np.testing.assert_allclose(view.camera.center, camera.center + offset, atol=1e-7)


@pytest.fixture(scope="module")
def measured(baked, tiny):
    """Evaluation of the scene in its own world."""
    return evaluate.evaluate(baked, datasets.read(tiny.root))


@pytest.mark.default_cases("1e-06-shift3")
@pytest.mark.parametrize(("scale", "shift"), WORLDS)
def test_a_run_gives_the_same_results_in_any_world(trained, baked, measured, tmp_path, scale, shift):
    data = datasets.read(made(tmp_path / "data", scale, shift).root)
    state = checkpoint.load(trained.folder)
    x, y, z = (float(v) for v in scale * np.array(state.origin) + shift)
    state = dataclasses.replace(state, scale=scale * state.scale, origin=(x, y, z))
    checkpoint.save(tmp_path, state)
    path = scene_file.write(bake.bake(dataclasses.replace(trained, folder=tmp_path), data), tmp_path / "far.r5dgs")
    scene = scene_file.read(path)
    assert scene.origin.tolist() == data.origin.tolist()
    assert scene.near_plane == pytest.approx(scale * baked.near_plane, rel=1e-6)
    expected, found = measured, evaluate.evaluate(scene, data)
    for split in ("val", "test"):
        one, other = expected["splits"][split]["rigid"], found["splits"][split]["rigid"]
        for name in ("psnr", "psnr_objects", "ssim", "miou"):
            assert other[name] == pytest.approx(one[name], rel=2e-3), name
        assert other["psnr_pooled"] == pytest.approx(one["psnr_pooled"], rel=1e-3)
    for one, other in zip(expected["objects"], found["objects"], strict=True):
        # Contacts amplify the rounding of a prediction.
        assert other["position_error"] == pytest.approx(scale * one["position_error"], rel=1e-2)
        assert other["rotation_error_deg"] == pytest.approx(one["rotation_error_deg"], rel=1e-3, abs=0.2)


def train_briefly(root, folder):
    settings = tiny_datasets.settings("train.iterations=8", "identity.iterations=0")
    return bake.bake(tiny_datasets.as_trained(run.train(root, folder, settings)))


@pytest.fixture(scope="module")
def near(tiny, tmp_path_factory):
    """The scene of a short training near the origin."""
    return train_briefly(tiny.root, tmp_path_factory.mktemp("near") / "run")


@pytest.mark.slow
@pytest.mark.default_cases("1000000000000.0-shift2")
@pytest.mark.parametrize(
    ("scale", "shift"), [(1.0, 20 * FAR), pytest.param(1e-12, HERE, marks=pytest.mark.nightly), (1e12, HERE)]
)
def test_training_gives_the_same_pictures_in_any_world(tiny, near, tmp_path, scale, shift):
    data = made(tmp_path / "data", scale, shift)
    far = train_briefly(data.root, tmp_path / "far")
    assert len(far.gaussians.means) == pytest.approx(len(near.gaussians.means), rel=0.02)
    here, there = datasets.read(tiny.root), datasets.read(data.root)
    for split in ("val", "test"):
        for one, other in zip(drawn(near, here.views(split)), drawn(far, there.views(split)), strict=True):
            assert psnr(one, other) > 40  # rounding decides a few draws otherwise


def test_scenes_without_an_origin_are_measured_in_their_own_world(baked, tiny, tmp_path, caplog):
    data = made(tmp_path / "data", 1.0, 0.2 * FAR)
    older = dataclasses.replace(
        baked.with_arrays(means=(baked.gaussians.means.astype(np.float64) + 0.2 * FAR).astype(np.float32)),
        groups=tuple(
            dataclasses.replace(group, pivot=group.pivot + 0.2 * FAR, model=group.smooth or group.model, smooth=None)
            for group in baked.groups
        ),
        cameras=tuple(cameras.translated(camera, 0.2 * FAR) for camera in baked.cameras),
        hulls=(),
    )
    path = scene_file.write(older, tmp_path / "older.r5dgs")
    with zipfile.ZipFile(path) as archive:
        assert json.loads(archive.read("scene.json"))["format_version"] == 1
    scene, found = inputs.open_target(path, data.root)
    assert "Bake its run again" in caplog.text
    assert found is not None and not found.origin.any()
    view = found.val[0]
    expected = drawn(baked, datasets.read(tiny.root).val[:1])[0]
    assert psnr(drawn(scene, [view])[0], expected) > 20


def test_scenes_near_the_origin_are_read_without_a_warning(baked, tmp_path, caplog):
    scene_file.read(scene_file.write(baked, tmp_path / "near.r5dgs"))
    scene_file.read(scene_file.write(baked.with_arrays(origin=FAR), tmp_path / "far.r5dgs"))
    assert not caplog.records


def test_info_prints_an_origin_if_there_is_one(baked):
    assert "origin" not in scene_info.info(baked)
    assert scene_info.info(baked.with_arrays(origin=FAR))["origin"] == FAR.tolist()
