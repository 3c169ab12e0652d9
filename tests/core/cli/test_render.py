"""The command ``r5dgs render``."""

import dataclasses
import json

import av
import numpy as np
import pytest

from r5dgs_core import folder_lock
from r5dgs_core.cli import main
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images
from r5dgs_core.film import video
from r5dgs_core.playback import scene_player
from r5dgs_core.render import highlight, scene_renderer
from r5dgs_core.scene import scene_file
from tests.support.command_line import complaint


@pytest.fixture
def path(scene, tmp_path):
    return scene_file.write(scene, tmp_path / "scene.r5dgs", precision="exact")


def film(path, *arguments):
    return main.main(["render", str(path), *map(str, arguments)])


def test_a_picture_has_the_bytes_of_the_renderer(path, scene, tmp_path):
    out = tmp_path / "a.png"
    for t in (0.3, scene.t_max + 0.4):
        assert film(path, "--out", out, "--time", t, "--camera", "1", "--overwrite") == 0
        expected = scene_renderer.render(scene_player.Player(scene), scene.cameras[1], t).color
        np.testing.assert_array_equal(images.read_png(out), images.to_uint8(expected))


def test_chosen_objects_are_drawn_alone_on_transparency(path, scene, tmp_path):
    out = tmp_path / "a.png"
    assert film(path, "--out", out, "--objects", "cup and toy car", "--transparent", "--time", "0.9") == 0
    expected = highlight.isolate(scene, {1, 3}, scene.cameras[0], 0.9)
    np.testing.assert_array_equal(images.read_png(out), images.to_uint8(expected))
    assert film(path, "--out", out, "--hide", "everything", "--overwrite") == 0  # the background stays
    assert np.ptp(images.read_png(out)) > 30


