"""`r5dgs check` lists all independent faults of a scene, PLY file or configuration, and each of them once."""

import json
import zipfile

import numpy as np
import pytest

from r5dgs_core import check, errors, findings
from r5dgs_core.config import config
from r5dgs_core.formats import ply
from r5dgs_core.scene import scene_file
from r5dgs_core.scene.array_types import DTYPES
from tests.core.formats.test_ply import COLUMNS, ROW, header
from tests.core.scene.test_scene_file import npy, rewrite
from tests.fuzz.readers import rich_scene


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A scene file with every member."""
    return scene_file.write(rich_scene(), tmp_path_factory.mktemp("sound") / "s.r5dgs", precision="exact")


def array(path, name):
    with zipfile.ZipFile(path) as file, file.open(f"{name}.npy") as stream:
        return np.load(stream)


def problems(path):
    return [finding.problem for finding in check.check(path) if finding.severity == findings.ERROR]


def only_problem(path):
    """The one fault of a scene file, which its reader raises."""
    (found,) = check.check(path)
    assert_strict_reader_raises(found, path)
    return found.problem


def assert_strict_reader_raises(first, path):
    with pytest.raises(errors.SceneFileError) as caught:
        scene_file.read(path)
    assert str(caught.value).startswith(f"{first.place}: {first.problem[:40]}")


DAMAGES = {
    "dtype": lambda array: npy(array.astype(np.complex64)),
    "rank": lambda array: npy(array[None]),
    "rows": lambda array: npy(array[:-1]),
    "truncated": lambda array: npy(array)[:-3],
    "not an array": lambda array: b"PK",
}
# One row less in these changes the expected shape of other arrays, so all of those are faulty.
SHARED_ROWS = ("track_times", "residual_rows")


@pytest.mark.parametrize(
    ("name", "damage"),
    [(name, damage) for name in DTYPES for damage in DAMAGES if damage != "rows" or name not in SHARED_ROWS],
)
def test_a_damaged_array_is_one_fault(name, damage, sound, tmp_path):
    broken = rewrite(sound, tmp_path / "b.r5dgs", replace={f"{name}.npy": DAMAGES[damage](array(sound, name))})
    assert name in only_problem(broken)


@pytest.mark.parametrize("name", DTYPES)
def test_a_lost_array_is_one_fault(name, sound, tmp_path):
    assert problems(rewrite(sound, tmp_path / "b.r5dgs", drop=[f"{name}.npy"])) == [
        f"{name}.npy: expected in a .r5dgs file, not found"
    ]


def test_three_arrays_a_camera_and_two_objects_are_six_faults(sound, tmp_path):
    def change(tree):
        tree["cameras"][0]["T_cam_world"] = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
        tree["objects"][1]["color"] = "red"
        tree["objects"][2]["aliases"] = [7]

    means = array(sound, "means")
    means[3, 1] = np.nan
    replaced = {
        "means.npy": npy(means),
        "sh.npy": npy(array(sound, "sh").astype(np.float64)),
        "quats.npy": npy(array(sound, "quats")[:, :3]),
    }
    broken = rewrite(sound, tmp_path / "b.r5dgs", change, replaced)
    found = problems(broken)
    assert len(found) == 6, found
    for part in ("means", "sh.npy", "quats", "objects[1]: color", "objects[2]: aliases", "camera"):
        assert any(part in problem for problem in found), part
    assert_strict_reader_raises(check.check(broken)[0], broken)


def test_all_wrong_entries_of_scene_json_are_listed(sound, tmp_path):
    top = (
        "name",
        "t_max",
        "frames_per_unit",
        "world_convention",
        "provenance",
        "near_plane",
        "vocabulary",
        "gaussians",
    )

    def change(tree):
        for key in top:
            tree[key] = None if key != "near_plane" else "near"
        for key in ("id", "name", "aliases", "caption", "color", "start", "count"):
            tree["objects"][1][key] = {}
        for key in ("id", "object_id", "role", "anchor_index", "pivot", "model", "follows", "rigid_rms", "seen"):
            tree["groups"][1][key] = [{}]
        for key in ("width", "intrinsics", "T_cam_world"):
            tree["cameras"][0][key] = "wide"
        tree["objects"][2] = "ghost"
        tree["lookup"]["pooling"] = "least"
        tree["lookup"]["encoder"]["scale"] = "large"
        tree["lookup"]["objects"][0]["views"][0]["threshold"] = "high"

    found = problems(rewrite(sound, tmp_path / "b.r5dgs", change))
    assert len(found) == len(set(found)) == len(top) + 7 + 9 + 3 + 1 + 3, "\n".join(found)


def test_arrays_are_checked_although_scene_json_is_damaged(sound, tmp_path):
    means = array(sound, "means")
    means[0] = np.inf
    replaced = {"scene.json": b"{", "means.npy": npy(means), "quats.npy": npy(array(sound, "quats")[:-2])}
    found = problems(rewrite(sound, tmp_path / "b.r5dgs", replace=replaced))
    assert len(found) == 3, found
    assert "scene.json" in found[0] and "quats" in found[1] and "means" in found[2]


def test_a_later_format_version_is_the_only_fault_reported(sound, tmp_path):
    def change(tree):
        tree.update(format_version=99, t_max="late")

    found = problems(rewrite(sound, tmp_path / "b.r5dgs", change, {"means.npy": b""}))
    assert len(found) == 1 and "format_version" in found[0], found


def test_a_wrong_number_of_gaussians_is_one_fault(sound, tmp_path):
    def change(tree):
        tree["gaussians"] += 1

    assert len(problems(rewrite(sound, tmp_path / "b.r5dgs", change))) == 1


def test_all_rules_broken_by_one_motion_group_are_listed(sound, tmp_path):
    def change(tree):
        tree["groups"][1].update(role="ghost", object_id=77, anchor_index=10**6, seen=[2.0, 1.0], rigid_rms=-1.0)
        tree["groups"][1]["model"].update(velocity=[1e200, 0, 0], angular_velocity=[1e200, 0, 0])

    assert len(problems(rewrite(sound, tmp_path / "b.r5dgs", change))) == 7


def ply_written(path, columns, rows):
    text = "\n".join(" ".join(map(str, row)) for row in rows)
    path.write_bytes(header("ascii", columns, len(rows)) + text.encode() + b"\n")
    return path


def test_missing_columns_and_numbers_that_are_not_finite_are_listed(tmp_path):
    lost = ("rot_2", "opacity", "f_dc_1")
    kept = [i for i, (name, _) in enumerate(COLUMNS) if name not in lost]
    rows = [list(ROW), list(ROW), list(ROW)]
    rows[1][4] = "nan"  # y
    rows[2][8] = 1e39  # scale_0, too large for single precision
    path = ply_written(tmp_path / "a.ply", [COLUMNS[i] for i in kept], [[row[i] for i in kept] for row in rows])
    found = problems(path)
    assert len(found) == 5, found
    for part in (*lost, "row 1: expected finite x", "row 2: expected finite scale_0"):
        assert any(part in problem for problem in found), part
    with pytest.raises(errors.SceneFileError, match="f_dc_1"):
        ply.read(path)


def test_all_rows_of_text_that_are_no_numbers_are_listed_with_the_missing_columns(tmp_path):
    columns = [column for column in COLUMNS if column[0] != "opacity"]
    row = [value for value, (name, _) in zip(ROW, COLUMNS, strict=True) if name != "opacity"]
    path = ply_written(tmp_path / "a.ply", columns, [row, ["x"] * len(row), row, row[:3]])
    found = problems(path)
    assert len(found) == 3, found
    assert "row 1" in found[0] and "row 3" in found[1] and "opacity" in found[2]


def test_a_truncated_ply_file_is_still_searched_for_columns(tmp_path):
    columns = [column for column in COLUMNS if column[0] not in ("x", "scale_1")]
    path = tmp_path / "a.ply"
    path.write_bytes(header("binary_little_endian", columns, 500) + b"\0" * 40)
    found = problems(path)
    assert len(found) == 3 and "expected 500 rows" in found[0], found
    assert "x" in found[1] and "scale_1" in found[2]


def test_all_bad_statements_of_a_ply_header_are_listed(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex many\nproperty float x\nend_header\n1\n")
    found = problems(path)
    assert len(found) == 2 and "many" in found[0] and "property float x" in found[1], found


def test_all_wrong_keys_and_values_of_a_configuration_are_listed(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(
        "[train]\niterations = -3\nitrations = 3\n[losses]\nssim = 'much'\n[lossses]\nssim = 1\n"
        "[needs]\nclassifier = 'on'\n[identity]\niterations = 0\n"
    )
    found = [f"{finding.place}: {finding.problem}" for finding in check.check(path)]
    assert len(found) == 5, found
    for part in ("train.iterations", "train.itrations", "losses.ssim", "lossses", "needs.classifier"):
        assert any(part in problem for problem in found), part
    with pytest.raises(errors.ConfigError, match=r"train\.itrations"):
        config.load(path)


def test_a_rule_about_two_keys_is_not_applied_to_a_key_without_a_value(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("[needs]\nclassifier = 'on'\n[identity]\niterations = -1\ntraining = 3\n")
    assert {finding.place for finding in check.check(path)} == {"identity.iterations", "identity.training"}


def test_the_list_of_a_hostile_file_is_bounded(sound, tmp_path, monkeypatch):
    monkeypatch.setattr(findings, "MAX_FINDINGS", 50)

    def change(tree):
        tree["objects"] = [{} for _ in range(5000)]

    found = check.check(rewrite(sound, tmp_path / "b.r5dgs", change))
    assert len(found) == 51 and "more than 50 faults" in found[-1].problem
    assert json.dumps([finding.problem for finding in found])


def test_arrays_that_do_not_fit_are_not_read(sound, tmp_path, monkeypatch):
    broken = rewrite(sound, tmp_path / "b.r5dgs", replace={"sh.npy": npy(np.zeros((1000, 16, 3), np.float32))})
    read = []
    original = scene_file.Archive.array
    monkeypatch.setattr(
        scene_file.Archive, "array", lambda self, member, dtypes: read.append(member) or original(self, member, dtypes)
    )
    assert len(problems(broken)) == 1
    assert read and "sh.npy" not in read
