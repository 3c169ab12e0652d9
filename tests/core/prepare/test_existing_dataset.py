"""An output folder that has a data set: continued, replaced or refused, without loss of files of others."""

import shutil
from pathlib import Path

import pytest

from r5dgs_core import errors
from r5dgs_core.cli.commands import prepare as command
from r5dgs_core.data import images
from r5dgs_core.prepare import camera_source
from tests.support import recordings
from tests.support.prepared_data import content, prepared

COUNT, RIG = recordings.TINY_FRAMES, recordings.tiny_rig()


def test_an_interrupted_run_continues_to_the_same_result(capture, tmp_path, monkeypatch):
    prepared(capture, tmp_path / "whole", lines=36)
    read = camera_source.CameraSource.read

    def interrupted(self, wanted):
        for count, item in enumerate(read(self, wanted)):
            if self.name == "cam1" and count == 2:
                raise KeyboardInterrupt
            yield item

    monkeypatch.setattr(camera_source.CameraSource, "read", interrupted)
    with pytest.raises(errors.Interrupted, match="run the same command again to continue"):
        prepared(capture, tmp_path / "parts", lines=36)
    assert not (tmp_path / "parts" / "transforms_train.json").exists()
    decoded = []

    def counted(self, wanted):
        decoded.extend(wanted)
        return read(self, wanted)

    monkeypatch.setattr(camera_source.CameraSource, "read", counted)
    prepared(capture, tmp_path / "parts", lines=36)
    assert len(decoded) == 3 * COUNT - COUNT - 2
    assert content(tmp_path / "parts") == content(tmp_path / "whole")


def test_other_settings_need_overwrite_and_replace_everything(capture, tmp_path):
    out = tmp_path / "data"
    prepared(capture, out, lines=36, hold_out={"every": 2})
    assert (out / "transforms_val.json").exists()
    with pytest.raises(errors.DatasetError, match=r"other input or settings \(size, hold_out_every\)"):
        prepared(capture, out, lines=24)
    found = prepared(capture, out, lines=24, overwrite=True)
    assert found.train[0].camera.height == 24 and not found.val


def test_an_unfinished_data_set_of_other_input_is_replaced(capture, tmp_path):
    """A user who corrects a damaged recording repeats the same command."""
    videos, out = tmp_path / "videos", tmp_path / "data"
    shutil.copytree(capture, videos)
    pixels = recordings.draw_tiny(RIG.cameras[2], RIG.lenses[2], 0.0)
    (videos / "cam2.mp4").unlink()
    for k in range(COUNT):
        images.write_png(videos / "cam2" / f"{k:06d}.png", pixels)
    whole = (videos / "cam2" / "000003.png").read_bytes()
    (videos / "cam2" / "000003.png").write_bytes(whole[:100])
    with pytest.raises(errors.DatasetError, match=r"cam2/000003.png"):
        prepared(videos, out, lines=36, rate=10)
    (videos / "cam2" / "000003.png").write_bytes(whole)
    images.write_png(videos / "cam2" / "000006.png", pixels)
    assert len(prepared(videos, out, lines=36, rate=10).train) == 3 * COUNT


def stop_at_first_image(monkeypatch, name="cam1"):
    """Stop `prepare` at the first image of a camera that it has to write."""
    read = camera_source.CameraSource.read

    def stopped(self, wanted):
        if self.name == name and len(wanted):
            raise KeyboardInterrupt
        yield from read(self, wanted)

    monkeypatch.setattr(camera_source.CameraSource, "read", stopped)


@pytest.mark.parametrize("name", ["images/cam0/mine.png", "images/mine.png", "object_mask/cam0/000000.png"])
def test_an_unfinished_data_set_with_files_of_others_is_not_replaced(capture, tmp_path, monkeypatch, name):
    out = tmp_path / "data"
    with monkeypatch.context() as patch, pytest.raises(errors.Interrupted):
        stop_at_first_image(patch)
        prepared(capture, out, lines=36)
    (out / name).parent.mkdir(exist_ok=True, parents=True)
    (out / name).write_bytes(b"mine")
    before = content(out)
    shown = name.split("/")[0] if name.startswith("object_mask") else name
    with pytest.raises(errors.DatasetError, match=rf"\(size\), and {shown} is not a file of prepare; move it"):
        prepared(capture, out, lines=24)
    assert content(out) == before
    prepared(capture, out, lines=24, overwrite=True)
    assert not (out / name).exists()