def test_a_video_has_the_pictures_of_its_frames(path, tmp_path, capsys):
    given = ("--time", "0:1", "--seconds", "0.25", "--size", "200", "--camera", "orbit")
    assert film(path, "--out", tmp_path / "a.mp4", *given, "--progress", "json") == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["done"] for event in events[:-1]] == [1, 2, 3, 4, 5, 6] and events[-1]["event"] == "written"
    assert film(path, "--out", tmp_path / "frames", *given) == 0
    with av.open(str(tmp_path / "a.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 6 and len({frame.tobytes() for frame in frames}) == 6
    for number, frame in enumerate(frames, 1):
        still = images.read_png(tmp_path / "frames" / f"frame_{number:04d}.png")
        assert -10 * np.log10(np.mean(((frame.astype(float) - still) / 255) ** 2)) > 30  # 4:2:0 of small splats


def test_frames_of_a_range_have_their_numbers_and_missing_ones_are_added(path, tmp_path, capsys):
    given = ("--out", tmp_path / "f", "--time", "0:1", "--seconds", "0.25")
    assert film(path, *given, "--frames", "2:3") == 0
    frames = sorted((tmp_path / "f").glob("*.png"))
    assert [p.name for p in frames] == ["frame_0002.png", "frame_0003.png"]
    assert "--share" in complaint(capsys, "render", path, *given)
    before = [p.stat().st_mtime_ns for p in frames]
    assert film(path, *given, "--share") == 0
    assert "written: 4 frames" in capsys.readouterr().out and [p.stat().st_mtime_ns for p in frames] == before
    assert len(list((tmp_path / "f").glob("*.png"))) == 6
    line = complaint(capsys, "render", path, *given, "--share", "--samples", "2")
    assert "other settings (samples)" in line
    line = complaint(capsys, "render", path, *given, "--frames", "7:9", "--overwrite")
    assert "--frames 7:9: the film has the frames 1 to 6" in line


def test_a_folder_never_mixes_films(tiny, path, scene, tmp_path, capsys):
    view = datasets.read(tiny.root).train[0]
    one = dataclasses.replace(scene, cameras=(view.camera,))
    scene_file.write(one, path)
    still = ("--out", tmp_path / "f", "--time", "0.5", "--seconds", "0.1", "--size", "16")

    def refused(*arguments):
        return complaint(capsys, "render", path, *still, "--share", *arguments)

    assert film(path, *still) == 0
    assert "other settings (beside)" in refused("--beside", tiny.root)
    scene_file.write(dataclasses.replace(one, background_sh=one.background_sh + 0.1), path)
    assert "other settings (scene)" in refused()
    entry = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50}
    track = {"render_width": 16, "render_height": 16, "fps": 24, "camera_path": [entry] * 3}
    (tmp_path / "path.json").write_text(json.dumps(track))
    moving = (*still, "--camera", tmp_path / "path.json")
    assert film(path, *moving, "--overwrite") == 0
    track["camera_path"] = [entry | {"fov": 60}] * 3
    (tmp_path / "path.json").write_text(json.dumps(track))
    assert "other settings (camera_path)" in refused("--camera", tmp_path / "path.json")
    assert film(path, *still, "--frames", "1:1", "--overwrite") == 0
    assert [p.name for p in (tmp_path / "f").glob("frame_*")] == ["frame_0001.png"]


def test_layers_are_written_for_each_frame(path, tmp_path):
    given = ("--out", tmp_path / "f", "--time", "0:1", "--seconds", "0.1", "--passes", "depth,cryptomatte")
    assert film(path, *given) == 0
    assert [p.name for p in sorted((tmp_path / "f").glob("*.exr"))] == ["frame_0001.exr", "frame_0002.exr"]


def test_the_captured_image_is_shown_on_the_left(tiny, path, scene, tmp_path, capsys):
    dataset = datasets.read(tiny.root)
    view = dataset.train[3]
    seen = dataclasses.replace(scene, cameras=(view.camera,))
    path = scene_file.write(seen, tmp_path / "seen.r5dgs", precision="exact")
    out = tmp_path / "a.png"
    assert film(path, "--out", out, "--beside", tiny.root, "--time", view.t, "--camera", view.camera.name) == 0
    found = images.read(out)
    width = view.camera.width
    assert found.shape[1] == 2 * width
    np.testing.assert_allclose(found[:, :width], datasets.load_image(view), atol=1e-3)
    expected = scene_renderer.render(scene_player.Player(seen), view.camera, view.t).color
    np.testing.assert_allclose(found[:, width:], np.clip(expected, 0, 1), atol=0.6 / 255)
    given = ("render", path, "--out", out, "--beside", tiny.root, "--overwrite")
    assert "no images of camera 'orbit'" in complaint(capsys, *given, "--camera", "orbit")


def test_future_and_past_are_marked(path, tmp_path):
    found = []
    for t in (0.5, 0.9):
        assert film(path, "--out", tmp_path / "a.png", "--marker", "--time", t, "--overwrite") == 0
        found.append(images.read_png(tmp_path / "a.png")[-1, :20].mean(0))
    np.testing.assert_allclose(found[0], found[1])
    assert found[0][2] > found[0][0] + 80  # the past is blue


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--out", "a.avi"), "expected a folder or a name that ends in one of .mp4, .mov, .webm, .png, .exr"),
        (("--out", "a.mp4", "--transparent"), ".mp4 has no alpha"),
        (("--out", "a.mp4", "--passes", "depth"), "--passes: needs EXR"),
        (("--out", "f", "--passes", "normal"), "expected some of depth, index"),
        (("--out", "a.mp4", "--size", "101x50"), "--size 101x50: .mp4 needs even numbers"),
        (("--out", "a.mp4", "--size", "9"), "--size 9: expected sides of 16 to 8192"),
        (("--out", "a.mp4", "--size", "big"), "'big'"),
        (("--out", "a.mp4", "--size", "0"), "'0'"),
        (("--out", "a.mp4", "--size", "0x200"), "'0x200'"),
        (("--out", "a.mp4", "--time", "1:0.5"), "'1:0.5'"),
        (("--out", "a.mp4", "--time", "nan"), "'nan'"),
        (("--out", "a.png", "--time", "0:1"), "a single picture has one time"),
        (("--out", "a.mp4", "--share"), "--share: applies to a folder"),
        (("--out", "a.mp4", "--frames", "1:2"), "--frames: applies to a folder"),
        (("--out", "f", "--share", "--overwrite"), "leave one out"),
        (("--out", "a.exr", "--marker"), "--marker: applies to videos"),
        (("--out", "a.mp4", "--mode", "wobbly"), "--mode wobbly"),
        (("--out", "a.mp4", "--samples", "9"), "--samples 9: expected 1 to 8"),
        (("--out", "a.mp4", "--fps", "2000"), "--fps 2000"),
        (("--out", "a.mp4", "--fps", "0.0001"), "--fps 0.0001: expected 0.001 to 1000"),
        (("--out", "a.mp4", "--beside", ".", "--camera", "0", "1"), "--beside: needs one captured camera"),
        (("--out", "a.mp4", "--objects", ""), "--objects ''"),
        (("--out", "a.mp4", "--hide", "not"), "nothing to exclude"),
    ],
)
def test_wrong_arguments_are_named(path, tmp_path, monkeypatch, capsys, arguments, named):
    monkeypatch.chdir(tmp_path)
    assert named in complaint(capsys, "render", path, *arguments, status=ExitStatus.USAGE)
    assert [p.name for p in tmp_path.iterdir()] == ["scene.r5dgs"]


