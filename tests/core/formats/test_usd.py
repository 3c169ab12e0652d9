"""OpenUSD files, read back by pxr and, at t_max, by the package fourdgs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.cli import main
from r5dgs_core.formats import registry, usd
from r5dgs_core.motion import history, rotations
from r5dgs_core.playback import played_splats
from r5dgs_core.playback.scene_player import Player
from r5dgs_core.scene import scene_file, spherical_harmonics
from r5dgs_core.scene.scene import Residuals
from r5dgs_core.scene.units import Units
from tests.support import arms, scenes
from tests.support.command_line import complaint

pxr = pytest.importorskip("pxr", reason="usd-core is not installed; it comes with the extra 'usd'")

OPTIONS = registry.Options((0.0,), until=1.3)
TIMES = (0.0, 0.021, 0.333, scenes.T_MAX, 0.79, 0.97, 1.21)
Z_UP = {
    "blender": np.eye(3),
    "colmap": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "opengl": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
}


def written(scene, tmp_path, options=OPTIONS):
    from pxr import Usd

    (path,) = usd.export(scene, tmp_path / "scene.usd", options)
    return Usd.Stage.Open(str(path))


def splats(stage, scene, t):
    """Object, group, world matrix and arrays of each prim with Gaussians at a scene time."""
    from pxr import Usd, UsdGeom, UsdVol

    when = Usd.TimeCode(1 + t * scene.frames_per_unit)
    cache = UsdGeom.XformCache(when)
    for prim in stage.Traverse():
        if prim.IsA(UsdVol.ParticleField3DGaussianSplat):
            field = UsdVol.ParticleField3DGaussianSplat(prim)
            matrix = np.array(cache.GetLocalToWorldTransform(prim)).T
            quats = np.array(field.GetOrientationsAttr().Get(when))[:, [3, 0, 1, 2]]
            own = [
                np.array(attribute.Get(when))
                for attribute in (field.GetPositionsAttr(), field.GetScalesAttr(), field.GetOpacitiesAttr())
            ]
            sh = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(len(quats), -1, 3)
            key = prim.GetCustomDataByKey("r5dgs:object"), prim.GetParent().GetCustomDataByKey("r5dgs:group")
            yield key, matrix, quats, sh, *own


def bent(scene):
    """The scene with residuals of some Gaussians of group 1."""
    rng = np.random.default_rng(0)
    rows = np.flatnonzero(scene.gaussians.motion_ids == 1)[:7].astype(np.int32)
    shape = (len(rows), len(scene.tracks.times))
    offsets, growths = (rng.normal(scale=0.05, size=(*shape, 3)).astype(np.float32) for _ in range(2))
    turns = rotations.rotvecs_to_quats(rng.normal(scale=0.2, size=(*shape, 3))).astype(np.float32)
    offsets[:, -1], growths[:, -1], turns[:, -1] = 0, 0, [1, 0, 0, 0]
    return dataclasses.replace(scene, residuals=Residuals(rows, offsets, turns, growths))


@pytest.mark.parametrize(
    "scene",
    [
        scenes.make_scene(n=400, objects=5, seed=3),
        scenes.make_scene(n=300, objects=2, sh_degree=3, world_convention="colmap"),
        scenes.make_scene(n=100, objects=0, world_convention="opengl", shading=False),
        arms.make_arm("hinge"),
        arms.make_arm("slider"),
    ],
    ids=["bodies", "harmonics", "static", "hinge", "slider"],
)
def test_prims_move_the_gaussians_as_playback_does(scene, tmp_path):
    stage, shown, up = written(scene, tmp_path), Player(scene), np.array(Z_UP[scene.world_convention])
    frozen = played_splats.at(shown, scene.t_max).sh
    for t in TIMES:
        frame, seen = shown.frame(t), 0
        for (object_id, group), world, quats, sh, means, scales, opacities in splats(stage, scene, t):
            rows = (scene.gaussians.object_ids == object_id) & (scene.gaussians.motion_ids == group)
            places = means @ world[:3, :3].T + world[:3, 3]
            np.testing.assert_allclose(places, frame.means[rows] @ up.T, atol=3e-5 * scene.extent)
            wanted = up @ rotations.quats_to_rotmats(frame.quats[rows].astype(float))
            found = world[:3, :3] @ rotations.quats_to_rotmats(quats.astype(float))
            np.testing.assert_allclose(found, wanted, atol=4e-4)
            np.testing.assert_allclose(scales, np.exp(frame.log_scales[rows]), rtol=1e-5)
            np.testing.assert_allclose(opacities, 1 / (1 + np.exp(-frame.opacity_logits[rows])), rtol=1e-5)
            np.testing.assert_allclose(sh, frozen[rows], atol=1e-6)
            seen += len(means)
        assert seen == len(scene.gaussians.means)


def test_bending_gaussians_have_time_samples(tmp_path):
    scene = bent(scenes.make_scene(n=200, objects=2))
    stage = written(scene, tmp_path)
    for t in scene.tracks.times:
        frame = Player(scene).frame(t)
        found = [one for one in splats(stage, scene, t) if one[0] == (1, 1)]
        world = np.stack([one[1] for one in found])
        means, scales = (np.concatenate([one[k] for one in found]) for k in (4, 5))
        assert len(found) == 2 and np.ptp(world, axis=0).max() == 0
        rows = np.flatnonzero(scene.gaussians.motion_ids == 1)
        order = np.concatenate([rows[7:], rows[:7]])
        places = means @ world[0, :3, :3].T + world[0, :3, 3]
        np.testing.assert_allclose(places, frame.means[order], atol=3e-5 * scene.extent)
        np.testing.assert_allclose(scales, np.exp(frame.log_scales[order]), rtol=1e-4)


def test_an_impact_is_a_key(tmp_path):
    from r5dgs_core.motion import models

    scene = scenes.make_scene(n=200, objects=1, shadows=False)
    rates = {"velocity": [0.3, 0, -1.0], "acceleration": [0, 0, -6.0], "bounce_time": 0.08, "restitution": 0.7}
    group = dataclasses.replace(scene.groups[1], model=models.MotionModel("bounce", **rates, radius=0.3))
    scene = dataclasses.replace(scene, groups=(scene.groups[0], group))
    stage = written(scene, tmp_path)
    samples = stage.GetPrimAtPath("/synthetic/mug").GetAttribute("xformOp:translate").GetTimeSamples()
    assert min(abs(code - usd.code(scene, scene.t_max + 0.08)) for code in samples) < 1e-6


def test_cameras_have_the_lens_of_the_scene(scene, tmp_path):
    from pxr import UsdGeom

    cx = scene.cameras[0].intrinsics.copy()
    cx[:2, 2] += [5.0, -3.0]
    scene = dataclasses.replace(scene, cameras=(dataclasses.replace(scene.cameras[0], intrinsics=cx),))
    stage = written(scene, tmp_path)
    (prim,) = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    frustum = UsdGeom.Camera(prim).GetCamera(0).frustum
    view, projection = (np.array(m) for m in (frustum.ComputeViewMatrix(), frustum.ComputeProjectionMatrix()))
    points, camera = scene.gaussians.means[:50].astype(float), scene.cameras[0]
    clip = np.concatenate([points, np.ones((50, 1))], axis=1) @ view @ projection
    ndc = clip[:, :2] / clip[:, 3:]
    pixels = (ndc * [1, -1] + 1) / 2 * [camera.width, camera.height]
    seen = points @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    wanted = seen @ camera.intrinsics.T
    np.testing.assert_allclose(pixels, wanted[:, :2] / wanted[:, 2:], atol=1e-3)


def test_units_names_and_bands_are_kept(tmp_path):
    from pxr import UsdGeom

    band = history.Band((scenes.T_MAX, 1.0), (0.0, 0.1), (0.0, 0.2))
    scene = scenes.make_scene(n=100, objects=1)
    group = dataclasses.replace(scene.groups[1], history=history.History(band=band))
    scene = dataclasses.replace(scene, groups=(scene.groups[0], group, *scene.groups[2:]), units=Units(2.0, 0.4))
    stage = written(scene, tmp_path)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.4 and stage.GetTimeCodesPerSecond() == 30
    assert stage.GetRootLayer().customLayerData["r5dgs"]["t_max"] == scene.t_max
    prim = stage.GetPrimAtPath("/synthetic/mug")
    assert prim.GetDisplayName() == "mug" and prim.GetAttribute("r5dgs:bandHalfWidth").Get(61) == pytest.approx(0.1)
    assert prim.GetCustomDataByKey("r5dgs:bandLevel") == 0.95


def test_another_library_reads_the_gaussians_of_t_max(tmp_path):
    fourdgs = pytest.importorskip("fourdgs", reason="fourdgs is not installed; it comes with the extra 'export'")
    scene = scenes.make_scene(n=150, objects=2)
    written(scene, tmp_path)
    found = fourdgs.from_usd(str(tmp_path / "scene.usd")).gaussians
    wanted = Player(scene).frame(scene.t_max)
    order = np.argsort(found.positions[:, 0]), np.argsort(wanted.means[:, 0])
    np.testing.assert_allclose(found.positions[order[0]], wanted.means[order[1]], atol=1e-4)
    rgb = spherical_harmonics.dc_to_rgb(played_splats.at(Player(scene), scene.t_max).sh[:, 0]).clip(0, 1)
    np.testing.assert_allclose(found.colors[order[0], :3].clip(0, 1), rgb[order[1]], atol=1e-3)


def test_losses_are_told_and_errors_leave_no_file(scene, tmp_path, capsys, monkeypatch):
    source = scene_file.write(scene, tmp_path / "a.r5dgs")
    out = tmp_path / "out"
    out.mkdir()
    arguments = ["export", str(source), "--to", "usd", "--out", str(out / "a.usd")]
    assert main.main(arguments) == 0
    said = capsys.readouterr().out
    assert "not kept: changing shading" in said and "lost here: the sky" in said
    assert "the file exists" in complaint(capsys, *arguments)
    with pytest.raises(errors.ConfigError, match="expected Gaussians to export"):
        written(scene, out, registry.Options((0.0,), object_ids=frozenset({77})))
    with pytest.raises(errors.SceneFileError, match="cannot be written"):
        list(usd.export(scene, out / "missing" / "a.usd", OPTIONS))
    assert [p.name for p in out.iterdir()] == ["a.usd"]
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install 'r5dgs[usd]'" in complaint(capsys, *arguments, "--overwrite")


def test_absent_objects_are_invisible_but_not_what_they_carry(tmp_path):
    from pxr import Usd, UsdGeom

    arm = arms.make_arm("hinge")
    root = next(group.parent for group in arm.groups if group.parent is not None)
    groups = [dataclasses.replace(one, absent=((-np.inf, 0.1), (0.3, 0.4)) * (one.id == root)) for one in arm.groups]
    stage = written(dataclasses.replace(arm, groups=tuple(groups)), tmp_path)
    prims = [prim for prim in stage.Traverse() if prim.GetCustomDataByKey("r5dgs:object") is not None]
    own = [prim for prim in prims if prim.GetParent().GetCustomDataByKey("r5dgs:group") == root]
    assert own and len(own) < len(prims)
    for t, there in ((-1.0, False), (0.0, False), (0.12, True), (0.3, False), (0.39, False), (0.41, True), (1.2, True)):
        when = Usd.TimeCode(usd.code(arm, t))
        shown = [UsdGeom.Imageable(prim).ComputeVisibility(when) == "inherited" for prim in prims]
        assert shown == [there or prim not in own for prim in prims], t
    assert not any(prim.GetAttribute("visibility").HasAuthoredValue() for prim in prims if prim not in own)
