"""Quantised scene files: stated errors, equal bytes when written again, and faults of their own."""

import numpy as np
import pytest

from r5dgs_core import check, errors, findings
from r5dgs_core.motion import rotations
from r5dgs_core.scene import format_features, quantised_arrays, scene_file
from r5dgs_core.scene.array_types import EMBEDDINGS
from tests.core.scene.test_scene_file import npy, rewrite
from tests.fuzz.readers import rich_scene
from tests.support.scenes import make_scene

# Largest errors, as docs/reference/scene_format.md states them.
ERRORS = {
    "log_scales": 2**-7,
    "opacity_logits": 2**-6,
    "sh": 2**-8,
    "shading": 2**-10,
    "shading_rest": 2**-10,
    "residual_log_scales": 2e-3,
    "residual_offsets": 1e-3,
}
TURN = 5e-3  # rad
RELATIVE = {name: 2**-11 for name in ("dynamics", *EMBEDDINGS)}
CHECKED_BELOW = ("quats", "residual_quats", "identities", "means", "canonical_means")
SAME = (
    "object_ids",
    "motion_ids",
    "track_times",
    "track_poses",
    "background_sh",
    "classifier_weight",
    "classifier_bias",
    "residual_rows",
    "origin",
    "light_direction",
)


@pytest.fixture(scope="module")
def scene():
    return rich_scene()


@pytest.fixture(scope="module")
def path(scene, tmp_path_factory):
    return scene_file.write(scene, tmp_path_factory.mktemp("scenes") / "q.r5dgs", precision="quantised")


def angles(a, b):
    return rotations.angle_between(a.reshape(-1, 4).astype(float), b.reshape(-1, 4).astype(float))


def test_each_member_is_within_its_stated_error(scene, path):
    before, after = scene.arrays(), scene_file.read(path).arrays()
    assert before.keys() == after.keys()
    for name, array in before.items():
        assert after[name].dtype == array.dtype and after[name].shape == array.shape, name
        change = np.abs(after[name].astype(float) - array.astype(float))
        if name in ERRORS:
            assert change.max() <= ERRORS[name], name
        elif name in RELATIVE:
            assert (change <= RELATIVE[name] * np.abs(array) + 3e-8).all(), name
        elif name in SAME:
            assert not change.any(), name
        else:
            assert name in CHECKED_BELOW
    assert angles(before["quats"], after["quats"]).max() < TURN
    assert angles(before["residual_quats"], after["residual_quats"]).max() < 1e-4
    identities = before["identities"].astype(float)
    assert np.abs(after["identities"] - identities).max() <= np.abs(identities).max() / 63
    sizes = np.exp(before["log_scales"].astype(float).mean(axis=-1))
    for item in scene.objects:
        rows = slice(item.start, item.start + item.count)
        for name in ("means", "canonical_means") if item.count else ():
            allowed = np.percentile(sizes[rows], 10) * np.exp(2**-7) / 32
            assert np.abs(after[name][rows] - before[name][rows]).max() <= allowed, name


def test_a_scene_that_was_read_is_written_with_equal_bytes(path, tmp_path):
    again = scene_file.write(scene_file.read(path), tmp_path / "again.r5dgs", precision="quantised")
    assert again.read_bytes() == path.read_bytes()


def test_rotations_whose_components_are_alike_are_stored_once_and_for_all():
    rng = np.random.default_rng(0)
    signs = rng.choice([-1.0, 1.0], (4000, 4)) * (1 + rng.normal(scale=1e-3, size=(4000, 4)))
    some = [rng.normal(size=(4000, 4)), signs, signs * [1, 1, 0, 0], signs * [1, 0, 1, 1], signs * [0, 0, 0, 1]]
    quats = rotations.normalize(np.concatenate(some)).astype(np.float32)
    counts = [len(quats)]
    scales = np.zeros((len(quats), 3), np.float32)
    stored, steps = quantised_arrays.encode({"quats": quats, "log_scales": scales}, counts)
    read = quantised_arrays.decode("quats", stored["quats"], steps, "a file")
    assert angles(quats, read).max() < TURN
    again, _ = quantised_arrays.encode({"quats": read, "log_scales": scales}, counts)
    np.testing.assert_array_equal(again["quats"], stored["quats"])


@pytest.mark.parametrize("largest", [0.0, 31.8, 32.0, 63.4, 63.5, 63.9, 64.0, 127.4])
def test_identity_encodings_of_any_range_are_stored_once_and_for_all(largest):
    given = (largest / 32 * np.linspace(-1, 1, 96)).reshape(6, 16).astype(np.float32)
    arrays = {"identities": given, "log_scales": np.zeros((6, 3), np.float32)}
    stored, steps = quantised_arrays.encode(arrays, [6])
    read = quantised_arrays.decode("identities", stored["identities"], steps, "a file")
    assert np.abs(read - given).max() <= largest / 32 / 63
    again, steps_again = quantised_arrays.encode(arrays | {"identities": read}, [6])
    assert steps_again == steps
    np.testing.assert_array_equal(again["identities"], stored["identities"])


