"""Associating the masks of a data set: one numbering from many, single switches named, nothing else touched."""

import csv
import dataclasses
import json
import shutil
import weakref

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.association import associate, mask_repair, render_segments
from r5dgs_core.cli import main
from r5dgs_core.cli.commands import associate as cli_associate
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import mask_notes, masks, view_masks
from r5dgs_core.scene import cameras, scene_file
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy


def rewrite(root, folder, change):
    """Write the training masks into a folder, each through ``change(view, ids)``."""
    data = datasets.read(root)
    for view in data.train:
        masks.write(folder / f"{view.name}.png", change(view, datasets.load_mask(view)))
    return data


def exchanged(ids):
    return np.select([ids == 1, ids == 2], [2, 1], ids)


@pytest.fixture(scope="module")
def scene_path(baked, tmp_path_factory):
    return scene_file.write(baked, tmp_path_factory.mktemp("baked") / "scene.r5dgs")


@pytest.fixture
def switched(tiny, tmp_path):
    """Right masks but for one image, whose two objects have each other's id, and a patch of nothing known."""

    def change(view, ids):
        if view.name != "train/r_008":
            return ids
        ids = exchanged(ids)
        ids[:3, :3] = masks.UNKNOWN
        return ids

    rewrite(tiny.root, tmp_path / "switched", change)
    return tmp_path / "switched"


@pytest.mark.slow
def test_a_numbering_per_video_becomes_one(scene_path, tiny, tmp_path):
    folder, out = tmp_path / "videos", tmp_path / "out"
    names = sorted({view.camera.name for view in datasets.read(tiny.root).train})
    data = rewrite(
        tiny.root,
        folder,
        lambda view, ids: exchanged(ids) if names.index(view.camera.name) % 2 else np.where(ids == 1, 9, ids),
    )
    tiny_datasets.number_by_camera(tiny.root, folder, (1, 2, 9))
    with pytest.raises(errors.DatasetError, match="r5dgs associate RUN"):
        datasets.read(tiny.root, str(folder)).require_one_numbering()

    cli_associate.run_associate(scene_path, tiny.root, masks=folder, out=out)

    repaired = datasets.read(tiny.root, str(out))
    repaired.require_one_numbering()
    pairs = set()
    for view, true in zip(repaired.train, data.train, strict=True):
        pairs |= set(
            zip(datasets.load_mask(view).ravel().tolist(), datasets.load_mask(true).ravel().tolist(), strict=True)
        )
    assert len(pairs) == len({new for new, _ in pairs}) == len({old for _, old in pairs}) == 3  # a one-to-one map
    assert (0, 0) in pairs
    # The ids are the folder's own: nothing that goes by those of the data set is put on them.
    assert set(repaired.object_names.values()).isdisjoint(data.object_names.values())
    assert repaired.ground_truth is None


