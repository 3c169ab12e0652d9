"""A folder in each foreign layout becomes a scene with the picture that the layout's own rule gives."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from r5dgs_core.importing import importer
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import scene_file
from tests.support import foreign_runs as foreign
from tests.support.foreign_runs import T_MAX, Drawn

pytestmark = pytest.mark.heavy

KNOTS = 8
LATER = T_MAX + 0.1


def covariances(frame: scene_player.Frame) -> np.ndarray:
    """Of the Gaussians of a frame. [N, 3, 3]"""
    linear = foreign.matrices(torch.from_numpy(frame.quats).double()).numpy()
    linear = linear * np.exp(frame.log_scales.astype(np.float64))[:, None, :]
    return linear @ np.swapaxes(linear, 1, 2)


def assert_drawn(scene, t: float, expected: Drawn, mode: str = "rigid", tolerance: float = 1e-4) -> None:
    """Centres and covariances of the scene at a time are the expected ones."""
    frame = scene_player.Player(scene, mode).frame(t)
    np.testing.assert_allclose(frame.means, expected.means.numpy(), atol=tolerance)
    wanted = expected.covariances.numpy()
    size = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(covariances(frame) / size, wanted / size, atol=10 * tolerance)


def assert_pictured(scene, t: float, cloud, expected: Drawn, background: float, mode: str = "rigid") -> None:
    """The scene's picture is the one that the rule of its layout blends."""
    camera = scene.cameras[0]
    seen = scene_renderer.render_frame(
        scene, scene_player.Player(scene, mode).frame(t), camera, backend="reference"
    ).color
    wanted = foreign.picture(cloud, expected, camera, background)
    np.testing.assert_allclose(seen, wanted, atol=2e-3)
    assert wanted.std() > 0.05


def imported(folder, tmp_path, **options):
    """Import, write and read back without loss."""
    options.setdefault("still", 0.0)
    scene = importer.import_run(folder, importer.Options(**options))
    return scene_file.read(scene_file.write(scene, tmp_path / "scene.r5dgs", precision="exact"))


def test_a_run_of_gaussian_splatting_is_static(tmp_path):
    cloud = foreign.cloud()
    foreign.write_common(tmp_path / "run", cloud, 7000, "white_background=True, source_path='nowhere'")
    scene = imported(tmp_path / "run", tmp_path)
    assert scene.residuals is None and scene.dynamics is None
    assert [item.name for item in scene.objects] == ["background"]
    assert scene.world_convention == "colmap"
    assert len(scene.cameras) == 1  # the second entry is the same camera
    assert scene.provenance["imported"]["layout"] == "3D Gaussian Splatting"
    assert_drawn(scene, 0.0, foreign.resting(cloud), tolerance=1e-6)
    assert_pictured(scene, 0.0, cloud, foreign.resting(cloud), 1.0)


def test_gaussian_grouping_gives_objects_by_its_classifier(tmp_path):
    cloud, classes = foreign.cloud(identities=True), 256
    weight = torch.randn(classes, 16, 1, 1, generator=torch.Generator().manual_seed(3)).double()
    weight[6:] = 0  # six of the classes occur
    bias = torch.linspace(0.5, -0.5, classes).double()
    folder = tmp_path / "run"
    foreign.write_common(folder, cloud, 30000, "white_background=False, num_classes=256")
    foreign.write_weights(
        folder / "point_cloud" / "iteration_30000" / "classifier.pth", {"weight": weight, "bias": bias}
    )
    scene = imported(folder, tmp_path)
    labels = (cloud.identities @ weight[:, :, 0, 0].T + bias).argmax(1).numpy()
    assert len(set(labels.tolist())) > 3
    order = np.argsort(labels, kind="stable")
    np.testing.assert_array_equal(scene.gaussians.object_ids, labels[order])
    np.testing.assert_allclose(scene.gaussians.identities, cloud.identities.numpy()[order], rtol=1e-3, atol=1e-3)
    present = np.union1d(labels, [0])
    assert [item.name for item in scene.objects] == ["background", *(f"object {k}" for k in present if k > 0)]
    np.testing.assert_allclose(scene.classifier.weight, weight[present, :, 0, 0], atol=1e-7)
    again = (scene.gaussians.identities.astype(np.float32) @ scene.classifier.weight.T + scene.classifier.bias).argmax(
        1
    )
    assert (present[again] == scene.gaussians.object_ids).mean() > 0.9  # identities are kept as float16
    sorted_rule = foreign.resting(cloud)
    assert_drawn(scene, 0.0, Drawn(sorted_rule.means[order], sorted_rule.covariances[order]), tolerance=1e-6)
    assert_pictured(scene, 0.0, cloud, sorted_rule, 0.0)


