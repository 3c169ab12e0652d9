import dataclasses
import io
import json
import zipfile

import numpy as np
import pytest

from r5dgs_core import atomic_files, errors
from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_info, scene_player
from r5dgs_core.scene import array_encoding, scene_file
from r5dgs_core.scene.scene import GROUPS
from r5dgs_core.scene.units import Units
from tests.support.scenes import make_scene

# Half a step of the stored fixed point, and half-precision rounding.
ROUNDING = {
    "quats": 4e-5,
    "log_scales": 0.5 / 2048 + 1e-6,
    "opacity_logits": 0.5 / 1024 + 1e-6,
    "sh": 1e-3,
    "shading": 1e-3,
}


@pytest.fixture(scope="module")
def scene():
    return make_scene(n=300, objects=4, sh_degree=2)


@pytest.fixture(scope="module")
def path(scene, tmp_path_factory):
    return scene_file.write(scene, tmp_path_factory.mktemp("scenes") / "scene.r5dgs")


def assert_equal_scenes(a, b, rounding):
    before, after = a.arrays(), b.arrays()
    assert before.keys() == after.keys()
    for name, array in before.items():
        assert array.dtype == after[name].dtype, name
        np.testing.assert_allclose(array, after[name], atol=rounding.get(name, 0), rtol=0, err_msg=name)
    for field in dataclasses.fields(a):
        if field.name in before or field.name in GROUPS:
            continue
        x, y = getattr(a, field.name), getattr(b, field.name)
        if field.name == "cameras":
            for left, right in zip(x, y, strict=True):
                assert (left.name, left.width, left.height) == (right.name, right.width, right.height)
                np.testing.assert_array_equal(left.intrinsics, right.intrinsics)
                np.testing.assert_array_equal(left.T_cam_world, right.T_cam_world)
        elif field.name == "groups":
            for left, right in zip(x, y, strict=True):
                assert (left.id, left.object_id, left.role, left.anchor_index, left.follows) == (
                    right.id,
                    right.object_id,
                    right.role,
                    right.anchor_index,
                    right.follows,
                )
                assert left.model == right.model
                np.testing.assert_array_equal(left.pivot, right.pivot)
                assert (left.rigid_rms, left.rigid_max) == (right.rigid_rms, right.rigid_max)
                if left.follow_matrix is not None:
                    np.testing.assert_array_equal(left.follow_matrix, right.follow_matrix)
        else:
            assert x == y, field.name


def test_reading_restores_the_written_scene(scene, path):
    assert_equal_scenes(scene, scene_file.read(path), ROUNDING)


def test_exact_files_restore_every_bit(scene, tmp_path):
    assert_equal_scenes(scene, scene_file.read(scene_file.write(scene, tmp_path / "a.r5dgs", precision="exact")), {})


def test_optional_members_may_be_absent_or_present(tmp_path):
    bare = make_scene(identities=False, shading=False, shadows=False, unassigned=0)
    assert_equal_scenes(bare, scene_file.read(scene_file.write(bare, tmp_path / "bare.r5dgs")), ROUNDING)
    rng = np.random.default_rng(0)
    rich = dataclasses.replace(
        bare.with_arrays(
            embeddings=rng.normal(size=(len(bare.objects), 8)).astype(np.float32),
            vocabulary_embeddings=rng.normal(size=(2, 8)).astype(np.float32),
        ),
        vocabulary=("mug", "tasse à café"),
        provenance={"seed": np.int64(3), "rates": np.array([1.0, 2.0]), "nested": {"ok": True, "none": None}},
    )
    back = scene_file.read(scene_file.write(rich, tmp_path / "rich.r5dgs"))
    np.testing.assert_array_equal(back.vocabulary_embeddings, rich.vocabulary_embeddings)
    assert back.vocabulary == rich.vocabulary
    assert back.provenance == {"seed": 3, "rates": [1.0, 2.0], "nested": {"ok": True, "none": None}}