@pytest.mark.slow
def test_a_single_switch_is_found_and_named(trained, tiny, switched, tmp_path, capsys):
    out = tmp_path / "out"
    assert main.main(["associate", str(trained.folder), "--masks", str(switched), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert (
        "2 relabelled, 0 unknown" in said
        and "train/r_008: id 2 is object 1 here, mostly object 2 in its video" in said
        and f"--masks {out}" in said
    )
    data, repaired = datasets.read(tiny.root), datasets.read(tiny.root, str(out))
    for view, true in zip(repaired.train, data.train, strict=True):
        new, ids = datasets.load_mask(view), datasets.load_mask(true)
        known = new != masks.UNKNOWN
        assert (new == ids)[known].all()
        assert (~known).sum() == (9 if view.name == "train/r_008" else 0)  # what nobody knew, nobody knows
    assert repaired.object_names == data.object_names and repaired.ground_truth is not None
    with (out / mask_repair.SEGMENTS).open() as file:
        rows = list(csv.DictReader(file))
    assert [row["image"] for row in rows if row["done"] == "relabelled"] == ["train/r_008"] * 2
    assert {row["done"] for row in rows[2:]} == {"kept"}
    summary = json.loads((out / mask_repair.SUMMARY).read_text())
    assert summary["relabelled"] == 2 and summary["segments"] == len(rows) and summary["objects"] == [1, 2]
    assert summary["agreement"] > summary["agreement_before"]


@pytest.mark.slow
def test_an_object_that_was_missed_gets_its_pixels_back(scene_path, tiny, tmp_path, capsys):
    folder, out = tmp_path / "missed", tmp_path / "out"
    data = rewrite(
        tiny.root, folder, lambda view, ids: np.where(ids == 1, 0, ids) if view.name == "train/r_008" else ids
    )
    cli_associate.run_associate(scene_path, tiny.root, masks=folder, out=out)
    for view, true in zip(datasets.read(tiny.root, str(out)).train, data.train, strict=True):
        new, ids = datasets.load_mask(view), datasets.load_mask(true)
        if view.name == "train/r_008":
            assert ((new == 1) & (ids == 1)).sum() > 0.6 * ((new == 1) | (ids == 1)).sum() > 0
            assert (new[ids == 2] == 2).all()
        else:
            np.testing.assert_array_equal(new, ids)
    assert "in 1 images, objects without a segment were filled in" in capsys.readouterr().out
    assert json.loads((out / mask_repair.SUMMARY).read_text())["mended"] == 1


@pytest.mark.slow
def test_a_scene_file_does_as_well_as_its_run(scene_path, trained, tiny, switched, tmp_path):
    one = cli_associate.run_associate(scene_path, tiny.root, masks=switched, out=tmp_path / "one", progress_kind="json")
    two = cli_associate.run_associate(trained.folder, masks=switched, out=tmp_path / "two")
    for path in one.rglob("*.png"):
        assert path.read_bytes() == (two / path.relative_to(one)).read_bytes()


def test_few_masks_are_in_memory_at_the_same_time(scene_path, tiny, switched, tmp_path, monkeypatch):
    load, given, most = datasets.load_mask, [], 0

    def counted(view):
        nonlocal most
        mask = load(view)
        given.append(weakref.ref(mask))
        most = max(most, sum(one() is not None for one in given))
        return mask

    monkeypatch.setattr(datasets, "load_mask", counted)
    cli_associate.run_associate(scene_path, tiny.root, masks=switched, out=tmp_path / "out")
    assert len(given) > 36 and most <= 4


def test_masks_that_are_read_are_not_written_over(scene_path, tiny, switched):
    before = {path: path.read_bytes() for path in switched.rglob("*.png")}
    with pytest.raises(errors.ConfigError, match="holds the incoming masks; name another folder"):
        cli_associate.run_associate(scene_path, tiny.root, masks=switched, out=switched)
    assert before == {path: path.read_bytes() for path in switched.rglob("*.png")}


def test_a_scene_file_alone_is_not_enough(tmp_path):
    (tmp_path / "scene.r5dgs").touch()
    with pytest.raises(errors.ConfigError, match="requires the options --data and --out"):
        cli_associate.run_associate(tmp_path / "scene.r5dgs")
    with pytest.raises(errors.SceneFileError, match=r"nowhere: expected a run folder or a \.r5dgs file, found nothing"):
        cli_associate.run_associate(tmp_path / "nowhere")


def test_no_masks_at_all_is_an_error(baked, tiny):
    with pytest.raises(errors.DatasetError, match="expected masks of training views, found none. Remedy: r5dgs masks"):
        mask_repair.repair(baked, datasets.read(tiny.root, view_masks.NO_MASKS))


def split_into_videos(root, folder):
    """Masks that say that each camera's have a numbering of its own."""
    data = rewrite(root, folder, lambda view, ids: exchanged(ids) if view.camera.name.endswith("1") else ids)
    return data, tiny_datasets.number_by_camera(root, folder, (1, 2)).videos


def test_ids_of_videos_that_stay_are_not_called_those_of_the_scene(scene_path, tiny, tmp_path, capsys, monkeypatch):
    """They would be trained with, an object of one video as that of another."""
    data, videos = split_into_videos(tiny.root, tmp_path / "videos")
    monkeypatch.setattr(associate, "GAIN", 1e9)
    out = cli_associate.run_associate(scene_path, tiny.root, masks=tmp_path / "videos", out=tmp_path / "out")
    said = capsys.readouterr().out
    assert "the incoming ids are kept" in said and "within single videos" in said and "r5dgs train" not in said
    assert mask_notes.read(out).videos == videos
    with pytest.raises(errors.DatasetError, match="are valid per video only"):
        datasets.read(tiny.root, str(out)).require_one_numbering()
    assert json.loads((out / mask_repair.SUMMARY).read_text())["numbering"] == "video"


def test_images_that_were_numbered_apart_are_so_in_bags(baked, tiny, tmp_path):
    data, _ = split_into_videos(tiny.root, tmp_path / "videos")
    first = [view for view in datasets.read(tiny.root).train if view.camera.name == data.train[0].camera.name]
    parts = [dataclasses.replace(view, mask_video=f"part {k // 3}") for k, view in enumerate(first)]
    bags = render_segments.draw(baked, parts, [datasets.load_mask(view) for view in parts])
    assert [bag.view for bag in bags] == [0, 0, 0, 1, 1, 1]


def test_masks_of_others_are_not_written_over_and_own_ones_leave_nothing_behind(scene_path, tiny, switched, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(tiny.root / "object_mask", out)
    before = {path: path.read_bytes() for path in out.rglob("*.png")}
    with pytest.raises(errors.DatasetError, match="holds 36 masks that r5dgs associate did not write.*--out"):
        cli_associate.run_associate(scene_path, tiny.root, masks=switched, out=out)
    assert before == {path: path.read_bytes() for path in out.rglob("*.png")}
    shutil.rmtree(out)
    split_into_videos(tiny.root, tmp_path / "videos")
    cli_associate.run_associate(scene_path, tiny.root, masks=tmp_path / "videos", out=out)
    (switched / "train" / "r_004.png").unlink()
    cli_associate.run_associate(scene_path, tiny.root, masks=switched, out=out)
    made = datasets.read(tiny.root, str(out))
    assert [view.name for view in made.train if view.mask_path is None] == ["train/r_004"]
    assert made.object_names == datasets.read(tiny.root).object_names and made.ground_truth is not None


def test_a_stop_leaves_no_masks_of_two_numberings(scene_path, tiny, switched, tmp_path, monkeypatch):
    out = tmp_path / "out"
    split_into_videos(tiny.root, tmp_path / "videos")
    cli_associate.run_associate(scene_path, tiny.root, masks=tmp_path / "videos", out=out)
    written = []

    def stopped(path, ids):
        if len(written) == 5:
            raise KeyboardInterrupt
        written.append(path)
        write(path, ids)

    write = masks.write
    monkeypatch.setattr(masks, "write", stopped)
    with pytest.raises(KeyboardInterrupt):
        cli_associate.run_associate(scene_path, tiny.root, masks=switched, out=out)
    assert sorted(out.rglob("*.png")) == sorted(written) and not mask_notes.read(out).finished


@pytest.mark.parametrize("value", [0, masks.UNKNOWN])
def test_masks_without_any_object_are_an_error(baked, tiny, tmp_path, value):
    rewrite(tiny.root, tmp_path / "masks", lambda view, ids: np.full_like(ids, value))
    with pytest.raises(errors.DatasetError, match="expected objects in the masks, found only background and unknown"):
        mask_repair.repair(baked, datasets.read(tiny.root, str(tmp_path / "masks")))


def test_bags_are_as_precise_far_from_the_world_origin(tiny, baked):
    views = datasets.read(tiny.root).train[:3]
    given = [datasets.load_mask(view) for view in views]
    shift = np.array([4096.0, -4096.0, 4096.0])
    means = np.round(baked.gaussians.means * 1024) / 1024  # float32 also represents the shifted ones exactly
    scenes = []
    for offset in (np.zeros(3), shift):
        groups = tuple(dataclasses.replace(g, pivot=np.asarray(g.pivot) + offset) for g in baked.groups)
        scenes.append(dataclasses.replace(baked.with_arrays(means=(means + offset).astype(np.float32)), groups=groups))
    moved = [dataclasses.replace(view, camera=cameras.translated(view.camera, shift)) for view in views]
    near, far = (render_segments.draw(scene, v, given) for scene, v in zip(scenes, (views, moved), strict=True))
    for here, there in zip(near, far, strict=True):
        assert abs(here.weights - there.weights).sum() < 1e-4 * here.weights.sum()
