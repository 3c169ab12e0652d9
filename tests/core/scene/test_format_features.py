import dataclasses
import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.scene import format_features, scene_file, scene_json
from tests.data.make_scenes import SCENES
from tests.support import problems
from tests.support.scenes import make_scene

FAST = np.append(np.ones(17), [1e7] * 3)  # a knot with a spin after it that is too large
FAR = np.array([5e6, -1.25e8, 3.0])


def scene_tree(path):
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read(scene_file.JSON_MEMBER))


def members(path):
    """All of a zip but the compressed bytes, which differ between builds of zlib."""
    with zipfile.ZipFile(path) as archive:
        return [
            (entry.filename, entry.date_time, entry.compress_type, entry.external_attr, archive.read(entry))
            for entry in archive.infolist()
        ]


def stored_arrays(path):
    """The arrays of a scene file as they are stored."""
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name != scene_file.JSON_MEMBER]
        return {name: np.load(io.BytesIO(archive.read(name))) for name in names}


def assert_alike(found, expected):
    """Compare JSON values; numbers may differ by rounding, which depends on the processor."""
    assert type(found) is type(expected)
    if isinstance(expected, dict):
        assert list(found) == list(expected)
        for key in expected:
            assert_alike(found[key], expected[key])
    elif isinstance(expected, list):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_alike(one, other)
    else:
        assert found == (pytest.approx(expected, rel=1e-9, abs=1e-12) if isinstance(expected, float) else expected)