def test_embeddings_are_read_without_the_other_members(scene, path, tmp_path):
    assert scene_file.read_embeddings(path) is None
    rng = np.random.default_rng(1)
    rich = dataclasses.replace(
        scene.with_arrays(
            embeddings=rng.normal(size=(len(scene.objects), 8)).astype(np.float32),
            vocabulary_embeddings=rng.normal(size=(2, 8)).astype(np.float32),
        ),
        vocabulary=("mug", "fruit"),
    )
    meanings = scene_file.read_embeddings(scene_file.write(rich, tmp_path / "rich.r5dgs"))
    assert meanings.object_ids == tuple(item.id for item in scene.objects) and meanings.vocabulary == rich.vocabulary
    np.testing.assert_array_equal(meanings.embeddings, rich.embeddings)
    np.testing.assert_array_equal(meanings.vocabulary_embeddings, rich.vocabulary_embeddings)
    with pytest.raises(errors.SceneFileError, match="nothing"):
        scene_file.read_embeddings(tmp_path / "gone.r5dgs")


def test_a_file_keeps_its_near_plane_and_one_without_has_the_default(scene, path, tmp_path):
    near = dataclasses.replace(scene, near_plane=2.5e-4)
    assert scene_file.read(scene_file.write(near, tmp_path / "near.r5dgs")).near_plane == 2.5e-4
    older = rewrite(tmp_path / "near.r5dgs", tmp_path / "older.r5dgs", lambda tree: tree.pop("near_plane") and None)
    assert scene_file.read(older).near_plane == scene_file.read(path).near_plane == 0.01


def test_a_file_keeps_its_units_and_one_without_has_none(scene, path, tmp_path):
    for known in (Units(2.5, None), Units(None, 0.01), Units(1.25, 1.0)):
        written = scene_file.write(dataclasses.replace(scene, units=known), tmp_path / "units.r5dgs")
        assert scene_file.read(written).units == known
    assert scene_file.read(path).units == Units()


def test_a_scene_without_gaussians_is_a_scene(tmp_path):
    empty = make_scene(n=0, objects=0, unassigned=0)
    assert len(scene_file.read(scene_file.write(empty, tmp_path / "empty.r5dgs")).gaussians.means) == 0


def test_playback_from_the_file_is_within_rounding(scene, path):
    read = scene_file.read(path)
    for t in (0.1, 0.75, 1.3):
        ours, theirs = scene_player.Player(scene).frame(t), scene_player.Player(read).frame(t)
        np.testing.assert_array_equal(ours.means, theirs.means)
        turn = rotations.angle_between(ours.quats.astype(float), theirs.quats.astype(float))
        assert turn.max() < 1e-4


def test_values_beyond_the_fixed_point_are_stored_in_full(scene, tmp_path):
    wide = scene.with_arrays(
        log_scales=scene.gaussians.log_scales - 40, opacity_logits=scene.gaussians.opacity_logits + 1e4
    )
    back = scene_file.read(scene_file.write(wide, tmp_path / "wide.r5dgs"))
    np.testing.assert_array_equal(back.gaussians.log_scales, wide.gaussians.log_scales)
    np.testing.assert_array_equal(back.gaussians.opacity_logits, wide.gaussians.opacity_logits)


def test_forty_thousand_gaussians_stay_small(tmp_path):
    large = make_scene(n=40_000, objects=6)
    assert scene_file.write(large, tmp_path / "large.r5dgs").stat().st_size < 2.9e6
    plain = dataclasses.replace(large, gaussians=dataclasses.replace(large.gaussians, identities=None), shading=None)
    assert scene_file.write(plain, tmp_path / "plain.r5dgs").stat().st_size < 1.6e6


def test_equal_scenes_are_equal_files(scene, path, tmp_path):
    assert scene_file.write(scene, tmp_path / "again.r5dgs").read_bytes() == path.read_bytes()


