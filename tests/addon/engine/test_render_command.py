"""The command `r5dgs_render` of Blender's command line."""

import importlib

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")


@pytest.fixture
def command(extension):
    return importlib.import_module("r5dgs.r5dgs_addon.engine.render_command")


@pytest.fixture
def shot(blender, tmp_path, monkeypatch):
    """Scene with the engine R5DGS that renders the frames 50 to 52 into the folder `frames`."""
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    motions.load_again(blender, scene_file.write(scenes.make_scene(n=300, objects=2, seed=4), tmp_path / "a.r5dgs"))
    scene = blender.context.scene
    scene.render.engine, scene.view_settings.view_transform = "R5DGS", "Standard"
    scene.render.resolution_x, scene.render.resolution_y, scene.render.dither_intensity = 48, 32, 0.0
    scene.frame_start, scene.frame_end = 50, 52
    scene.camera.location, scene.camera.rotation_euler = (0, -5, 1), (1.4, 0, 0)
    scene.render.filepath = str(tmp_path / "frames" / "x_###")
    return scene


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_missing_frames_are_rendered_like_f12_and_existing_ones_left(command, blender, shot, tmp_path, capsys):
    folder, before = tmp_path / "frames", (50, 52, shot.render.filepath)
    killed = folder / ".x_051.png.part"
    killed.mkdir(parents=True)
    (killed / "x_051.png").write_bytes(b"half")
    (folder / ".x_051.png.placeholder").write_text("{}")
    (folder / "x_051.png").touch()  # Blender's placeholder
    (folder / "x_050.png").write_bytes(b"mine")
    assert command.run([]) == 0
    assert names(folder) == ["x_050.png", "x_051.png", "x_052.png"]
    assert (folder / "x_050.png").read_bytes() == b"mine"
    said = capsys.readouterr().out
    assert f'skipping existing frame "{folder / "x_050.png"}"\n' in said
    assert [f"Saved: '{folder / name}'\n" in said for name in names(folder)] == [False, True, True]
    assert (shot.frame_start, shot.frame_end, shot.render.filepath) == before
    for frame in (51, 52):
        shot.frame_set(frame)
        shot.render.filepath = str(tmp_path / "f12.png")
        blender.ops.render.render(write_still=True)
        np.testing.assert_array_equal(images.read(folder / f"x_{frame:03d}.png"), images.read(tmp_path / "f12.png"))
    assert np.ptp(images.read(folder / "x_052.png")) > 0.2


def test_each_view_of_a_stereo_frame_gets_its_file(command, shot, tmp_path):
    shot.render.use_multiview = True
    shot.render.image_settings.views_format = "INDIVIDUAL"
    shot.render.filepath = f"{tmp_path / 'frames'}/"
    assert command.run(["--frames", "51"]) == 0
    assert names(tmp_path / "frames") == ["0051_L.png", "0051_R.png"]


def no_scene(blender, monkeypatch):
    blender.data.batch_remove([c for c in blender.data.collections if c.r5dgs.is_scene])


def no_worker(blender, monkeypatch):
    monkeypatch.setenv("R5DGS_PYTHON", "/nonexistent/python")


def other_engine(blender, monkeypatch):
    blender.context.scene.render.engine = "CYCLES"


def panorama(blender, monkeypatch):
    blender.context.scene.camera.data.type = "PANO"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (no_scene, "frame 51: R5DGS: expected a loaded R5DGS scene"),
        (no_worker, "frame 51: R5DGS: worker: '/nonexistent/python' cannot be started"),
        (other_engine, "scene 'Scene': rendered by CYCLES; choose the render engine R5DGS"),
        (panorama, "frame 51: R5DGS: "),
    ],
)
def test_failures_end_with_status_1_and_leave_no_files(
    command, blender, shot, tmp_path, monkeypatch, capsys, spoil, said
):
    importlib.import_module("r5dgs.r5dgs_addon.worker.jobs").stop()
    spoil(blender, monkeypatch)
    assert command.run(["--frames", "51,52"]) == 1
    assert f"r5dgs_render: {said}" in capsys.readouterr().err
    assert not (tmp_path / "frames").exists() or names(tmp_path / "frames") == []


def test_videos_and_unwritable_folders_are_refused(command, blender, shot, tmp_path, capsys):
    (tmp_path / "frames").write_text("a file")
    assert command.run([]) == 1
    assert f"{tmp_path / 'frames'}: the folder cannot be created" in capsys.readouterr().err
    if hasattr(shot.render.image_settings, "media_type"):
        shot.render.image_settings.media_type = "VIDEO"
    shot.render.image_settings.file_format = "FFMPEG"
    assert command.run([]) == 1
    assert "a video cannot be shared between processes" in capsys.readouterr().err


def test_lists_of_frames_are_in_blenders_notation(command):
    assert command.parse_frames("3..5,-2..-1, 9,4") == [3, 4, 5, -2, -1, 9]


@pytest.mark.parametrize("text", ["", "1-5", "5..1", "1,,2", "a", "1..", "1...3"])
def test_other_lists_of_frames_are_refused(command, text, capsys):
    with pytest.raises(SystemExit) as stop:
        command.run([f"--frames={text}"])
    assert stop.value.code == 2 and "expected a frame or a range" in capsys.readouterr().err
