"""The uncertainty of a path is shown as a tube with the half width of its 95 % band."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import confidence, models
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

NAMES = tuple(
    f"{name}.{axis}"
    for name in ("velocity", "acceleration", "angular_velocity", "angular_acceleration")
    for axis in "xyz"
)


@pytest.fixture
def scene():
    made = scenes.make_scene(n=300, objects=5, seed=1)
    spread = np.diag([0.04, 0.02, 0.03, 0.3, 0.2, 0.1, *[0.05] * 6]) ** 2
    groups = tuple(
        dataclasses.replace(g, model=dataclasses.replace(g.model, covariance=spread, covariance_names=NAMES))
        if g.role == "body" and g.model.kind != "static"
        else g
        for g in made.groups
    )
    return dataclasses.replace(made, groups=groups)


@pytest.fixture
def loaded(blender, scene, tmp_path):
    return motions.load_again(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))


def rings(tube):
    """Vertices of a tube by ring. [H, SIDES, 3]"""
    points = np.array([vertex.co for vertex in tube.data.vertices], np.float64)
    return points.reshape(-1, motions.addon("motion.confidence_tubes").SIDES, 3)


def test_a_tube_without_a_band_has_a_radius_of_two_standard_deviations(blender, scene, loaded):
    mug = blender.data.objects["mug anchor"]
    motions.choose(blender, mug)
    assert blender.ops.r5dgs.show_confidence() == {"FINISHED"}
    tube = mug.r5dgs_motion.tube
    assert tube.hide_render and tube.hide_select and tube.parent == mug.parent and tube.r5dgs.role == "NONE"
    found = rings(tube)
    tau = np.linspace(0, 1 - scenes.T_MAX, len(found))
    model, pivot = scene.groups[1].model, scene.groups[1].pivot
    _, displacements = models.evaluate(model, tau)
    np.testing.assert_allclose(found.mean(axis=1), pivot + displacements, atol=1e-5)
    radii = np.linalg.norm(found - found.mean(axis=1, keepdims=True), axis=-1)
    sigma = 2 * confidence.position_sigma(model, tau)
    grown = sigma > 0.01
    assert grown.any() and not grown[0]
    np.testing.assert_allclose(radii[grown], np.repeat(sigma[grown, None], radii.shape[1], 1), rtol=1e-4)
    colors = np.empty(4 * len(tube.data.vertices), np.float32)
    tube.data.attributes["confidence"].data.foreach_get("color", colors)
    red = colors.reshape(len(found), -1, 4)[:, 0, 0]
    assert (np.diff(red) >= 0).all() and red[-1] > red[0]


def test_without_a_selection_all_moving_objects_get_tubes_and_a_second_press_removes_them(blender, loaded):
    before = {kind: {d.name for d in getattr(blender.data, kind)} for kind in ("objects", "meshes", "materials")}
    motions.choose(blender, loaded.r5dgs.root)
    blender.ops.r5dgs.show_confidence()
    with_tubes = {o.name for o in loaded.all_objects if o.r5dgs_motion.tube}
    assert with_tubes == {f"{n} anchor" for n in ("mug", "red apple", "toy car", "lemon")}
    blender.ops.r5dgs.show_confidence()
    assert {kind: {d.name for d in getattr(blender.data, kind)} for kind in before} == before


def test_an_unreadable_path_prevents_all_tubes(blender, loaded):
    anchors = [obj for obj in loaded.all_objects if obj.r5dgs.role == "ANCHOR" and obj.r5dgs_motion.leader is None]
    blender.ops.r5dgs.show_confidence(action="SHOW")
    shown = [anchor for anchor in anchors if anchor.r5dgs_motion.tube is not None]
    blender.ops.r5dgs.show_confidence(action="HIDE")
    shown[-1].rotation_mode = "XYZ"
    with pytest.raises(RuntimeError, match=f"{shown[-1].name}.*Quaternion"):
        blender.ops.r5dgs.show_confidence(action="SHOW")
    assert len(shown) > 1 and not any(anchor.r5dgs_motion.tube for anchor in anchors)


def test_a_motion_that_takes_too_many_steps_is_refused_before_they_are_taken(blender, loaded, monkeypatch):
    mug = blender.data.objects["mug anchor"]
    motions.choose(blender, mug)
    mug.r5dgs_motion.kind = "world_twist"
    mug.r5dgs_motion.angular_velocity = (1e7, 0.0, 1e7)
    monkeypatch.setattr(confidence, "position_sigma", lambda *_: pytest.fail("integrated"))
    with pytest.raises(RuntimeError, match="mug anchor: moves too fast for a path"):
        blender.ops.r5dgs.show_confidence()
    assert mug.r5dgs_motion.tube is None


def test_a_selected_shadow_gets_a_tube(blender, loaded):
    shadow = blender.data.objects["mug shadow anchor"]
    motions.choose(blender, shadow)
    assert blender.ops.r5dgs.show_confidence() == {"FINISHED"}
    assert [o.name for o in loaded.all_objects if o.r5dgs_motion.tube] == [shadow.name]
    motions.choose(blender, loaded.r5dgs.root)
    blender.ops.r5dgs.show_confidence(action="HIDE")
    assert shadow.r5dgs_motion.tube is None


def test_the_tube_follows_edits_and_treats_edited_rates_as_exact(blender, loaded):
    apple = blender.data.objects["red apple anchor"]
    motions.choose(blender, apple)
    blender.ops.r5dgs.show_confidence()
    first = rings(apple.r5dgs_motion.tube)
    apple.r5dgs_motion.velocity = (3.0, 0.0, 0.0)
    apple.r5dgs_motion.acceleration = (0.0, 0.1, 0.0)
    blender.ops.r5dgs.re_extrapolate()
    second = rings(apple.r5dgs_motion.tube)
    assert np.linalg.norm(second.mean(axis=1)[-1] - first.mean(axis=1)[-1]) > 0.1

    def widths(found):
        return np.ptp(found, axis=1).max(axis=-1)

    assert widths(first)[-1] > 3 * widths(first)[0]
    np.testing.assert_allclose(widths(second), widths(second)[0], rtol=0.2)
    blender.ops.r5dgs.extrapolate_until(t_end=scenes.T_MAX)
    assert apple.r5dgs_motion.tube is None


def test_tubes_survive_saving(blender, loaded, tmp_path):
    motions.choose(blender, blender.data.objects["mug anchor"])
    blender.ops.r5dgs.show_confidence()
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    mug = blender.data.objects["mug anchor"]
    motions.choose(blender, mug)
    assert mug.r5dgs_motion.tube is not None
    blender.ops.r5dgs.show_confidence(action="HIDE")
    assert mug.r5dgs_motion.tube is None and not blender.data.meshes.get("mug confidence")


def test_showing_confidence_without_motion_reports_that_nothing_moves(blender, loaded, capfd):
    motions.choose(blender, blender.data.objects["wooden block anchor"])
    assert blender.ops.r5dgs.show_confidence() == {"CANCELLED"}
    assert "Nothing moves" in capfd.readouterr().out