def test_a_scene_that_was_read_is_written_byte_for_byte(tmp_path, monkeypatch):
    monkeypatch.setattr(array_encoding, "_QUATS_AT_ONCE", 700)
    path = scene_file.write(make_scene(n=3000, sh_degree=1), tmp_path / "a.r5dgs")
    again = scene_file.write(scene_file.read(path), tmp_path / "b.r5dgs")
    assert again.read_bytes() == path.read_bytes()


def test_any_truncation_is_one_clear_error(path, tmp_path):
    data = path.read_bytes()
    broken = tmp_path / "broken.r5dgs"
    lengths = [*range(0, 200, 7), *np.linspace(200, len(data) - 1, 120).astype(int), *range(len(data) - 40, len(data))]
    for length in lengths:
        broken.write_bytes(data[:length])
        with pytest.raises(errors.SceneFileError, match=r"broken\.r5dgs"):
            scene_file.read(broken)


def test_flipped_bytes_never_pass_unnoticed_or_crash(path, tmp_path):
    data = path.read_bytes()
    broken, original = tmp_path / "broken.r5dgs", scene_file.read(path)
    noticed = 0
    for position in np.random.default_rng(0).integers(0, len(data), 150):
        spoiled = bytearray(data)
        spoiled[position] ^= 0x55
        broken.write_bytes(bytes(spoiled))
        try:
            read = scene_file.read(broken)
        except errors.SceneFileError:
            noticed += 1
            continue
        # What still reads was hit outside of the data (a date, an attribute): the content is whole.
        assert_equal_scenes(original, read, {})
    assert noticed > 100


def rewrite(path, target, change_json=None, replace=None, drop=()):
    """Copy a scene file with its JSON changed, members replaced or dropped."""
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(target, "w") as sink:
        for name in source.namelist():
            if name in drop:
                continue
            data = source.read(name)
            if name == "scene.json" and change_json is not None:
                tree = json.loads(data)
                tree = change_json(tree) or tree
                data = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
            if replace and name in replace:
                data = replace[name]
            sink.writestr(name, data)
    return target


def npy(array, **options):
    stream = io.BytesIO()
    np.save(stream, array, **options)
    return stream.getvalue()


def setter(*keys_and_value):
    *keys, last, value = keys_and_value

    def change(tree):
        node = tree
        for key in keys:
            node = node[key]
        node[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (setter("format", "other"), "another kind"),
        (setter("format_version", 3), "expected format_version 1 or 2, found 3; update R5DGS"),
        (setter("format_version", 1.0), "format_version"),
        (setter("format_version", True), "format_version"),
        (setter("format_version", "1"), "format_version"),
        (setter("gaussians", 7), "means.npy"),
        (setter("arrays", None), "arrays"),
        (setter("t_max", 0.7), "t_max"),
        (setter("t_max", None), "t_max: expected float"),
        (setter("frames_per_unit", 0), "frames_per_unit"),
        (setter("near_plane", 0), "near_plane: expected a positive depth"),
        (setter("seconds_per_unit", 0), "'seconds_per_unit' must be a positive number"),
        (setter("meters_per_unit", "one"), "'meters_per_unit' must be a positive number"),
        (setter("near_plane", "far"), "near_plane: expected float"),
        (setter("world_convention", "mars"), "world_convention"),
        (setter("name", 5), "name: expected str"),
        (setter("objects", 2, "start", 1), "range"),
        (setter("objects", 2, "id", 9), "ids"),
        (setter("objects", 2, "name", "background"), "unique names"),
        (setter("objects", 2, "aliases", [1]), "aliases"),
        (setter("objects", 2, "color", [1, 2]), "color"),
        (setter("objects", 2, "count", "many"), "count: expected int"),
        (setter("objects", []), "objects"),
        (setter("groups", 1, "object_id", 77), "motion group 1"),
        (setter("groups", 1, "role", "ghost"), "role"),
        (setter("groups", 1, "anchor_index", 10**6), "anchor_index"),
        (setter("groups", 1, "pivot", [0, 0, "x"]), "pivot"),
        (setter("groups", 1, "model", "kind", "magic"), "magic"),
        (setter("groups", 1, "model", "velocity", [1, 2]), "velocity"),
        (setter("groups", 1, "model", 3), "model: expected dict"),
        (setter("groups", -1, "follows", 99), "follow"),
        (setter("groups", -1, "follow_matrix", None), "follow_matrix"),
        (setter("groups", 0, "role", "body"), "pinned"),
        (setter("cameras", 0, "T_cam_world", [[1]]), "T_cam_world"),
        (setter("cameras", 0, "T_cam_world", np.diag([2.0, 2, 2, 1]).tolist()), "expected a rotation"),
        (setter("cameras", 0, "width", 0), "a width and height of 1 to"),
        (setter("light_direction", [0, 0, 3]), "light_direction"),
        (setter("light_direction", None), "light_direction"),
        (setter("vocabulary", "mug"), "vocabulary"),
        (setter("provenance", []), "provenance"),
        (setter("needs", [1]), "needs"),
        (setter("t_max", float("nan")), "NaN"),
        (lambda tree: b"[]", "another kind"),
        (lambda tree: b"{", "damage"),
        (lambda tree: b"\xff\xfe", "damage"),
        (lambda tree: b"[" * 100_000, "damage"),
    ],
)
def test_inconsistent_json_is_named(path, tmp_path, change, message):
    broken = rewrite(path, tmp_path / "broken.r5dgs", change_json=change)
    with pytest.raises(errors.SceneFileError, match=message) as caught:
        scene_file.read(broken)
    assert str(broken) in str(caught.value)