@pytest.mark.default_cases("screws")
@pytest.mark.parametrize(
    ("inputs", "time", "screws"), [(93, 13, False), (84, 0, False), (93, 13, True)], ids=["blender", "real", "screws"]
)
def test_deformable_adds_rotations_and_scales(tmp_path, inputs, time, screws):
    cloud, weights = foreign.cloud(1), foreign.deform_weights(1, 256, 8, inputs, time=time, screws=screws)
    folder = tmp_path / "run"
    foreign.write_common(folder, cloud, 20000, f"is_blender={time > 0}, is_6dof={screws}, white_background=False")
    foreign.write_weights(folder / "deform" / "iteration_20000" / "deform.pth", weights)
    scene = imported(folder, tmp_path, knots=KNOTS)
    assert scene.t_max == 1.0 and scene.dynamics is None
    assert scene.world_convention == ("blender" if time else "colmap")
    times = scene.tracks.times
    moved = foreign.added(cloud, weights, times[0]).means - foreign.added(cloud, weights, times[-1]).means
    assert moved.norm(dim=1).min() > 0.01
    for t in times:
        assert_drawn(scene, t, foreign.added(cloud, weights, t))
    assert_pictured(scene, times[3], cloud, foreign.added(cloud, weights, times[3]), 0.0)


def test_deformable_does_not_normalise_its_rotations(tmp_path):
    cloud, weights = foreign.cloud(1), foreign.deform_weights(1, 256, 8, 93)
    moved, dq, ds = foreign.deform(weights, 8, 10, cloud.means, 0.0)
    quats = foreign.unit(cloud.quats) + dq
    lengths = quats.norm(dim=1)
    assert lengths.min() < 0.9 or lengths.max() > 1.1
    other = foreign.drawn(moved, foreign.unit(quats), cloud.log_scales.exp() + ds)
    folder = tmp_path / "run"
    foreign.write_common(folder, cloud, 20000, "is_blender=True")
    foreign.write_weights(folder / "deform" / "iteration_20000" / "deform.pth", weights)
    with pytest.raises(AssertionError):
        assert_drawn(imported(folder, tmp_path, knots=2), 0.0, other)


@pytest.mark.default_cases("complex")
@pytest.mark.parametrize("light", [True, False], ids=["light", "complex"])
def test_trace_rotates_before_the_canonical_rotation_and_extrapolates(tmp_path, light):
    cloud = foreign.cloud(2)
    deform = foreign.deform_weights(2, 256, 8, 81)
    width, hidden, bands = (128, 6, 3) if light else (256, 8, 6)
    velocity = foreign.velocity_weights(3, 4, width, hidden, 12, bands)
    folder = tmp_path / "run"
    foreign.write_common(folder, cloud, 40000, f"max_time={T_MAX}, light={light}", ("deform_code_0", "deform_code_1"))
    foreign.write_weights(folder / "deform" / "iteration_40000" / "deform.pth", deform | foreign.gate_weights())
    foreign.write_weights(folder / "deform" / "iteration_40000" / "vel.pth", velocity)
    scene = imported(folder, tmp_path, knots=KNOTS)
    assert scene.t_max == T_MAX and scene_player.available(scene, "standard")
    assert scene.world_convention == "blender" and scene.near_plane == 0.8

    def rule(t: float) -> Drawn:
        moved, turn, growth = foreign.deform(deform, 8, 8, cloud.means, min(t, T_MAX))
        at = torch.cat([moved, torch.full((len(moved), 1), T_MAX, dtype=torch.float64)], 1)
        rates = foreign.encoded(at, bands)
        names = ["0", *(f"{i + 2}.0" for i in range(hidden + 1))]
        for name in names:
            rates = foreign.affine(velocity, f"vel_net.weight_net.{name}", rates)
            rates = rates if name == names[-1] else torch.nn.functional.silu(rates)
        v, w, a, e = rates.split(3, dim=1)
        a, e = (x * x.abs() / 10 for x in (a, e))
        assert v.norm(dim=1).mean() > 0.2 and w.norm(dim=1).mean() > 0.2
        return foreign.twisted(cloud, moved, turn, growth, lambda tau: (v + a * tau, w + e * tau), t)

    for t in scene.tracks.times:
        assert_drawn(scene, t, rule(t))
    assert_drawn(scene, LATER, rule(LATER), "standard")
    assert (rule(LATER).means - rule(T_MAX).means).norm(dim=1).mean() > 0.02
    scene = importer.dataclasses.replace(scene, near_plane=0.2)  # nothing is nearer than that here
    assert_pictured(scene, scene.tracks.times[2], cloud, rule(scene.tracks.times[2]), 1.0)
    assert_pictured(scene, LATER, cloud, rule(LATER), 1.0, "standard")


