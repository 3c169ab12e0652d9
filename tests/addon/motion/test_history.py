"""Observed events and confidence bands in Blender: markers, panel and tubes."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion.history import Band, Event, History, Segment
from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, scenes

RATES = {name: (0.0, 0.0, 0.0) for name in ("velocity", "acceleration", "angular_velocity")}
BAND = Band((scenes.T_MAX, 0.9, 1.2), (0.02, 0.1, 0.7), (0.1, 0.2, 0.3), predictable_until=0.95)
HISTORY = History(
    (Event(0.2, "start", 0.01), Event(0.5, "impact", 0.01)),
    tuple(Segment(a, b, "static", RATES) for a, b in ((0.0, 0.2), (0.2, 0.5), (0.5, scenes.T_MAX))),
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


def test_the_panel_lists_events_and_warns_until_the_motion_is_edited(blender, mug):
    panel = motions.addon("panels.motion").R5DGS_PT_motion
    drawn = str(layouts.draw(blender, panel))
    assert "Set off at 0.20" in drawn and "Hit at 0.50" in drawn and "Not predictable past 0.95" in drawn
    mug.r5dgs_motion.velocity = (5, 0, 0)
    drawn = str(layouts.draw(blender, panel))
    assert "Hit at 0.50" in drawn and "Not predictable" not in drawn
