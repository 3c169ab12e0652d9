"""Unreadable run folders of other projects, their settings, and the command `r5dgs import`."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
import torch

from r5dgs_core.cli import main
from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import CheckpointError, ConfigError, SceneFileError
from r5dgs_core.importing import assembly, cameras_json, deformable, importer, run_folder, weights
from r5dgs_core.scene import scene_file
from tests.support import foreign_runs as foreign
from tests.support.foreign_runs import T_MAX


class Trap:
    """Runs code when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.fixture
def deformed(tmp_path):
    """A Deformable-3DGS folder."""
    folder = tmp_path / "run"
    foreign.write_common(folder, foreign.cloud(1), 20000, "is_blender=True")
    write_deform(folder, 20000)
    return folder


@pytest.fixture
def traced(tmp_path):
    """A TRACE folder."""
    folder = tmp_path / "run"
    foreign.write_common(folder, foreign.cloud(1), 20000, f"max_time={T_MAX}")
    write_deform(folder, 20000, inputs=81)
    velocity = foreign.velocity_weights(3, 4, 128, 6, 12, 3)
    foreign.write_weights(folder / "deform" / "iteration_20000" / "vel.pth", velocity)
    return folder


def write_deform(folder, iteration, inputs=93, **changed):
    """Write ``deform.pth``, with some tensors changed."""
    content = foreign.deform_weights(1, 256, 8, inputs) | changed
    foreign.write_weights(folder / "deform" / f"iteration_{iteration}" / "deform.pth", content)


@pytest.mark.parametrize("name", ["deform", "classifier"])
@pytest.mark.parametrize("kind", ["torch", "pickle"])
def test_a_pickle_with_code_in_it_is_refused_and_not_run(deformed, tmp_path, name, kind):
    part = "deform" if name == "deform" else "point_cloud"
    path = deformed / part / "iteration_20000" / f"{name}.pth"
    if name == "classifier":
        foreign.write_common(deformed, foreign.cloud(1, identities=True), 20000, "num_classes=256")
        (deformed / "deform" / "iteration_20000" / "deform.pth").unlink()
        (deformed / "deform" / "iteration_20000").rmdir()
        (deformed / "deform").rmdir()
    sprung = tmp_path / "sprung"
    content = {"weight": torch.zeros(3), "extra": Trap(sprung)}
    if kind == "torch":
        torch.save(content, path)
    else:
        path.write_bytes(pickle.dumps(content, protocol=2))
    with pytest.raises(CheckpointError, match=rf"{name}\.pth: refused, as it holds code"):
        importer.import_run(deformed)
    assert not sprung.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not a checkpoint at all", "refused|cannot be read"),
        ([torch.zeros(2)], "expected tensors by name, found list"),
        ({"linear.0.weight": 3.0}, "'linear.0.weight': expected a tensor, found float"),
        ({"linear.0.weight": torch.tensor([1.0, np.nan])}, "expected finite numbers"),
        ({"other": torch.zeros(2)}, "expected the tensor 'linear.0.weight', found other"),
    ],
)
def test_weights_of_another_kind_are_named(deformed, content, message):
    path = deformed / "deform" / "iteration_20000" / "deform.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(CheckpointError, match=message) as caught:
        importer.import_run(deformed)
    assert str(path) in str(caught.value)


def test_a_truncated_file_is_named(deformed):
    path = deformed / "deform" / "iteration_20000" / "deform.pth"
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(CheckpointError, match="deform.pth: .*truncated"):
        weights.load(path)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"linear.3.weight": torch.zeros(256, 255)},
            r"'linear.3.weight': expected shape \(256, 256\), found \(256, 255\)",
        ),
        ({"linear.5.weight": torch.zeros(256, 256)}, r"to have 256 \+ 93 inputs, found 0"),
        ({"linear.2.bias": torch.zeros(4)}, r"'linear.2.bias': expected shape \(256\), found \(4\)"),
        ({"gaussian_rotation.weight": torch.zeros(3, 256)}, "'gaussian_rotation.weight': expected shape"),
        ({"timenet.0.weight": torch.zeros(256, 12)}, "12 inputs are no encoding of 1 numbers"),
    ],
)
def test_wrong_shapes_are_named(deformed, changed, message):
    write_deform(deformed, 20000, **changed)
    with pytest.raises(CheckpointError, match=message):
        importer.import_run(deformed)


def test_a_velocity_network_of_another_width_is_refused(traced):
    path = traced / "deform" / "iteration_20000" / "vel.pth"
    foreign.write_weights(path, foreign.velocity_weights(3, 4, 128, 6, 13, 3))
    with pytest.raises(CheckpointError, match="expected a network from 4 to 12 numbers, found 4 to 13"):
        importer.import_run(traced)


def test_trace_and_freegave_need_their_last_time(traced):
    (traced / "cfg_args").write_text("Namespace(light=True)")
    with pytest.raises(CheckpointError, match=r"cfg_args: 'max_time': expected .* found nothing; give it with --t-max"):
        importer.import_run(traced)
    scene = importer.import_run(traced, importer.Options(t_max=0.6, knots=3))
    np.testing.assert_allclose(scene.tracks.times, [0.0, 0.3, 0.6])