def test_each_member_is_needed(path, tmp_path):
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    assert "shading.npy" in names
    for name in names:
        broken = rewrite(path, tmp_path / "broken.r5dgs", drop=(name,))
        with pytest.raises(errors.SceneFileError, match=name):
            scene_file.read(broken)


def test_members_of_later_versions_are_skipped(path, tmp_path):
    extended = tmp_path / "extended.r5dgs"
    with zipfile.ZipFile(rewrite(path, extended), "a") as archive:
        archive.writestr("residuals.npy", b"anything")
    assert_equal_scenes(scene_file.read(path), scene_file.read(extended), {})


def spoiled(array, row, value):
    array = array.copy()
    array[row] = value
    return array


@pytest.mark.parametrize(
    ("member", "make", "message"),
    [
        ("means", lambda a: a.astype(np.float64), "dtype <f4"),
        ("means", lambda a: a[:, :2], "means"),
        ("means", lambda a: np.asfortranarray(a), "Fortran"),
        ("means", lambda a: spoiled(a, 3, np.nan), "row 3"),
        ("means", lambda a: np.array([object()]), "dtype"),
        ("quats", lambda a: (a * 2.0).astype(np.float32), "unit"),
        ("quats", lambda a: a[:-1], "quats"),
        ("sh", lambda a: a[:, :3], "sh"),
        ("object_ids", lambda a: spoiled(a, 0, 3), "range"),
        ("object_ids", lambda a: a.astype(np.int64), "dtype <i4"),
        ("motion_ids", lambda a: spoiled(a, 0, 99), "motion groups"),
        ("motion_ids", lambda a: spoiled(a, 0, -1), "motion groups"),
        ("track_times", lambda a: a[::-1].copy(), "increasing"),
        ("track_times", lambda a: spoiled(a, 2, np.inf), "finite"),
        ("track_poses", lambda a: a[:-1], "track_poses"),
        ("track_poses", lambda a: spoiled(a, (1, -1, 4), 0.5), "identity at t_max"),
        ("track_poses", lambda a: spoiled(a, (1, 2, 0), 0.5), "unit"),
        ("track_poses", lambda a: spoiled(a, (0, 2, 4), 0.5), "pinned"),
        ("identities", lambda a: a[:, :8], "identities"),
        ("background_sh", lambda a: a[:, :2], "background_sh"),
    ],
)
def test_inconsistent_members_are_named(path, tmp_path, member, make, message):
    with zipfile.ZipFile(path) as archive:
        array = np.load(io.BytesIO(archive.read(f"{member}.npy")))
    broken = rewrite(path, tmp_path / "broken.r5dgs", replace={f"{member}.npy": npy(make(array), allow_pickle=True)})
    with pytest.raises(errors.SceneFileError, match=message) as caught:
        scene_file.read(broken)
    assert member in str(caught.value) or "object" in str(caught.value) or "group" in str(caught.value)