def with_features(path, target, listed, **more):
    """A copy of a scene file in version 2 with these features."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == scene_file.JSON_MEMBER:
                data = json.dumps({**json.loads(data), "format_version": 2, "features": listed, **more}).encode()
            new.writestr(name, data)
    return target


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return scene_file.write(make_scene(n=60), tmp_path_factory.mktemp("scenes") / "scene.r5dgs")


@pytest.mark.parametrize("name", SCENES)
def test_files_of_version_1_stay_readable_and_are_written_again_byte_for_byte(name, tmp_path, monkeypatch):
    old = Path(__file__).parents[2] / "data" / f"{name}.r5dgs"
    monkeypatch.setattr(scene_json, "__version__", "0.1.0")  # of the release that wrote them
    scene = scene_file.read(old)
    assert not scene.origin.any()
    assert members(scene_file.write(scene, tmp_path / "again.r5dgs")) == members(old)


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_without_new_features_is_written_as_version_1(name, tmp_path, monkeypatch):
    old = Path(__file__).parents[2] / "data" / f"{name}.r5dgs"
    monkeypatch.setattr(scene_json, "__version__", "0.1.0")
    new = scene_file.write(SCENES[name](), tmp_path / "new.r5dgs")
    assert_alike(scene_tree(new), scene_tree(old))
    found, expected = stored_arrays(new), stored_arrays(old)
    assert list(found) == list(expected)
    for array, before in zip(found.values(), expected.values(), strict=True):
        assert array.dtype == before.dtype
        np.testing.assert_allclose(array, before, rtol=1e-6, atol=1 if array.dtype.kind == "i" else 1e-6)


def test_an_origin_makes_version_2_and_comes_back_bit_for_bit(path, tmp_path):
    assert scene_tree(path)["format_version"] == 1 and "features" not in scene_tree(path)
    far = scene_file.read(path).with_arrays(origin=FAR)
    tree = scene_tree(scene_file.write(far, tmp_path / "far.r5dgs"))
    assert tree["format_version"] == 2
    assert tree["features"] == [{"name": "origin", "required": True, "since": "0.2.0"}]
    back = scene_file.read(tmp_path / "far.r5dgs")
    assert back.origin.dtype == np.float64 and back.origin.tolist() == FAR.tolist()
    near = back.with_arrays(origin=np.zeros(3))
    assert members(scene_file.write(near, tmp_path / "near.r5dgs")) == members(path)


def test_a_missing_required_feature_is_named_with_its_release(path, tmp_path):
    listed = [
        {"name": "origin", "required": True, "since": "0.2.0"},
        {"name": "ragdolls", "required": True, "since": "0.9.1"},
        {"name": "colliders", "required": True, "since": "0.10.0"},
    ]
    newer = with_features(path, tmp_path / "newer.r5dgs", listed, origin=[0, 0, 1e7])
    for reader in (scene_file.read, scene_file.read_embeddings, scene_file.precision_of):
        with pytest.raises(errors.SceneFileError, match=r"'ragdolls' .*0\.9\.1.*update R5DGS to 0\.10\.0") as caught:
            reader(newer)
        assert "'origin'" not in str(caught.value) and str(newer) in str(caught.value)


def test_optional_features_are_skipped_with_one_line(path, tmp_path, caplog):
    listed = [{"name": name, "required": False, "since": "0.5.0"} for name in ("colliders", "ropes")]
    newer = with_features(path, tmp_path / "newer.r5dgs", listed, colliders=[1, 2, 3])
    scene = scene_file.read(newer)
    assert [record.getMessage().count("colliders, ropes") for record in caplog.records] == [1]
    assert members(scene_file.write(scene, tmp_path / "again.r5dgs")) == members(path)


def test_a_trajectory_comes_back_and_a_reader_without_it_finds_the_smooth_motion(path, tmp_path):
    scene = scene_file.read(path)
    smooth, toss = scene.groups[1].model, problems.TOSSED
    groups = list(scene.groups)
    groups[1] = dataclasses.replace(groups[1], model=toss, smooth=smooth)
    tossed = scene_file.write(dataclasses.replace(scene, groups=tuple(groups)), tmp_path / "tossed.r5dgs")
    tree = scene_tree(tossed)
    assert {"name": "trajectory", "required": False, "since": "0.2.0"} in tree["features"]
    assert tree["groups"][1]["model"] == smooth.to_dict()
    back = scene_file.read(tossed).groups[1]
    assert back.model == toss and back.smooth == smooth
    groups[1] = dataclasses.replace(groups[1], model=dataclasses.replace(toss, knots=toss.knots * FAST))
    with pytest.raises(errors.SceneFileError, match=r"motion group 1: model: spins after knots.*up to 1e\+06"):
        scene_file.write(dataclasses.replace(scene, groups=tuple(groups)), tossed)


def test_version_1_has_no_features(path, tmp_path):
    odd = with_features(path, tmp_path / "odd.r5dgs", "of another program", format_version=1, origin="anywhere")
    assert not scene_file.read(odd).origin.any()


ORIGIN = dataclasses.asdict(format_features.ORIGIN)


@pytest.mark.parametrize(
    ("listed", "more", "message"),
    [
        (None, {}, "features: expected list"),
        ([3], {}, r"features\[0\]: expected an object"),
        ([{**ORIGIN, "name": "Origin\x1b[2J"}], {}, "name: expected letters"),
        ([{**ORIGIN, "since": "soon"}], {}, "since: expected a release"),
        ([{**ORIGIN, "required": "yes"}], {}, "required: expected bool"),
        ([{"name": "origin", "since": "0.2.0"}], {}, "required: expected bool"),
        ([ORIGIN, ORIGIN], {"origin": [0, 0, 1]}, "each name once"),
        ([ORIGIN], {}, "origin: expected finite numbers"),
        ([ORIGIN], {"origin": [0, 1]}, "origin: expected finite numbers"),
        ([ORIGIN], {"origin": [0, 0, 1e400]}, "origin: expected finite numbers|infinity|Infinity"),
    ],
)
def test_faulty_lists_of_features_are_named(path, tmp_path, listed, more, message):
    faulty = with_features(path, tmp_path / "faulty.r5dgs", listed, **more)
    with pytest.raises(errors.SceneFileError, match=message) as caught:
        scene_file.read(faulty)
    assert "\x1b" not in str(caught.value)
