"""The table of objects: each number follows its definition, and names are shown unchanged."""

import dataclasses
import io
import json

import numpy as np
import pytest
from rich.console import Console

from r5dgs_core.evaluation import evaluate, object_table
from r5dgs_core.motion.history import Band, Event, History, PoseErrors
from r5dgs_core.scene import motion_words
from tests.support import pictures

BACKEND = pictures.BACKEND


def shown(scene, rows, width=100):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(object_table.table(scene, rows, 2))
    return console.export_text()


def test_pixels_are_those_of_the_id_maps_and_overlap_with_own_masks_is_whole(scene, data):
    views = [*data.val, *data.test]
    rows = object_table.measure(scene, views, backend=BACKEND)
    assert [row.id for row in rows] == [item.id for item in scene.objects]
    maps = [evaluate.render(scene, view.camera, view.t, backend=BACKEND).ids for view in views]
    for row in rows:
        assert row.pixels == pytest.approx(np.mean([(ids == row.id).sum() for ids in maps]))
        assert row.views == sum((ids == row.id).any() for ids in maps)
        assert row.gaussians == (scene.gaussians.object_ids == row.id).sum()
        assert row.iou == (1.0 if row.id >= 0 else None)
    assert sum(row.pixels for row in rows) == pytest.approx(pictures.WIDTH * pictures.HEIGHT)


def test_own_views_use_every_camera_and_times_from_the_whole_range(scene):
    views = object_table.own_views(scene)
    assert [view.camera for view in views] == list(scene.cameras)
    many = object_table.own_views(dataclasses.replace(scene, cameras=scene.cameras * 50))
    assert len(many) == object_table.MAX_VIEWS
    times = np.sort([view.t for view in many])
    assert times[0] >= 0 and times[-1] <= scene.t_max and np.diff(times).max() < 0.1 * scene.t_max
    assert {view.camera.name for view in object_table.own_views(dataclasses.replace(scene, cameras=()))} == {"overview"}


def test_confidence_is_the_mean_probability_of_the_label_by_opacity(scene):
    classes = [item.id for item in scene.objects if item.id >= 0]
    codes = np.zeros((len(scene.gaussians.means), 16), np.float16)
    rows = scene.gaussians.object_ids >= 0
    codes[rows, [classes.index(i) for i in scene.gaussians.object_ids[rows]]] = 1
    weight = np.zeros((len(classes), 16), np.float32)
    weight[:, : len(classes)] = 3 * np.eye(len(classes))
    coded = scene.with_arrays(
        identities=codes, classifier_weight=weight, classifier_bias=np.zeros(len(classes), np.float32)
    )
    sure = np.exp(3) / (np.exp(3) + len(classes) - 1)
    assert object_table.confidences(coded) == pytest.approx(dict.fromkeys(classes, sure))
    mine = np.flatnonzero(scene.gaussians.object_ids == 2)
    wrong = codes.copy()
    wrong[mine[0]] = np.roll(wrong[mine[0]], 1)
    opacities = 1 / (1 + np.exp(-scene.gaussians.opacity_logits[mine].astype(np.float64)))
    share = opacities[0] / opacities.sum()
    other = 1 / (np.exp(3) + len(classes) - 1)
    found = object_table.confidences(coded.with_arrays(identities=wrong))
    assert found[2] == pytest.approx((1 - share) * sure + share * other) and found[1] == pytest.approx(sure)


def test_without_encodings_there_is_no_confidence(scene):
    assert object_table.confidences(scene.with_arrays(identities=None)) == {}
    rows = object_table.measure(scene.with_arrays(identities=None), object_table.own_views(scene)[:1])
    assert all(row.confidence is None for row in rows)
    assert "stores no identity encodings" in " ".join(shown(scene, rows).split())


def test_strays_move_with_another_object_than_they_show(scene):
    assert object_table.strays(scene) == {}  # the shadow is background that follows its caster
    ids = scene.gaussians.motion_ids.copy()
    mine = np.flatnonzero(scene.gaussians.object_ids == 2)
    floor = np.flatnonzero((scene.gaussians.object_ids == 0) & (scene.gaussians.motion_ids == 0))
    ids[mine[:4]], ids[mine[4:6]], ids[floor[:3]] = 1, 0, 3
    assert object_table.strays(scene.with_arrays(motion_ids=ids)) == {0: 3, 2: 6}
    still = dataclasses.replace(scene.with_arrays(motion_ids=np.zeros_like(ids)), groups=scene.groups[:1])
    assert object_table.strays(still) == {}  # nothing has a group of its own: all rest, as they should