@pytest.mark.parametrize("far", [0.0, 50.0, 1e4, 1e15])
def test_positions_keep_the_precision_of_small_objects_in_wide_scenes(far, tmp_path):
    scene = make_scene(n=300, objects=2)
    means = scene.gaussians.means.copy()
    means[scene.objects[1].start] = far  # a Gaussian of the background
    wide = scene.with_arrays(means=means)
    path = scene_file.write(wide, tmp_path / "wide.r5dgs", precision="quantised")
    back = scene_file.read(path)
    item = scene.objects[-1]
    rows = slice(item.start, item.start + item.count)
    size = np.percentile(np.exp(scene.gaussians.log_scales[rows].mean(axis=-1)), 10)
    assert np.abs(back.gaussians.means[rows] - means[rows]).max() < size / 30
    assert np.abs(back.gaussians.means - means).max() <= max(size, far * 2**-23)
    again = scene_file.write(back, tmp_path / "again.r5dgs", precision="quantised")
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("member", "value"),
    [("log_scales", -900.0), ("opacity_logits", 1e7), ("sh", -5e4), ("sh", 1e8), ("shading", 900.0)],
)
def test_values_that_do_not_fit_are_kept_as_in_other_files(member, value, tmp_path):
    scene = make_scene(n=60, objects=1)
    array = scene.arrays()[member].copy()
    array.reshape(-1)[5] = value
    path = scene_file.write(scene.with_arrays(**{member: array}), tmp_path / "a.r5dgs", precision="quantised")
    found = scene_file.read(path).arrays()[member]
    np.testing.assert_allclose(found, array, rtol=1e-3, atol=1e-3)
    assert found.reshape(-1)[5] == pytest.approx(value, rel=1e-3)


@pytest.mark.parametrize("count", [0, 1])
def test_scenes_of_no_or_one_gaussian_are_read(count, tmp_path):
    scene = make_scene(n=count, objects=0, unassigned=0, shadows=False)
    path = scene_file.write(scene, tmp_path / "a.r5dgs", precision="quantised")
    assert len(scene_file.read(path).gaussians.means) == count


def test_a_quantised_file_is_half_as_large(tmp_path):
    scene = make_scene(n=4000, objects=3, sh_degree=2)
    compact, small = (
        scene_file.write(scene, tmp_path / f"{precision}.r5dgs", precision=precision).stat().st_size
        for precision in ("compact", "quantised")
    )
    assert small < 0.55 * compact


def test_a_release_without_the_feature_refuses_the_file_and_names_it(path, monkeypatch):
    known = format_features._KNOWN_NAMES - {"quantised"}
    monkeypatch.setattr(format_features, "_KNOWN_NAMES", known)
    for reader in (scene_file.read, scene_file.read_embeddings, scene_file.precision_of):
        with pytest.raises(errors.SceneFileError, match=r"requires features .*'quantised' \(since R5DGS 0\.2\.0\)"):
            reader(path)


def edited(change):
    def apply(tree):
        change(tree["quantised"])

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tree: tree.pop("quantised") and None, "quantised: expected dict, found nothing"),
        (edited(lambda entry: entry.pop("steps")), "quantised: steps: expected dict"),
        (edited(lambda entry: entry["steps"].pop("sh")), "sh: expected its step in 'quantised', found none"),
        (edited(lambda entry: entry["steps"].update(sh=0.0)), r"steps: sh: expected a step from 2\^-140 to 2\^60"),
        (edited(lambda entry: entry["steps"].update(sh="1")), "steps: sh: expected float, found '1'"),
        (edited(lambda entry: entry["means"].pop()), "means: expected blocks of 'quantised' that cover"),
        (edited(lambda entry: entry.pop("means")), "means: expected blocks of 'quantised' that cover"),
        (edited(lambda entry: entry["means"][0].update(rows=-1)), r"means\[0\]: rows: expected a number from 0"),
        (edited(lambda entry: entry["means"][0].update(step=1e30)), r"means\[0\]: step: expected a step"),
        (edited(lambda entry: entry["means"][0].update(offset=[1, 2.5, 3])), "offset: expected three whole numbers"),
        (edited(lambda entry: entry["means"][0].update(offset=[1 << 61] * 3, step=1e18)), "means: expected finite"),
    ],
)
def test_faulty_steps_are_one_error(path, tmp_path, change, message):
    broken = rewrite(path, tmp_path / "broken.r5dgs", change_json=change)
    with pytest.raises(errors.SceneFileError, match=message):
        scene_file.read(broken)
    found = [one for one in check.check(broken) if one.severity == findings.ERROR]
    assert len(found) == 1


def test_whole_numbers_belong_to_quantised_files_alone(scene, path, tmp_path):
    compact = scene_file.write(scene, tmp_path / "compact.r5dgs")
    for name, dtype in (("means", np.int16), ("quats", np.uint8)):
        data = np.zeros_like(getattr(scene.gaussians, name), dtype)
        broken = rewrite(compact, tmp_path / "broken.r5dgs", replace={f"{name}.npy": npy(data)})
        with pytest.raises(errors.SceneFileError, match=f"{name}.npy"):
            scene_file.read(broken)