def test_trace_with_codes_mixes_the_twists_of_motion_patterns(tmp_path):
    cloud, size = foreign.cloud(4), 16
    codes = foreign.code_weights(5, size)
    deform = foreign.deform_weights(6, 256, 8, 81 + size)
    velocity = foreign.velocity_weights(7, 1, 128, 6, 12 * size, 3)
    folder = tmp_path / "run" / "deform" / "iteration_40000"
    foreign.write_common(tmp_path / "run", cloud, 40000, f"max_time={T_MAX}, freegave=True, physics_code=16")
    for name, weights in {"deform": deform, "vel": velocity, "code_field": codes}.items():
        foreign.write_weights(folder / f"{name}.pth", weights)
    scene = imported(tmp_path / "run", tmp_path, knots=4)

    def rule(t: float) -> Drawn:
        code, shares = code_and_shares(codes, cloud)
        moved, turn, growth = foreign.deform(deform, 8, 8, cloud.means, min(t, T_MAX), code)
        raw = silu_row(velocity, foreign.encoded(torch.tensor([[T_MAX]]).double(), 3), 6).reshape(size, 4, 3)
        patterns = torch.cat([raw[:, :2], raw[:, 2:] * raw[:, 2:].abs() / 10], 1)
        v, w, a, e = torch.einsum("nk,kij->inj", shares, patterns)
        return foreign.twisted(cloud, moved, turn, growth, lambda tau: (v + a * tau, w + e * tau), t)

    for t in (*scene.tracks.times, LATER):
        assert_drawn(scene, t, rule(t), "standard")


def code_and_shares(weights, cloud):
    """Codes and shares of the motion patterns by ``code_field.pth``."""
    code = foreign.affine(weights, "output.0", foreign.trunk(weights, 4, foreign.encoded(cloud.means, 8)))
    hidden = torch.relu(foreign.affine(weights, "seg.0", code))
    return code, foreign.affine(weights, "seg.4", torch.relu(foreign.affine(weights, "seg.2", hidden)))


def silu_row(weights, x, hidden):
    """Output of ``vel.pth`` for encoded inputs."""
    names = ["0", *(f"{i + 2}.0" for i in range(hidden + 1))]
    for name in names:
        x = foreign.affine(weights, f"vel_net.weight_net.{name}", x)
        x = x if name == names[-1] else torch.nn.functional.silu(x)
    return x