def test_motion_is_named_as_in_the_sidebar(scene):
    words = {row.id: row.motion for row in object_table.measure(scene, [])}
    assert words[0] == "pinned" and words[1] == "throw+spin" and words[2] == "slide" and words[3] == "screw"
    group = dataclasses.replace(scene.groups[1], model=dataclasses.replace(scene.groups[1].model, kind="static"))
    assert motion_words.motion_of(scene, [group]) == "rests"
    for share, word in ((0.8, "still"), (1.2, "rests")):
        poses = scene.tracks.poses.copy()
        poses[1] = [1, 0, 0, 0, 0, 0, 0]
        poses[1, 0, 4] = share * motion_words.STILL * group.model.radius
        noisy = scene.with_arrays(track_poses=poses)
        assert motion_words.motion_of(noisy, [group]) == word


def test_the_residual_is_a_share_of_the_radius_and_absent_if_nothing_bends(scene):
    groups = [dataclasses.replace(group, rigid_rms=0.0, rigid_max=0.0) for group in scene.groups]
    exact = dataclasses.replace(scene, groups=tuple(groups))
    rows = object_table.measure(exact, [])
    assert all(row.rigid_rms is None for row in rows) and "no residual" in " ".join(shown(exact, rows).split())
    groups[2] = dataclasses.replace(groups[2], rigid_rms=0.03, rigid_max=0.1)
    bent = dataclasses.replace(scene, groups=tuple(groups))
    found = {row.id: row.rigid_rms for row in object_table.measure(bent, [])}
    assert found[2] == pytest.approx(0.03 / groups[2].model.radius) and found[1] is None
    assert "10 %" in shown(bent, object_table.measure(bent, []))


def test_names_are_shown_unchanged_and_json_is_valid(scene):
    odd = tuple(
        dataclasses.replace(item, name="[red] mug", aliases=("cup",)) if item.id == 1 else item
        for item in scene.objects
    )
    named = dataclasses.replace(scene, objects=odd, provenance={"regrouping": {"moving": 90, "to_bodies": 7}})
    rows = object_table.measure(named, [])
    text = shown(named, rows)
    assert "[red] mug, cup" in text and "7 of 90 moving Gaussians" in " ".join(text.split())
    found = object_table.to_json(named, rows, 0)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["hygiene"] == {"moving": 90, "to_bodies": 7} and found["objects"][2]["aliases"] == ["cup"]
    assert object_table.to_json(scene, rows, 0)["hygiene"] is None


def test_errors_of_poses_and_the_confidence_of_predictions_are_a_second_table(scene):
    assert object_table.outlook_table(scene, object_table.measure(scene, [])) is None
    band = Band((scene.t_max, 2 * scene.t_max), (0.1, 0.1), (0.1, 0.1), predictable_until=0.85)
    found = History((Event(0.55, "impact", 0.01),), (), band, PoseErrors((0.01, 0.02), (0.01, 0.05)))
    groups = [dataclasses.replace(g, history=found) if g.id == 1 else g for g in scene.groups]
    hit = dataclasses.replace(scene, groups=tuple(groups))
    rows = object_table.measure(hit, [])
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(object_table.outlook_table(hit, rows))
    text = console.export_text()
    assert "1.7°, worst 2.9°" in text and "± 0.1" in text and "not predictable past 0.85 (hit at 0.55)" in text
    shown = object_table.to_json(hit, rows, 0)
    assert json.loads(json.dumps(shown, allow_nan=False)) == shown
    mug, other = shown["objects"][2], shown["objects"][3]
    assert mug["warning"] == found.warning() and mug["half_width"] == pytest.approx(0.1)
    assert set(mug["rotation_error_deg"]) == {"median", "worst"}
    assert other["warning"] is None and other["half_width"] is None and other["position_error_percent"] is None


def test_the_table_fits_a_narrow_terminal(scene, data):
    rows = object_table.measure(scene, data.val, backend=BACKEND)
    assert all(len(line) <= 80 for line in shown(scene, rows, width=80).splitlines())
    assert "throw+spin" in shown(scene, rows, width=80)


def test_a_narrow_terminal_shows_names_and_whole_warnings(scene, data):
    band = Band((scene.t_max, 2 * scene.t_max), (0.1, 0.1), (0.1, 0.1), predictable_until=0.96)
    found = History((Event(0.25, "start", 0.01), Event(0.55, "impact", 0.01)), (), band)
    groups = [dataclasses.replace(g, history=found) if g.id == 1 else g for g in scene.groups]
    hit = dataclasses.replace(scene, groups=tuple(groups))
    rows = object_table.measure(hit, data.val, backend=BACKEND)
    lines = shown(hit, rows, width=80).splitlines()
    assert all(len(line) <= 80 for line in lines)
    words, text = " ".join(lines).split(), found.text().replace(" ", "")
    assert {"id", "name", "motion", "strays", "IoU", "mug,", "apple,", "car,"} <= {*words}
    start, end = lines[2].index("motion"), lines[2].index("bends") - 1
    assert text in "".join(line[start:end].strip() for line in lines).replace(" ", "")