def test_members_with_false_sizes_are_refused(path, tmp_path):
    with zipfile.ZipFile(path) as archive:
        data = archive.read("means.npy")
    for false in (data + b"12345678", data[:-8], data[:20], b"", b"\x93NUMPY\x09\x00"):
        broken = rewrite(path, tmp_path / "broken.r5dgs", replace={"means.npy": false})
        with pytest.raises(errors.SceneFileError, match=r"means\.npy"):
            scene_file.read(broken)


def test_foreign_files_and_places_are_refused(tmp_path):
    with pytest.raises(errors.SceneFileError, match="nothing"):
        scene_file.read(tmp_path / "absent.r5dgs")
    with pytest.raises(errors.SceneFileError, match="folder"):
        scene_file.read(tmp_path)
    foreign = tmp_path / "foreign.r5dgs"
    with zipfile.ZipFile(foreign, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(errors.SceneFileError, match="another kind of zip"):
        scene_file.read(foreign)


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing(scene, tmp_path, monkeypatch):
    path = scene_file.write(scene, tmp_path / "scene.r5dgs")
    before = path.read_bytes()

    def full_disk(*arguments):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(scene_file, "_add", full_disk)
        with pytest.raises(errors.SceneFileError, match="No space left"):
            scene_file.write(scene, path)
    with monkeypatch.context() as patch:
        patch.setattr(atomic_files.os, "replace", full_disk)
        with pytest.raises(errors.SceneFileError, match="No space left"):
            scene_file.write(scene, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["scene.r5dgs"]


def test_inconsistent_scenes_are_not_written(scene, tmp_path):
    path = tmp_path / "scene.r5dgs"
    bad = scene.with_arrays(
        means=np.where(np.arange(300)[:, None] == 5, np.nan, scene.gaussians.means).astype(np.float32)
    )
    with pytest.raises(errors.SceneFileError, match="not written.*means"):
        scene_file.write(bad, path)
    with pytest.raises(errors.SceneFileError, match="provenance"):
        scene_file.write(dataclasses.replace(scene, provenance={"model": object()}), path)
    with pytest.raises(errors.SceneFileError, match="folder"):
        scene_file.write(scene, tmp_path / "absent" / "scene.r5dgs")
    assert list(tmp_path.iterdir()) == []


def test_info_summarizes_the_file(scene):
    info = json.loads(json.dumps(scene_info.info(scene)))
    assert info["gaussians"] == 300
    assert info["sh_degree"] == 2
    assert [o["name"] for o in info["objects"]][:2] == ["unassigned", "background"]
    assert sum(o["gaussians"] for o in info["objects"]) == 300
    assert sum(g["gaussians"] for g in info["motion_groups"]) == 300
    assert info["motion_groups"][-1]["model"] == "follows 1"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (setter("groups", 1, "model", "velocity", [1e308, 0, 0]), "velocity: expected numbers up to 1e.15"),
        (setter("groups", 1, "model", "angular_velocity", [0, 1e9, 0]), "angular_velocity"),
        (setter("groups", 1, "model", "covariance_names", ["bite.x"]), "covariance_names"),
        (setter("groups", 1, "pivot", [1e300, 0, 0]), "pivot"),
        (setter("groups", -1, "follow_matrix", [[1e300] * 3] * 3), "follow_matrix"),
        (setter("groups", []), "track_poses|group"),
        (setter("cameras", 0, "intrinsics", [[1, 0, 0], [5, 1, 0], [0, 0, 1]]), r"expected 0 at index \(1, 0\)"),
        (setter("cameras", 0, "intrinsics", [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]), "focal lengths above 0"),
        (setter("cameras", 0, "height", 10**9), "a width and height of 1 to"),
        (setter("objects", 1, "id", 2**40), "increasing ids"),
        (setter("objects", 1, "color", [1e300, 0, 0]), "a color of numbers from 0 to 1"),
        (setter("frames_per_unit", 1e300), "frames_per_unit"),
        (setter("near_plane", 1e300), "near_plane"),
        (lambda tree: json.dumps(tree).replace('"synthetic"', '"\\ud800"').encode(), "surrogates"),
        (lambda tree: json.dumps(tree).replace('"t_max": 0.75', '"t_max": ' + "9" * 400).encode(), "64 bits"),
        (lambda tree: json.dumps(tree).replace('"t_max": 0.75', '"t_max": 0.75, "t_max": 1').encode(), "occurs twice"),
        (setter("provenance", json.loads("[" * 63 + "]" * 63)), "nested deeper|provenance"),
    ],
)
def test_unplayable_scenes_are_rejected_on_reading(path, tmp_path, change, message):
    broken = rewrite(path, tmp_path / "broken.r5dgs", change_json=change)
    with pytest.raises(errors.SceneFileError, match=message):
        scene_file.read(broken)