def test_a_classifier_needs_identities(tmp_path):
    foreign.write_common(tmp_path, foreign.cloud(), 100, "num_classes=4")
    path = tmp_path / "point_cloud" / "iteration_100" / "classifier.pth"
    foreign.write_weights(path, {"weight": torch.zeros(4, 16, 1, 1), "bias": torch.zeros(4)})
    with pytest.raises(CheckpointError, match=r"expected the columns obj_dc_0..15 beside a classifier.pth, found none"):
        importer.import_run(tmp_path)


def test_the_last_complete_iteration_is_read_unless_another_is_named(deformed):
    for iteration in (7000, 30000):
        source = deformed / "point_cloud" / "iteration_20000" / "point_cloud.ply"
        target = deformed / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
        target.parent.mkdir()
        target.write_bytes(source.read_bytes())
    write_deform(deformed, 7000)
    assert run_folder.open_run(deformed).iteration == 20000  # 30000 has no deformation
    assert run_folder.open_run(deformed, 7000).iteration == 7000
    with pytest.raises(CheckpointError, match="N = 30000, found the iterations 7000, 20000"):
        run_folder.open_run(deformed, 30000)


def test_each_unusable_run_folder_is_refused_with_its_reason(tmp_path, deformed):
    with pytest.raises(CheckpointError, match="expected a run folder, or a .glb or .4dgs file, found nothing"):
        run_folder.open_run(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match="expected a run folder, or a .glb or .4dgs file, found a file"):
        run_folder.open_run(deformed / "cfg_args")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(CheckpointError, match="expected a folder 'point_cloud', found none; known are"):
        run_folder.open_run(empty)
    (empty / "point_cloud" / "iteration_x").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"expected point_cloud/iteration_N/point_cloud.ply of one iteration N"):
        run_folder.open_run(empty)
    inside = deformed / "point_cloud" / "iteration_20000"
    with pytest.raises(CheckpointError, match=f"name the run folder itself, {deformed}"):
        run_folder.open_run(inside)
    (deformed / "deform" / "iteration_20000" / "hexplane.pth").write_bytes(b"")
    with pytest.raises(CheckpointError, match="unknown layout: unexpected hexplane.pth"):
        run_folder.open_run(deformed)


def test_settings_are_parsed_and_never_executed(tmp_path):
    path, sprung = tmp_path / "cfg_args", tmp_path / "sprung"
    path.write_text(
        f"Namespace(max_time=0.65, light=True, n=-3, names=['a', 'b'], device=open({str(sprung)!r}, 'w'), none=None, "
        "a={[]: 1})\n"
    )
    config = run_folder.read_config(path)
    assert not sprung.exists()
    assert config["max_time"] == 0.65 and config["light"] is True and config["n"] == -3
    assert config["names"] == ["a", "b"] and config["none"] is None
    assert config["device"].startswith("open(") and config["a"] == "{[]: 1}"
    assert run_folder.read_config(tmp_path / "none") == {}
    for text in ("Namespace(a=", "dict(a=1)", "", "[1, 2]"):
        path.write_text(text)
        with pytest.raises(CheckpointError, match=r"cfg_args: expected 'Namespace\(key=value, \.\.\.\)'"):
            run_folder.read_config(path)