def test_things_that_cannot_be_done_are_one_line_and_leave_nothing(path, scene, tmp_path, monkeypatch, capsys):
    before = sorted(p.name for p in tmp_path.iterdir())

    def line(*arguments, file=path):
        found = complaint(capsys, "render", file, *arguments)
        assert sorted(p.name for p in tmp_path.iterdir()) == before
        return found

    out = tmp_path / "a.mp4"
    assert "first observed one, 0, on" in line("--out", out, "--time=-1:0.5")
    assert "zebra" in line("--out", out, "--objects", "zebra")
    assert "no Gaussians are left" in line("--out", out, "--objects", "mug", "--hide", "cup")
    assert "--camera back" in line("--out", out, "--camera", "back")
    assert "path.json" in line("--out", out, "--camera", tmp_path / "path.json")
    assert "the folder" in line("--out", tmp_path / "no" / "a.mp4")
    with monkeypatch.context() as patch:
        patch.setattr("r5dgs_core.data.memory.available", lambda: 8 * 2.0**30)
        large = line("--out", tmp_path / "a.png", "--size", "8192", "--samples", "8")
        assert "--size 8192x6144 with --samples 8: a picture needs 135.0 GB of memory, 8.0 GB are available" in large
    assert "has data for rigid only" in line("--out", out, "--mode", "standard")
    monkeypatch.setitem(video.CODECS, ".mp4", video.Codec("no_such_codec", "yuv420p", None))
    assert "no encoder no_such_codec" in line("--out", out)
    assert "the folder cannot be created" in line("--out", path / "frames")

    first = scene.objects[[item.id for item in scene.objects].index(1)]
    kept = scene.gaussians.object_ids != 1
    arrays = {name: None if (x := getattr(scene.gaussians, name)) is None else x[kept] for name in GAUSSIANS}
    objects = []
    for item in scene.objects:
        shift = first.count if item.start > first.start else 0
        objects.append(dataclasses.replace(item, start=item.start - shift, count=0 if item.id == 1 else item.count))
    groups = [dataclasses.replace(g, anchor_index=-1) if g.id == 1 else g for g in scene.groups]
    groups = [
        dataclasses.replace(g, anchor_index=g.anchor_index - first.count) if g.anchor_index > first.start else g
        for g in groups
    ]
    shading = dataclasses.replace(scene.shading, vectors=scene.shading.vectors[kept])
    gaussians = dataclasses.replace(scene.gaussians, **arrays)
    without = dataclasses.replace(
        scene, gaussians=gaussians, objects=tuple(objects), groups=tuple(groups), shading=shading
    )
    before = sorted([*before, "empty.r5dgs"])
    empty = scene_file.write(without, tmp_path / "empty.r5dgs")
    assert "mug: no Gaussians, so there is nothing to draw" in line("--out", out, "--objects", "mug", file=empty)


GAUSSIANS = ("means", "quats", "log_scales", "opacity_logits", "sh", "object_ids", "motion_ids", "identities")


@pytest.mark.parametrize("name", ["a.mp4", "a.png", "a.exr", "frames"])
def test_a_refused_write_is_one_line_and_leaves_nothing(path, tmp_path, monkeypatch, capsys, name):
    folder = tmp_path / "folder"
    folder.mkdir()

    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr("r5dgs_core.atomic_files.open", refuse, raising=False)  # also refuses the tester who is root
    given = ("render", path, "--out", folder / name, "--time", "0.5", "--size", "64")
    line = complaint(capsys, *given)
    assert "Permission denied" in line and str(folder) in line
    monkeypatch.undo()
    left = [p for p in folder.rglob("*") if p.is_file()]
    assert left == []


def test_remains_of_a_killed_process_are_removed_and_writes_in_progress_left(path, tmp_path, capsys):
    out = tmp_path / "a.mp4"
    remains = [tmp_path / f".a.mp4.{'0a' * 8}.mp4", tmp_path / ".a.mp4.placeholder"]
    others = [tmp_path / ".a.mp4.mine.mp4", tmp_path / f".b.mp4.{'0a' * 8}.mp4"]
    for file in remains + others:
        file.write_text("half")
    given = ("render", path, "--out", out, "--time", "0.5", "--size", "64")
    with folder_lock.try_file(remains[1]):
        assert "another process writes this file" in complaint(capsys, *given)
        assert remains[0].exists() and not out.exists()
    assert main.main(list(map(str, given))) == 0
    assert [file.exists() for file in (out, *remains, *others)] == [True, False, False, True, True]


def test_an_existing_file_is_replaced_only_on_demand(path, tmp_path, capsys):
    (tmp_path / "a.mp4").write_text("mine")
    given = ("render", path, "--out", tmp_path / "a.mp4", "--time", "0.5", "--seconds", "0.1")
    assert "--overwrite" in complaint(capsys, *given)
    assert (tmp_path / "a.mp4").read_text() == "mine"
    assert main.main([*map(str, given), "--overwrite"]) == 0
    assert (tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp"