@pytest.mark.parametrize(
    ("member", "value"),
    [("means", 3e38), ("log_scales", 80.0), ("sh", 1e30), ("track_poses", 1e200), ("track_times", -1e300)],
)
def test_numbers_beyond_the_range_of_pictures_are_refused(scene, tmp_path, member, value):
    exact = scene_file.write(scene, tmp_path / "exact.r5dgs", precision="exact")
    array = scene.arrays()[member].copy()
    array.reshape(len(array), -1)[0, -1] = value
    broken = rewrite(exact, tmp_path / "broken.r5dgs", replace={f"{member}.npy": npy(array)})
    with pytest.raises(errors.SceneFileError, match=f"{member}: expected finite numbers up to"):
        scene_file.read(broken)


def test_values_that_json_cannot_hold_are_rejected_on_writing(scene, tmp_path):
    for provenance in ({"a": float("nan")}, {"a": "\ud800"}, {"a": 10**400}, {"a": json.loads("[" * 80 + "]" * 80)}):
        with pytest.raises(errors.SceneFileError, match=r"scene\.json"):
            scene_file.write(dataclasses.replace(scene, provenance=provenance), tmp_path / "a.r5dgs")
    assert list(tmp_path.iterdir()) == []


def test_checking_many_groups_takes_calls_in_proportion_to_their_number(monkeypatch):
    """Each table of ids is built once, not once for each group."""
    built = []
    scene = make_scene(n=120, objects=40)

    class Counted(tuple):
        def __iter__(self):
            built.append(1)
            return super().__iter__()

    scene_file.validation.check(dataclasses.replace(scene, objects=Counted(scene.objects)), "scene")
    assert len(built) < 20


def test_residual_rows_whose_differences_overflow_are_not_increasing(scene):
    rows, knots = np.array([1, -(2**31)], np.int32), len(scene.tracks.times)
    wild = scene.with_arrays(
        residual_rows=rows,
        residual_offsets=np.zeros((2, knots, 3), np.float32),
        residual_quats=np.tile(np.array([1, 0, 0, 0], np.float32), (2, knots, 1)),
        residual_log_scales=np.zeros((2, knots, 3), np.float32),
    )
    with pytest.raises(errors.SceneFileError, match="residual_rows: expected increasing rows"):
        scene_file.validation.check(wild, "scene")
