"""The notes of a folder of masks are read back and decide how its masks may be used."""

import json

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images, mask_notes, masks
from r5dgs_core.train import run
from tests.support import tiny_datasets

NOTES = mask_notes.MaskNotes(
    "sam2",
    mask_notes.VIDEO,
    255,
    False,
    {"cam0": mask_notes.Video(("train/r_0", "train/r_1"), (1, 4)), "cam1": mask_notes.Video((), ())},
    {"points": 8, "model": "abc"},
)


def test_notes_can_be_read_back(tmp_path):
    assert mask_notes.read(tmp_path) == mask_notes.MaskNotes()
    mask_notes.write(NOTES, tmp_path)
    assert mask_notes.read(tmp_path) == NOTES
    assert NOTES.video_of() == {"train/r_0": "cam0", "train/r_1": "cam0"}
    assert [path.name for path in tmp_path.iterdir()] == [mask_notes.FILE]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 2}, "'format_version' 1, found 2"),
        ({"numbering": "view"}, "'numbering' must be 'scene' or 'video', found 'view'"),
        ({"unknown": 254}, "'unknown' must be 255 or 65535, found 254"),
        ({"videos": {"cam0": {"images": ["a"]}}}, "expected 'videos' of 'images' and 'ids'"),
        ({"videos": []}, "expected 'videos'"),
    ],
)
def test_notes_that_cannot_be_used_are_named(tmp_path, change, message):
    path = mask_notes.write(NOTES, tmp_path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(errors.DatasetError, match=message):
        mask_notes.read(tmp_path)
    path.write_text("[1]")
    with pytest.raises(errors.DatasetError, match="format_version"):
        mask_notes.read(tmp_path)


def test_255_is_an_id_unless_mask_notes_declare_it_unknown(copied):
    view = datasets.read(copied).train[0]
    ids = np.zeros((view.camera.height, view.camera.width), np.uint8)
    ids[:5], ids[5:9] = 255, 7
    masks.write(view.mask_path, ids)
    read = datasets.load_mask(datasets.read(copied).train[0])
    assert np.unique(read).tolist() == [0, 7, 255]
    before = datasets.read(copied).digest
    mask_notes.write(mask_notes.MaskNotes(unknown=255), view.mask_path.parents[1])
    read = datasets.load_mask(datasets.read(copied).train[0])
    assert np.unique(read).tolist() == [0, 7, masks.UNKNOWN]
    assert datasets.read(copied).digest != before  # a run must not go on with other masks


def test_unknown_of_16_bits_needs_no_notes(copied):
    view = datasets.read(copied).train[0]
    ids = datasets.load_mask(view)
    ids[:4] = masks.UNKNOWN
    masks.write(view.mask_path, ids)
    assert images.read_png(view.mask_path).dtype == np.uint16
    np.testing.assert_array_equal(datasets.load_mask(view), ids)


def test_masks_numbered_per_video_are_refused_in_training(copied, tmp_path):
    tiny_datasets.number_by_camera(copied, copied / "object_mask", (1, 2))
    dataset = datasets.read(copied)
    assert len({view.mask_video for view in dataset.train}) == 6
    with pytest.raises(errors.DatasetError, match=r"are valid per video only \(6 videos.*--masks none.*associate"):
        run.train(copied, tmp_path / "run", tiny_datasets.settings("train.iterations=2"))
    assert not (tmp_path / "run").exists()
    datasets.read(copied, "none").require_one_numbering()


def test_masks_of_a_single_video_are_used_like_those_of_a_scene(copied):
    every = tuple(view.name for view in datasets.read(copied).train)
    notes = mask_notes.MaskNotes("sam2", mask_notes.VIDEO, videos={"all": mask_notes.Video(every, (1, 2))})
    mask_notes.write(notes, copied / "object_mask")
    datasets.read(copied).require_one_numbering()


def test_unfinished_masks_are_reported(copied, caplog):
    mask_notes.write(mask_notes.MaskNotes(finished=False), copied / "object_mask")
    datasets.read(copied)
    assert caplog.text.count("masks are missing") == 1  # though three splits have their masks there


def test_an_id_that_16_bits_cannot_hold_is_named(copied, tmp_path):
    with pytest.raises(errors.DatasetError, match=r"m\.png: expected object ids from 0 to 65534, found 65536"):
        masks.write(tmp_path / "m.png", np.array([[1, 65536]]))
    with pytest.raises(errors.DatasetError, match="found -1"):
        masks.write(tmp_path / "m.png", np.array([[1, -1]]))
    (copied / "objects.json").write_text(json.dumps({"1": "brick", "65535": "ball"}))
    with pytest.raises(errors.DatasetError, match=r"objects\.json: expected object ids up to 65534.*found 65535"):
        datasets.read(copied)