def test_cameras_are_those_of_the_file(tmp_path):
    path = tmp_path / "cameras.json"
    assert cameras_json.read(path) == ()
    foreign.write_common(tmp_path, foreign.cloud(), 1, "")
    (camera,) = cameras_json.read(path)
    expected = foreign.view()
    np.testing.assert_allclose(camera.T_cam_world, expected.T_cam_world, atol=1e-12)
    np.testing.assert_allclose(camera.intrinsics, expected.intrinsics, atol=1e-9)
    entries = json.loads(path.read_text())
    for change, message in (
        ({"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "camera 1: expected a rotation"),
        ({"position": None}, "camera 1: expected 'width'"),
        ({"fx": 0.0}, "camera 1: expected a rotation, a position and positive sizes"),
    ):
        path.write_text(json.dumps([entries[0], {**entries[1], **change}]))
        with pytest.raises(CheckpointError, match=message):
            cameras_json.read(path)


def test_principal_axes_keep_the_given_ones_of_unit_quaternions():
    random = np.random.default_rng(0)
    quats = random.normal(size=(200, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = np.exp(random.normal(size=(200, 3)))
    scales[:20] = scales[:20, :1]  # spheres
    scales[20:40, 1] = scales[20:40, 0]  # discs and rods
    scales[40:50] *= [1, 1e-4, 1]
    axes, log_scales = deformable.principal_axes(quats, scales)
    np.testing.assert_allclose(np.abs((axes * quats).sum(1)), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.exp(log_scales), scales, rtol=1e-6)


def test_principal_axes_give_the_picture_of_any_quaternion():
    random = np.random.default_rng(1)
    quats = random.normal(size=(300, 4)) * random.uniform(0.3, 1.8, (300, 1))
    scales = random.normal(size=(300, 3))  # of any sign
    quats[0], scales[1] = 0.0, 0.0
    axes, log_scales = deformable.principal_axes(quats, scales)
    expected = foreign.drawn(torch.zeros(300, 3), torch.from_numpy(quats), torch.from_numpy(scales)).covariances
    found = foreign.drawn(torch.zeros(300, 3), torch.from_numpy(axes), torch.from_numpy(np.exp(log_scales)))
    size = expected.abs().amax((1, 2), keepdim=True) + 1e-12
    np.testing.assert_allclose(found.covariances / size, expected / size, atol=1e-9)


def test_nearly_static_gaussians_are_dropped_and_kept_ones_are_exact(deformed):
    every = importer.import_run(deformed, importer.Options(knots=5, still=0.0))
    assert len(every.residuals.rows) == foreign.COUNT
    some = importer.import_run(deformed, importer.Options(knots=5, still=0.1))
    assert 0 < len(some.residuals.rows) < foreign.COUNT
    np.testing.assert_array_equal(some.residuals.offsets, every.residuals.offsets[some.residuals.rows])
    left_out = np.setdiff1d(np.arange(foreign.COUNT), some.residuals.rows)
    assert np.linalg.norm(every.residuals.offsets[left_out], axis=-1).max() < 0.1 * every.extent * 1.1


def test_rows_are_sampled_the_same_in_chunks(deformed, monkeypatch):
    whole = importer.import_run(deformed, importer.Options(knots=3))
    monkeypatch.setattr(assembly, "CHUNK", 7)
    told = []
    parts = importer.import_run(deformed, importer.Options(knots=3), lambda *count: told.append(count))
    np.testing.assert_array_equal(parts.residuals.rows, whole.residuals.rows)
    np.testing.assert_allclose(parts.residuals.offsets, whole.residuals.offsets, atol=1e-6)
    np.testing.assert_allclose(parts.gaussians.means, whole.gaussians.means, atol=1e-6)
    assert told == [(7, 24), (14, 24), (21, 24), (24, 24)]


def test_a_data_set_gives_times_cameras_and_axes(deformed, tiny):
    dataset = datasets.read(tiny.root)
    scene = importer.import_run(deformed, importer.Options(data=tiny.root))
    np.testing.assert_allclose(scene.tracks.times, dataset.times)
    assert scene.t_max == dataset.t_max
    assert [camera.name for camera in scene.cameras] == [camera.name for camera in dataset.cameras]
    assert (scene.world_convention, scene.frames_per_unit) == ("blender", 40.0)
    without = importer.import_run(deformed, importer.Options(knots=4, world="opengl", t_max=0.5))
    np.testing.assert_allclose(without.tracks.times, np.linspace(0, 0.5, 4))
    assert without.world_convention == "opengl"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"knots": 1}, "--knots 1: expected at least 2"),
        ({"t_max": 0.0}, "--t-max 0: expected a positive time"),
        ({"still": -1.0}, "--still -1"),
        ({"world": "maya"}, "--world maya: expected one of blender"),
    ],
)
def test_options_are_checked(options, message):
    with pytest.raises(ConfigError, match=message):
        importer.Options(**options)


def test_the_command_writes_a_scene_that_info_reads(deformed, tmp_path, capsys):
    out = tmp_path / "scene.r5dgs"
    assert main.main(["import", str(deformed), "--out", str(out), "--knots", "3", "--progress", "none"]) == 0
    assert f"{out}: 24 Gaussians, 0 objects, t_max 1" in capsys.readouterr().out
    assert main.main(["import", str(deformed), "--out", str(out), "--knots", "3", "--overwrite"]) == 0
    assert "import 24 of 24 Gaussians" in capsys.readouterr().out
    scene = scene_file.read(out)
    assert scene.name == "run" and len(scene.tracks.times) == 3
    assert scene.provenance["imported"]["settings"]["is_blender"] is True
    arguments = ["--out", str(out), "--knots", "3", "--overwrite", "--progress", "json"]
    assert main.main(["import", str(deformed), *arguments]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert events[0] == {"event": "import", "done": 24, "total": 24, "unit": "Gaussians"}
    assert events[-1] == {"event": "imported", "path": str(out), "gaussians": 24}


def test_a_failed_import_leaves_the_old_scene(deformed, tmp_path, capsys):
    out = tmp_path / "scene.r5dgs"
    out.write_bytes(b"old")
    assert main.main(["import", str(deformed), "--out", str(out), "--iteration", "5", "--overwrite"]) == 3
    assert "N = 5, found the iterations 20000" in capsys.readouterr().err
    assert out.read_bytes() == b"old"
    assert main.main(["import", str(deformed), "--out", str(tmp_path / "scene.ply")]) == 2
    assert "expected a name that ends in .r5dgs" in capsys.readouterr().err


def test_a_damaged_ply_is_named(deformed):
    path = deformed / "point_cloud" / "iteration_20000" / "point_cloud.ply"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(SceneFileError, match="point_cloud.ply"):
        importer.import_run(deformed)
