"""Cameras are found by their files, and folders that are no recordings are refused with a remedy."""

import pytest

from r5dgs_core.errors import DatasetError
from r5dgs_core.prepare import camera_source, names, source_files


def touch(root, *paths):
    for path in paths:
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_bytes(b"")
    return root


def found(root):
    return {camera.name: [path.name for path in camera.paths] for camera in source_files.find(root)}


def test_each_video_is_a_camera_in_the_order_of_numbers(tmp_path):
    touch(tmp_path, "cam10.mp4", "cam2.MOV", "cam1.mkv", "notes.txt", ".hidden.mp4")
    assert list(found(tmp_path)) == ["cam1", "cam2", "cam10"]


def test_each_folder_of_frames_is_a_camera(tmp_path):
    touch(tmp_path, "left/10.png", "left/9.png", "right/a.heic", "calibration/board.toml")
    assert found(tmp_path) == {"left": ["9.png", "10.png"], "right": ["a.heic"]}


def test_a_folder_of_frames_alone_is_one_camera(tmp_path):
    touch(tmp_path / "walk", "1.jpg", "2.jpg")
    assert found(tmp_path / "walk") == {"walk": ["1.jpg", "2.jpg"]}


@pytest.mark.parametrize(
    "files",
    [
        ("GX020042.MP4", "GX010042.MP4", "GX030042.MP4"),
        ("GP010042.MP4", "GOPR0042.MP4", "GP020042.MP4"),
        ("rig/GH010042.MP4", "rig/GH020042.MP4"),
    ],
)
def test_chapters_of_a_recording_are_joined_in_order(tmp_path, files):
    touch(tmp_path, *files)
    (chapters,) = found(tmp_path).values()
    in_order = sorted(path.rpartition("/")[2] for path in files if "GOPR" not in path)
    assert chapters == [path for path in files if "GOPR" in path] + in_order


def test_recordings_of_different_cameras_are_not_joined(tmp_path):
    touch(tmp_path, "GX010042.MP4", "GX010043.MP4")
    assert list(found(tmp_path)) == ["GX010042", "GX010043"]


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (("GX010042.MP4", "GX030042.MP4"), "part 2 of this recording is missing"),
        (("cam0.mp4", "cam0.mov"), "two cameras have the name cam0"),
        (("cam0.mp4", "CAM0/1.png"), "two cameras have the name"),
        (("cam0/1.png", "cam0/a.mp4"), "found both"),
        (("cam0/a.mp4", "cam0/b.mp4"), "expected one recording of one camera, found 2"),
        (("notes.txt",), "expected a video or a folder of frames per camera, found none"),
    ],
)
def test_ambiguous_folders_are_refused(tmp_path, files, message):
    touch(tmp_path, *files)
    with pytest.raises(DatasetError, match=message):
        source_files.find(tmp_path)


def test_an_empty_folder_among_cameras_is_a_camera_without_frames(tmp_path):
    touch(tmp_path, "cam0/1.png")
    (tmp_path / "cam1").mkdir()
    with pytest.raises(DatasetError, match="cam1: the camera has no frames; copy them"):
        source_files.find(tmp_path)


@pytest.mark.parametrize("name", ["nothing", "notes.txt"])
def test_a_path_that_is_no_recording_is_refused(tmp_path, name):
    touch(tmp_path, "notes.txt")
    with pytest.raises(DatasetError, match=f"{name}: expected a"):
        source_files.find(tmp_path / name)


@pytest.mark.parametrize(
    ("wanted", "given", "expected"),
    [
        (["a", "b"], ["b", "a", "c"], {"a": "a", "b": "b"}),
        (["Cam_A", "cam_b"], ["cam_a.mp4", "CAM_B"], {"Cam_A": "cam_a.mp4", "cam_b": "CAM_B"}),
        (["cam_0", "cam_1"], ["1", "0"], {"cam_0": "0", "cam_1": "1"}),
        (["cam_0", "port_0"], ["0", "1"], None),
        (["left", "right"], ["0", "1"], None),
        (["a"], [], None),
    ],
)
def test_names_match_exactly_or_without_case_or_by_number(wanted, given, expected):
    assert names.match(wanted, given) == expected


def test_frames_of_one_name_are_refused(tmp_path):
    """A phone may write each picture as HEIC and as JPEG; one image of the data set would replace the other."""
    camera = source_files.find(touch(tmp_path, "cam0/1.heic", "cam0/1.jpg", "cam0/2.jpg"))[0]
    with pytest.raises(DatasetError, match=r"two frames of cam0 have the name 1, the other is .*1\.heic; keep one"):
        camera_source.open_camera(camera)


def test_videos_that_are_too_deep_are_named(tmp_path):
    touch(tmp_path, "session/calibration/extrinsic/cam0.mp4", "session/camera_array.toml")
    with pytest.raises(DatasetError, match="found none.*name the folder .*session/calibration/extrinsic, which has"):
        source_files.find(tmp_path / "session")
