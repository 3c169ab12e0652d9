"""Masks are made video by video, and finished videos are neither made again nor lost."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.cli.commands import masks as cli_masks
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images, mask_notes, masks
from r5dgs_core.masks import make_masks, mask_folders, videos


class Numbered:
    """Backend that numbers every video separately and raises at a given video."""

    name, numbering, own_names = "numbered", mask_notes.VIDEO, None

    def __init__(self, stop_at=None, kind=1):
        self.made_with = {"kind": kind}
        self.stop_at = stop_at
        self.asked = []

    def label(self, video, room, report):
        self.asked.append(video.name)
        for k, view in enumerate(video.views):
            if (video.name, k) == self.stop_at:
                raise KeyboardInterrupt
            yield np.full((view.camera.height, view.camera.width), k + 1, np.int32)
            report((k + 1) / len(video.views))


@pytest.fixture
def views(tiny):
    return datasets.read(tiny.root).train


def test_the_images_of_a_camera_are_a_video_in_the_order_of_time(views):
    found = videos.of(tuple(reversed(views)))
    assert len(found) == 6 and sorted(v.name for v in views) == sorted(v.name for x in found for v in x.views)
    for video in found:
        assert len({view.camera.name for view in video.views}) == 1
        assert [view.t for view in video.views] == sorted(view.t for view in video.views)
        assert video.image(0).shape == (36, 48, 3) and video.image(0).dtype == np.uint8


def moving(views, names, turn):
    """Views of one time each from a camera that goes around the scene."""
    made = []
    for k, name in enumerate(names):
        angle = k * turn
        spin = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        first = views[0].camera
        T = first.T_cam_world.copy()
        T[:3, :3] = T[:3, :3] @ spin
        camera = dataclasses.replace(first, T_cam_world=T, name=name)
        made.append(dataclasses.replace(views[0], name=f"train/m_{k}", camera=camera, t=0.1 * k))
    return made


def test_a_moving_camera_is_one_video_until_it_jumps(views):
    hand_held = moving(views, [f"cam{k}" for k in range(8)], np.radians(5))
    assert [len(video.views) for video in videos.of(hand_held)] == [8]
    leaping = moving(views, [f"cam{k}" for k in range(8)], np.radians(40))
    assert [len(video.views) for video in videos.of(leaping)] == [1] * 8
    named = moving(views, ["phone", *(f"phone@{k}" for k in range(1, 8))], np.radians(40))
    assert [(video.name, len(video.views)) for video in videos.of(named)] == [("phone", 8)]


def test_made_masks_can_be_read_back_and_are_reported(views, tmp_path):
    events = []
    made = make_masks.make(views, Numbered(), tmp_path / "m", progress=events.append)
    assert (made.images, made.videos, made.kept, made.objects) == (36, 6, 0, 36)
    notes = mask_notes.read(tmp_path / "m")
    assert notes.finished and notes.numbering == mask_notes.VIDEO and notes.backend == "numbered"
    for name, video in notes.videos.items():
        assert video.ids == (1, 2, 3, 4, 5, 6) and len(video.images) == 6, name
        assert [int(masks.read(tmp_path / "m" / f"{image}.png")[0, 0]) for image in video.images] == [1, 2, 3, 4, 5, 6]
    assert [event["done"] for event in events] == sorted(event["done"] for event in events)
    assert events[-1]["done"] == events[-1]["total"] == 36 and events[-1]["seconds_left"] == 0


def test_a_stop_loses_only_the_current_video(views, tmp_path):
    names = [video.name for video in videos.of(views)]
    with pytest.raises(KeyboardInterrupt):
        make_masks.make(views, Numbered(stop_at=(names[2], 3)), tmp_path)
    assert not mask_notes.read(tmp_path).finished
    assert list(mask_notes.read(tmp_path).videos) == names[:2]
    again = Numbered()
    made = make_masks.make(views, again, tmp_path)
    assert again.asked == names[2:] and made.kept == 2 and made.images == 36
    assert mask_notes.read(tmp_path).finished
    third = Numbered()
    assert make_masks.make(views, third, tmp_path).kept == 6 and third.asked == []


def test_a_mask_that_was_deleted_is_made_again(views, tmp_path):
    make_masks.make(views, Numbered(), tmp_path)
    (tmp_path / f"{views[4].name}.png").unlink()
    again = Numbered()
    make_masks.make(views, again, tmp_path)
    assert again.asked == [views[4].camera.name] and (tmp_path / f"{views[4].name}.png").exists()


def test_other_masks_are_overwritten_only_on_request(views, tmp_path, tiny):
    with pytest.raises(errors.DatasetError, match="holds 36 masks of unknown origin.*--overwrite"):
        make_masks.make(views, Numbered(), tiny.root / "object_mask")
    make_masks.make(views, Numbered(), tmp_path)
    with pytest.raises(errors.DatasetError, match=r"other settings \(kind\).*--out.*--overwrite"):
        make_masks.make(views, Numbered(kind=2), tmp_path)
    assert make_masks.make(views, Numbered(kind=2), tmp_path, overwrite=True).kept == 0
    assert mask_notes.read(tmp_path).made_with == {"kind": 2}
    together = Numbered(kind=2)
    together.numbering = mask_notes.SCENE
    with pytest.raises(errors.DatasetError, match=r"other settings \(numbering\)"):
        make_masks.make(views, together, tmp_path)
    mask_notes.write(mask_notes.MaskNotes(unknown=255), tmp_path)  # by hand, as docs/user/masks.md says
    with pytest.raises(errors.DatasetError, match="were made with an unknown backend; name another folder"):
        make_masks.make(views, Numbered(), tmp_path)


def test_ids_of_a_single_video_belong_to_the_folder(views, tmp_path):
    alone = [view for view in views if view.camera.name == views[0].camera.name]
    make_masks.make(alone, Numbered(), tmp_path)
    assert json.loads((tmp_path / "objects.json").read_text())["3"] == "object 3"


def test_masks_of_a_folder_are_converted_to_ids(copied, tmp_path, capsys):
    """Colours become ids, sizes those of the images, 255 unknown; files are found by path or by file name."""
    source = tmp_path / "theirs"
    truth = {}
    for view in datasets.read(copied).train:
        ids = datasets.load_mask(view)
        ids[0] = 255
        truth[view.name] = np.where(ids == 255, masks.UNKNOWN, ids)
        big = np.repeat(np.repeat(ids, 2, 0), 2, 1)
        masks.write(source / f"{view.name.split('/')[1]}.png", big)
    shutil.rmtree(copied / "object_mask" / "train")
    made = cli_masks.run_masks(copied, source=source, unknown=255)
    assert (made.images, made.objects, made.numbering) == (36, 2, "scene")
    assert made.unknown == pytest.approx(1 / 36)
    assert "36 of 36 training images, 2 objects" in (told := capsys.readouterr().out)
    assert "2.8 % of the pixels are unknown" in told
    dataset = datasets.read(copied)
    dataset.require_one_numbering()
    for view in dataset.train:
        np.testing.assert_array_equal(datasets.load_mask(view), truth[view.name])


def test_coloured_masks_of_a_folder_become_ids(copied, tmp_path):
    palette = np.array([(0, 0, 0), (250, 10, 10), (10, 10, 250)], np.uint8)
    for view in datasets.read(copied).train:
        images.write_png(tmp_path / "rgb" / f"{view.name}.png", palette[datasets.load_mask(view)])
    cli_masks.run_masks(copied, source=tmp_path / "rgb", out=tmp_path / "ids")
    view = datasets.read(copied).train[7]
    got = masks.read(tmp_path / "ids" / f"{view.name}.png")
    np.testing.assert_array_equal(got, np.array([0, 2, 1])[datasets.load_mask(view)])
    with pytest.raises(errors.ConfigError, match="--unknown 255: the masks in .* are coded by colour"):
        cli_masks.run_masks(copied, source=tmp_path / "rgb", out=tmp_path / "other", unknown=255)


def test_masks_in_the_data_set_are_checked_and_not_changed(copied, capsys):
    before = {path: path.read_bytes() for path in copied.rglob("*") if path.is_file()}
    for backend in ("precomputed", "blender"):
        made = cli_masks.run_masks(copied, backend=backend)
        assert (made.images, made.objects, made.unknown) == (36, 2, 0)
        assert "nothing was written" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in copied.rglob("*") if path.is_file()} == before


def test_a_capture_names_every_id_and_has_every_mask(copied):
    views = datasets.read(copied).train
    first = views[0].mask_path
    masks.write(first, np.full((36, 48), 9))
    with pytest.raises(errors.DatasetError, match=r"id 9 has no name in objects\.json.*precomputed"):
        cli_masks.run_masks(copied, backend="blender")
    first.unlink()
    with pytest.raises(errors.DatasetError, match=r"train/r_000 has no mask.*precomputed"):
        cli_masks.run_masks(copied, backend="blender")
    assert cli_masks.run_masks(copied).images == 35


def test_masks_of_another_shape_are_named_before_anything_is_written(copied, tmp_path):
    view = datasets.read(copied).train[3]
    shutil.copytree(copied / "object_mask", tmp_path / "theirs")
    masks.write(tmp_path / "theirs" / f"{view.name}.png", np.ones((36, 36), np.int32))
    with pytest.raises(errors.DatasetError, match=r"r_003\.png: the mask is 36x36, its image 48x36"):
        cli_masks.run_masks(copied, source=tmp_path / "theirs", out=tmp_path / "ids")
    assert not mask_notes.read(tmp_path / "ids").finished


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backend": "deva"}, "--backend deva: expected one of precomputed, blender, features, sam2"),
        ({"backend": "sam2"}, "--backend sam2: name the folder of the model with --model"),
        ({"model": "m"}, "--model: does not apply to --backend precomputed"),
        ({"points": 8}, "--points: does not apply to --backend precomputed"),
        ({"backend": "sam2", "model": "m", "unknown": 255}, "--unknown: does not apply to --backend sam2"),
        ({"backend": "sam2", "model": "m", "points": 0}, "--points 0: expected a number from 1 to 1024"),
        ({"backend": "sam2", "model": "m", "score": 2.0}, "--score 2.0: expected a share from 0 to 1"),
        ({"unknown": 254}, "--unknown 254: expected 255 or 65535"),
    ],
)
def test_contradictory_options_are_refused(tiny, options, message):
    with pytest.raises(errors.ConfigError, match=message):
        cli_masks.run_masks(tiny.root, **options)


def test_a_folder_without_masks_is_named(tiny, tmp_path):
    views = datasets.read(tiny.root).train
    with pytest.raises(errors.DatasetError, match=r"expected masks such as train/r_000\.png"):
        mask_folders.PrecomputedMasks(tmp_path, views)
    with pytest.raises(errors.DatasetError, match="expected a folder of masks"):
        mask_folders.PrecomputedMasks(tmp_path / "gone", views)


def test_old_masks_are_removed_if_the_backend_does_not_make_them(copied, tmp_path):
    """A mask of another numbering that stays among new ones would be read with them, and so would names of its ids."""
    views = datasets.read(copied).train
    source, out = tmp_path / "theirs", tmp_path / "out"
    shutil.copytree(copied / "object_mask", source)
    (source / f"{views[4].name}.png").unlink()
    alone = [view for view in views if view.camera.name == views[4].camera.name]
    make_masks.make(alone, Numbered(), out)
    assert (out / "objects.json").exists()
    cli_masks.run_masks(copied, source=source, out=out, overwrite=True)
    made = datasets.read(copied, str(out))
    assert [view.name for view in made.train if view.mask_path is None] == [views[4].name]
    assert made.object_names == datasets.read(copied).object_names


def test_255_is_not_called_unknown_where_nothing_is_written(copied):
    """Training would still read it as an object."""
    with pytest.raises(
        errors.ConfigError, match=r"--unknown 255: the masks are already in.*--out, or record it in .*masks"
    ):
        cli_masks.run_masks(copied, unknown=255)
    (copied / "object_mask" / "masks.json").write_text('{"format_version": 1, "unknown": 255}')
    assert cli_masks.run_masks(copied, unknown=255).images == 36


def test_names_of_the_ids_of_one_video_are_kept_in_the_data_sets_own_folder(copied):
    shutil.rmtree(copied / "object_mask")
    views = datasets.read(copied).train
    alone = [view for view in views if view.camera.name == views[0].camera.name]
    make_masks.make(alone, Numbered(), copied / "object_mask")
    data = datasets.read(copied)
    assert data.object_names == {k: f"object {k}" for k in range(1, 7)} and data.ground_truth is None


def test_a_video_with_new_images_is_made_again(views, tmp_path):
    some = [view for view in views if view.name != views[4].name]
    make_masks.make(some, Numbered(), tmp_path)
    again = Numbered()
    assert make_masks.make(views, again, tmp_path).images == 36
    assert again.asked == [views[4].camera.name]


def test_names_of_a_folders_own_ids_are_copied_with_its_masks(copied, tmp_path):
    """Else those of the data set's ids, and its true poses, would be put on them."""
    source, out = tmp_path / "theirs", tmp_path / "out"
    shutil.copytree(copied / "object_mask", source)
    (source / "objects.json").write_text('{"1": {"name": "zebra", "aliases": ["horse"]}, "2": "yak"}')
    cli_masks.run_masks(copied, source=source, out=out)
    made = datasets.read(copied, str(out))
    assert made.object_names == {1: "zebra", 2: "yak"} and made.object_aliases[1] == ("horse",)
    assert made.ground_truth is None
