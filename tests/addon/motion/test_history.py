"""Observed events and confidence bands in Blender: markers, panel and tubes."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion.history import Band, Event, History, PoseErrors, Segment
from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, scenes

RATES = {name: (0.0, 0.0, 0.0) for name in ("velocity", "acceleration", "angular_velocity")}
FLIGHT = {"velocity": (0.5, 0.0, 0.0), "acceleration": (0.0, 0.0, -10.0), "angular_velocity": (0.0, 2.0, 0.0)}
BAND = Band((scenes.T_MAX, 0.9, 1.2), (0.02, 0.1, 0.7), (0.1, 0.2, 0.3), predictable_until=0.95)
HISTORY = History(
    (Event(0.2, "start", 0.0001), Event(0.5, "impact", 0.01)),
    (
        Segment(0.0, 0.2, "static", RATES),
        Segment(0.2, 0.5, "ballistic_spin", FLIGHT),
        Segment(0.5, scenes.T_MAX, "translation", {**RATES, "velocity": (0.0, -1.0, 0.0)}),
    ),
    BAND,
)


@pytest.fixture
def scene_path(tmp_path):
    made = scenes.make_scene(n=300, objects=3, seed=1)
    groups = (made.groups[0], dataclasses.replace(made.groups[1], history=HISTORY), *made.groups[2:])
    return scene_file.write(dataclasses.replace(made, groups=groups), tmp_path / "scene.r5dgs")


def markers(bpy):
    return sorted((marker.frame, marker.name) for marker in bpy.context.scene.timeline_markers)


def test_events_are_marked_on_the_timeline_once(blender, loaded):
    name = blender.data.objects["mug anchor"].name.removesuffix(" anchor")
    expected = [(13, f"{name}: start"), (31, f"{name}: impact"), (46, "t_max")]
    assert markers(blender) == expected
    blender.context.scene.timeline_markers.new("mine", frame=31)
    assert blender.ops.r5dgs.fit_timeline() == {"FINISHED"}
    assert markers(blender) == sorted([*expected, (31, "mine")])
    blender.context.scene.timeline_markers.remove(blender.context.scene.timeline_markers[f"{name}: impact"])
    blender.ops.r5dgs.fit_timeline()
    assert markers(blender) == sorted([*expected, (31, "mine")])


def test_markers_follow_a_renamed_object(blender, loaded):
    scene = blender.context.scene
    scene.timeline_markers.new("mine: start", frame=5)
    blender.data.objects["mug anchor"].name = "cup anchor"
    blender.context.view_layer.update()
    expected = [(5, "mine: start"), (13, "cup: start"), (31, "cup: impact"), (46, "t_max")]
    assert markers(blender) == expected
    blender.ops.r5dgs.fit_timeline()
    assert markers(blender) == expected


def test_a_moved_marker_belongs_to_the_user(blender, loaded):
    scene = blender.context.scene
    scene.timeline_markers["mug: impact"].frame = 33
    blender.data.objects["mug anchor"].name = "cup anchor"
    blender.context.view_layer.update()
    expected = [(13, "cup: start"), (33, "mug: impact"), (46, "t_max")]
    assert markers(blender) == expected
    blender.ops.r5dgs.fit_timeline()
    assert markers(blender) == sorted([*expected, (31, "cup: impact")])


def test_two_scenes_have_markers_of_their_own_which_go_with_them(blender, loaded, scene_path, tmp_path):
    first = markers(blender)
    name = motions.load(blender, scene_path).name
    added = [(13, "mug.001: start"), (31, "mug.001: impact")]
    assert markers(blender) == sorted([*first, *added])
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    second = blender.data.collections[name]
    blender.data.batch_remove([*second.all_objects, *second.children_recursive, second])
    blender.context.view_layer.update()
    assert markers(blender) == first
    blender.ops.r5dgs.fit_timeline()
    assert markers(blender) == first


def test_a_changed_motion_replaces_the_markers_of_its_scene(blender, loaded, mug):
    import json

    learned = json.loads(mug.r5dgs_motion.learned)
    learned["history"]["events"][1]["time"] = 0.6
    mug.r5dgs_motion.learned = json.dumps(learned)
    event_markers = motions.addon("motion.event_markers")
    assert not event_markers.shown(blender.context.scene, loaded)
    blender.ops.r5dgs.fit_timeline()
    assert markers(blender) == [(13, "mug: start"), (37, "mug: impact"), (46, "t_max")]
    assert event_markers.shown(blender.context.scene, loaded)


def test_panels_parse_a_history_once(blender, mug, monkeypatch):
    physics = motions.addon("motion.physics")
    monkeypatch.setattr(physics.json_row, "Row", lambda *_: pytest.fail("parsed again"))
    physics._history.cache_clear()
    with pytest.raises(pytest.fail.Exception):
        physics.history(mug)
    monkeypatch.undo()
    found = physics.history(mug)
    monkeypatch.setattr(physics.json_row, "Row", lambda *_: pytest.fail("parsed again"))
    assert physics.history(mug) is found


def test_no_event_is_marked_if_the_timeline_is_kept(blender, scene_path):
    motions.load(blender, scene_path, fit_timeline=False)
    assert markers(blender) == []


def test_a_learned_motion_has_a_tube_as_wide_as_its_band_and_an_edited_one_has_not(blender, mug):
    tubes, physics = motions.addon("motion.confidence_tubes"), motions.addon("motion.physics")
    times = motions.addon("motion.extrapolate").times_of(mug)
    _, widths = tubes.path(mug, times)
    at = times.t_max + np.linspace(0, times.t_end - times.t_max, len(widths))
    np.testing.assert_allclose(widths, np.interp(at, BAND.times, BAND.half_width))
    mug.r5dgs_motion.velocity = (5, 0, 0)
    assert physics.band(mug) is None
    _, edited = tubes.path(mug, times)
    assert not np.allclose(edited, widths)
    blender.ops.r5dgs.reset_motion()
    assert physics.band(mug) == BAND


def test_history_is_kept_by_saving_and_missing_in_older_files(blender, mug, tmp_path):
    import json

    physics = motions.addon("motion.physics")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    mug = blender.data.objects["mug anchor"]
    assert physics.history(mug) == HISTORY
    learned = json.loads(mug.r5dgs_motion.learned)
    del learned["history"]
    mug.r5dgs_motion.learned = json.dumps(learned)
    assert physics.history(mug) == History() and physics.band(mug) is None
    learned["history"] = {"events": [{"time": 0.1, "kind": "unknown to this version", "sigma": 0}]}
    mug.r5dgs_motion.learned = json.dumps(learned)
    assert physics.history(mug) == History()


def test_the_panel_lists_segments_and_events_and_warns_until_the_motion_is_edited(blender, mug):
    panel = motions.addon("panels.motion").R5DGS_PT_motion
    observed = motions.addon("panels.observed_motion").R5DGS_PT_observed_motion
    motions.choose(blender, mug)
    assert observed.poll(blender.context)
    listed = layouts.draw(blender, observed)
    expected = ["1 to 13: Still", "Frame 13.0: start", "13 to 31: Throw and Spin"]
    expected += ["moves at 0.2 m/s", "accelerates by 1.6 m/s²", "turns by 45.8°/s"]
    expected += ["Frame 31.0 ± 0.6: impact", "31 to 46: Slide", "moves at 0.4 m/s"]
    assert listed[:-1] == expected
    for drawn in (str(layouts.draw(blender, panel)), listed[-1]):
        assert "Not predictable past 0.95 (hit at 0.50)" in drawn
    mug.r5dgs_motion.velocity = (5, 0, 0)
    assert "Not predictable" not in str(layouts.draw(blender, panel))
    assert layouts.draw(blender, observed) == expected


def test_the_list_of_objects_and_loading_warn_of_motion_that_is_not_predictable(blender, scene_path, capfd):
    collection = motions.load(blender, scene_path)
    assert "mug: not predictable past 0.95 (hit at 0.50)" in capfd.readouterr().out
    lists = motions.addon("panels.objects")
    texts = {}
    for entry in collection.r5dgs.table:
        said = texts.setdefault(entry.label, [])
        layout = layouts.Layout(blender, said)
        lists.R5DGS_UL_objects.draw_item(None, blender.context, layout, None, entry, 0, None, "")
    assert [name for name, said in texts.items() if "r5dgs.explain_warning" in said] == ["mug"]
    mug = next(entry.object_id for entry in collection.r5dgs.table if entry.label == "mug")
    assert blender.ops.r5dgs.explain_warning(object_id=mug) == {"FINISHED"}
    blender.data.objects["mug anchor"].r5dgs_motion.velocity = (5, 0, 0)
    assert blender.ops.r5dgs.explain_warning(object_id=mug) == {"CANCELLED"}


def test_a_motion_that_is_predictable_up_to_the_last_key_has_no_warning(blender, mug):
    warnings = motions.addon("motion.warnings")
    for end, warning in ((0.94, ""), (1.2, "not predictable past 0.95 (hit at 0.50)")):
        assert blender.ops.r5dgs.extrapolate_until(t_end=end) == {"FINISHED"}
        assert warnings.of_anchor(mug) == warning


def test_the_panel_shows_the_errors_of_the_observed_poses(blender, tmp_path):
    made = scenes.make_scene(n=300, objects=3, seed=1)
    errors = History(errors=PoseErrors((0.01, 0.01, 0.02), (0.01, 0.02, np.inf)))
    groups = (made.groups[0], dataclasses.replace(made.groups[1], history=errors), *made.groups[2:])
    motions.load(blender, scene_file.write(dataclasses.replace(made, groups=groups), tmp_path / "scene.r5dgs"))
    motions.choose(blender, blender.data.objects["mug anchor"])
    panel = motions.addon("panels.observed_motion").R5DGS_PT_observed_motion
    assert panel.poll(blender.context)
    shown = layouts.draw(blender, panel)
    assert shown[0] == "Rotation error: 0.86°, worst 1.1°" and shown[1].startswith("Position error: ")


def test_an_object_without_events_has_no_panel_of_segments(blender, loaded):
    motions.choose(blender, blender.data.objects["red apple anchor"])
    assert not motions.addon("panels.observed_motion").R5DGS_PT_observed_motion.poll(blender.context)


def test_numbers_out_of_range_are_named_in_the_panel(blender, mug):
    panel, state = motions.addon("panels.motion").R5DGS_PT_motion, mug.r5dgs_motion
    motions.choose(blender, mug)
    state.kind = "bounce"
    state.restitution = 1.5
    message = "Restitution: takes numbers from 0 to 1, so 1.5 became 1"
    assert state.restitution == 1.0 and message in " ".join(layouts.draw(blender, panel))
    state.bounce_time = -0.2
    assert "Next Bounce: takes numbers >= 0, so -0.2 became 0" in " ".join(layouts.draw(blender, panel))
    state.restitution = 0.5
    assert state.clamped == ""
    state.damping = -1.0
    state.velocity = (1.0, 0.0, 0.0)
    assert state.clamped == ""