@pytest.mark.default_cases("full")
@pytest.mark.parametrize(("width", "depth"), [(256, 8), (128, 6)], ids=["full", "light"])
def test_freegave_rotates_against_the_sign_of_its_weights(tmp_path, width, depth):
    cloud, size = foreign.cloud(8), 16
    codes = foreign.code_weights(9, size)
    deform = foreign.deform_weights(10, width, depth, 81 + size)
    velocity = foreign.velocity_weights(11, 1, 128, 4, 6 * size, 3)
    velocity["vel_net.a_weight_bank"] = torch.randn(size, 6, generator=torch.Generator().manual_seed(1)) / 4
    folder = tmp_path / "run" / "deform" / "iteration_40000"
    foreign.write_common(tmp_path / "run", cloud, 40000, f"max_time={T_MAX}, light={depth == 6}, physics_code=16")
    for name, weights in {"deform": deform, "vel": velocity, "code_field": codes}.items():
        foreign.write_weights(folder / f"{name}.pth", weights)
    scene = imported(tmp_path / "run", tmp_path, knots=KNOTS)
    assert scene_player.available(scene, "standard") and not scene_player.available(scene, "rigid_paper")

    def rule(t: float) -> Drawn:
        code, shares = code_and_shares(codes, cloud)
        moved, turn, growth = foreign.deform(deform, depth, 8, cloud.means, min(t, T_MAX), code)

        def rates(tau: float):  # evaluated again at every time
            patterns = silu_row(velocity, foreign.encoded(torch.tensor([[T_MAX + tau]]).double(), 3), 4)
            v, minus_w = (shares @ patterns.reshape(size, 6)).split(3, dim=1)
            return v, -minus_w

        assert rates(0.0)[1].norm(dim=1).mean() > 0.02
        return foreign.twisted(cloud, moved, turn, growth, rates, t)

    for t in scene.tracks.times:
        assert_drawn(scene, t, rule(t))
    near, far = T_MAX + 0.02, T_MAX + 0.04
    errors = [
        np.abs(scene_player.Player(scene, "standard").frame(t).means - rule(t).means.numpy()).max() for t in (near, far)
    ]
    assert errors[1] < 2e-4
    assert_drawn(scene, far, rule(far), "standard", 2e-4)
    scene = importer.dataclasses.replace(scene, near_plane=0.2)
    assert_pictured(scene, far, cloud, rule(far), 1.0, "standard")


def test_freegave_freezes_nearly_static_gaussians_at_time_zero(tmp_path):
    cloud, size = foreign.cloud(8), 16
    codes = foreign.code_weights(9, size)
    deform = foreign.deform_weights(10, 128, 6, 81 + size)
    deform["gaussian_warp.weight"] = 0.002 * deform["gaussian_warp.weight"]
    velocity = foreign.velocity_weights(11, 1, 128, 4, 6 * size, 3)
    velocity = {name: 0.05 * x if name.startswith("vel_net.weight_net.6") else x for name, x in velocity.items()}
    velocity["vel_net.a_weight_bank"] = torch.zeros(size, 6)
    folder = tmp_path / "run" / "deform" / "iteration_40000"
    foreign.write_common(tmp_path / "run", cloud, 40000, f"max_time={T_MAX}, light=True, physics_code=16")
    for name, weights in {"deform": deform, "vel": velocity, "code_field": codes}.items():
        foreign.write_weights(folder / f"{name}.pth", weights)
    scene = imported(tmp_path / "run", tmp_path, knots=4)
    assert scene.residuals is None or len(scene.residuals.rows) == 0
    assert (scene.dynamics.rates == 0).all()
    code, _ = code_and_shares(codes, cloud)
    moved, turn, growth = foreign.deform(deform, 6, 8, cloud.means, 0.0, code)
    assert_drawn(scene, 0.4, foreign.twisted(cloud, moved, turn, growth, None, 0.0))


def test_a_run_far_from_the_origin_keeps_its_stored_precision_and_gets_an_origin(tmp_path, caplog):
    shift = np.array([2.0**21, -(2.0**20), 0.0])
    cloud = foreign.cloud()
    far = dataclasses.replace(cloud, means=cloud.means + torch.from_numpy(shift))
    foreign.write_common(tmp_path / "run", far, 7000, "white_background=True, source_path='nowhere'")
    path = tmp_path / "run" / "cameras.json"
    rows = json.loads(path.read_text())
    path.write_text(json.dumps([{**row, "position": (np.array(row["position"]) + shift).tolist()} for row in rows]))
    scene = imported(tmp_path / "run", tmp_path)
    assert np.abs(scene.origin - shift).max() < 8 and np.abs(scene.gaussians.means).max() < 8
    stored = far.means.numpy().astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(scene.gaussians.means + scene.origin, stored, atol=1e-6)
    np.testing.assert_allclose(scene.cameras[0].center + scene.origin, foreign.view().center + shift, atol=1e-8)
    assert [record.getMessage() for record in caplog.records if "to 0.25 units" in record.getMessage()]