def test_an_unfinished_data_set_with_a_partly_written_image_is_replaced(capture, tmp_path, monkeypatch):
    out = tmp_path / "data"
    with monkeypatch.context() as patch, pytest.raises(errors.Interrupted):
        stop_at_first_image(patch)
        prepared(capture, out, lines=36)
    part = out / "images" / "cam0" / ".000000.jpg.0123456789abcdef.jpg"  # of a killed process
    part.touch()
    assert prepared(capture, out, lines=24).train[0].camera.height == 24 and not part.exists()


def test_a_record_that_is_not_of_prepare_is_not_replaced(capture, tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "mine.png").write_bytes(b"mine")
    (tmp_path / "capture.json").write_text('{"format_version": 1}')
    before = content(tmp_path)
    with pytest.raises(errors.DatasetError, match="prepared from other input or settings"):
        prepared(capture, tmp_path)
    assert content(tmp_path) == before


def test_a_finished_data_set_stays_finished_if_repeating_stops(capture, tmp_path, monkeypatch):
    out = tmp_path / "data"
    prepared(capture, out, lines=36)
    before = content(out)
    next((out / "images" / "cam1").iterdir()).unlink()
    with monkeypatch.context() as patch, pytest.raises(errors.Interrupted):
        stop_at_first_image(patch)
        prepared(capture, out, lines=36)
    assert (out / "capture.json").read_bytes() == before[Path("capture.json")]
    with pytest.raises(errors.DatasetError, match=r"other input or settings \(size\)"):
        prepared(capture, out, lines=24)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(command, "_check_capture", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        prepared(capture, out, lines=36)
    assert content(out) == before


def test_a_folder_with_other_files_is_not_touched(capture, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(errors.DatasetError, match="expected an empty folder or a prepared data set, found notes.txt"):
        prepared(capture, tmp_path)
    assert content(tmp_path) == {(tmp_path / "notes.txt").relative_to(tmp_path): b"mine"}


def test_inputs_that_would_be_replaced_are_refused(capture, tmp_path):
    """With ``overwrite``, they would be removed before they are read."""
    out = tmp_path / "data"
    prepared(capture, out, lines=36)
    (out / "object_mask" / "cam0").mkdir(parents=True)
    before = content(out)
    with pytest.raises(errors.ConfigError, match=r"data/images: is in .*data/images, which is replaced; copy it"):
        prepared(out / "images", out, calibration=out, overwrite=True)
    with pytest.raises(errors.ConfigError, match=r"data/object_mask: is in .*name another folder with --out"):
        prepared(capture, out, masks=str(out / "object_mask"), overwrite=True)
    assert content(out) == before


@pytest.mark.parametrize(
    "wrong", [{"hold_out": {"cameras": ("cam9",)}}, {"offsets": {"cam9": 0.1}}, {"masks": "none9"}]
)
def test_a_mistake_in_the_options_keeps_the_data_set_that_is_to_be_replaced(capture, tmp_path, wrong):
    prepared(capture, tmp_path / "data", lines=36)
    before = content(tmp_path / "data")
    with pytest.raises(errors.R5dgsError, match="cam9|none9"):
        prepared(capture, tmp_path / "data", lines=24, overwrite=True, **wrong)
    assert content(tmp_path / "data") == before


def test_masks_are_checked_before_the_images_are_written(capture, tmp_path):
    (tmp_path / "masks" / "cam9").mkdir(parents=True)
    with pytest.raises(errors.DatasetError, match=r"expected a folder of masks per camera \(cam0, cam1, cam2\)"):
        prepared(capture, tmp_path / "data", masks=str(tmp_path / "masks"))
    assert not (tmp_path / "data").exists()
