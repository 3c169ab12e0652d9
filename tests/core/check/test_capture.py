"""Faults of a capture are found one by one, each with a picture, and a sound capture has none."""

import re
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import check
from r5dgs_core.check import codes
from r5dgs_core.check.capture import agreement, arrangement
from r5dgs_core.data import images
from tests.core.check.test_check import CASES, assert_found
from tests.support import captures, recordings


def test_a_sound_capture_with_masks_has_no_findings(tmp_path):
    root = captures.make(tmp_path / "data", masks=lambda rig, camera, t: captures.ball_mask(rig.cameras[camera], t))
    assert [str(finding) for finding in check.check(root, tmp_path / "pictures")] == []
    assert not (tmp_path / "pictures").exists()


TEXTS = {
    "D60": "no other camera sees what cam2 sees",
    "D61": r"all cameras look from nearly the same direction, 1\.\d degrees",
    "D62": r"the exposure of cam1 drifts by 0\.[67]",
    "D63": r"the white balance of cam1 drifts by 0\.[12]",
    "D64": r"what moves in cam1 is blurred in \d+ of \d+ images",
    "D65": "the cameras agree better if the rows of an image are read within",
    "D66": r"cam1 lacks about 2 of 30 frames, the first after time 0\.1",
    "D67": r"clocks differ from that of cam0: cam1 by \+2\d",
    "D68": "id 1 is not the same thing in cam0, cam1",
    "D69": "only cam0 sees id 2",
    "D70": "images of 968 lines, expected up to 960",
    "D71": "cam1 repeats 3 of 30 images, the first is 0005.png",
    "D72": "the clocks of a, b were not compared",
}


def test_every_fault_of_captures_has_a_text():
    assert list(TEXTS) == [code for code in codes.CODES if "D60" <= code < "E"]


@pytest.mark.default_cases("D62", "D68")  # test_check.py finds all of them, without pictures
@pytest.mark.parametrize("code", TEXTS)
def test_each_fault_is_the_only_one_of_its_capture_and_has_a_picture(tmp_path, code):
    (tmp_path / "data").mkdir()
    root = CASES[code](tmp_path / "data")
    every = check.check(root, tmp_path / "pictures")
    assert_found(every, code)
    found = {finding.code: finding for finding in every}
    assert set(found) & set(TEXTS) == {code}
    assert re.search(TEXTS[code], found[code].problem), found[code].problem
    picture = found[code].picture
    assert picture.startswith(str(tmp_path / "pictures")) and images.size(Path(picture))[0] > 100
    assert f"Picture: {picture}" in str(found[code])


def test_pictures_of_a_prepared_data_set_are_in_its_folder_and_others_are_not_drawn(tmp_path):
    for name in ("prepared", "other"):
        (tmp_path / name).mkdir()
        CASES["D72" if name == "prepared" else "D66"](tmp_path / name)
        (finding,) = [one for one in check.check(tmp_path / name) if one.code in TEXTS]
        assert bool(finding.picture) == (name == "prepared") == (tmp_path / name / "check").is_dir()


def test_pictures_of_corrected_faults_are_removed(tmp_path):
    CASES["D72"](tmp_path)
    old, own = tmp_path / "check" / "D66_cam0.png", tmp_path / "check" / "notes.png"
    for path in (old, own):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    check.check(tmp_path)
    assert not old.exists() and own.exists()


def test_common_view_and_angles_follow_the_geometry():
    cameras = list(recordings.make_rig(3, 64, 48, angles=(0.0, np.pi / 2, np.pi)).cameras)
    middle = arrangement.focus(cameras)
    np.testing.assert_allclose(middle, [0, 0, 0.45], atol=1e-6)
    assert arrangement.widest_angle(cameras, middle) > 120
    assert arrangement.common_views(cameras, middle).min() > 0.1


def test_the_epipolar_line_of_a_point_holds_its_image():
    rig = recordings.make_rig(2, 64, 48)
    point = np.array([0.2, -0.1, 0.6])
    made = []
    for camera in rig.cameras:
        local = camera.T_cam_world[:3, :3] @ point + camera.T_cam_world[:3, 3]
        center = (camera.intrinsics @ local / local[2])[:2]
        view = type("View", (), {"camera": camera})()
        made.append(agreement.Sighting(view, center, 3.0, True))
    assert agreement.distance(*made) < 1e-9
    moved = agreement.Sighting(made[1].view, made[1].center + np.array([0.0, 7.0]), 3.0, True)
    assert 3.0 < agreement.distance(made[0], moved) <= 7.0


@pytest.mark.parametrize(
    "record", ["[]", '{"format_version": 1, "cameras": [{}]}', '{"format_version": 1, "cameras": 3}']
)
def test_a_damaged_record_hides_no_other_fault(tmp_path, record):
    captures.make(tmp_path)
    next(tmp_path.rglob("*.png")).unlink()
    (tmp_path / "capture.json").write_text(record)
    found = {finding.code: finding.problem for finding in check.check(tmp_path)}
    assert set(found) >= {"D00", "D10"} and ("format_version" in found["D00"] or "cameras" in found["D00"])
