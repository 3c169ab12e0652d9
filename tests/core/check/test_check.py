"""`r5dgs check` lists every fault of a file by its code, and every code is documented and has a case here."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import check, errors, findings
from r5dgs_core.check import codes, data
from r5dgs_core.cli import main
from r5dgs_core.data import images
from r5dgs_core.motion import models
from r5dgs_core.scene import scene_file, validation
from tests.core.data.test_dataset import HEIGHT, WIDTH, camera_matrix, write_flat
from tests.support import captures, colmap_files, scenes

DOCS = Path(__file__).resolve().parents[3] / "docs" / "reference" / "check.md"
CASES = {}


def case(code):
    """Register a function that makes a fault of this code in a new folder and returns what to check."""

    def register(make):
        assert code not in CASES
        CASES[code] = make
        return make

    return register


def cameras_changed(root, change, split="train"):
    """A data set with one change of a camera file."""
    content = write_flat(root)[split]
    change(content)
    (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return root


def frame_changed(root, number=0, split="train", **values):
    return cameras_changed(root, lambda content: content["frames"][number].update(values), split)


def file_written(root, name, content):
    write_flat(root)
    path = root / name
    path.write_bytes(content) if isinstance(content, bytes) else path.write_text(json.dumps(content))
    return root


def reconstruction(root, views=4, images_written=4, lens=colmap_files.PINHOLE):
    registered = {f"a_{k:02d}.png": scenes.orbit_camera(0.4 * k, WIDTH, HEIGHT) for k in range(views)}
    for k in range(images_written):
        images.write_png(root / "images" / f"a_{k:02d}.png", np.full((HEIGHT, WIDTH, 3), k, np.uint8))
    colmap_files.write(root / "sparse" / "0", registered, np.zeros((1, 3)), model=lens)
    return root


def mask_written(root, ids):
    write_flat(root)
    images.write_png(root / "object_mask" / "train" / "r_000.png", np.asarray(ids, np.uint8))
    return root


def scene_changed(root, arrays=None, **changes):
    scene = scenes.make_scene(n=60, objects=2).with_arrays(**(arrays or {}))
    return scene_file.write(dataclasses.replace(scene, **changes), root / "s.r5dgs")


def moved_by(root, frames_per_unit=60.0, radius=0.3, **rates):
    scene = scenes.make_scene(n=60, objects=2)
    model = models.MotionModel(radius=radius, **rates)
    groups = tuple(dataclasses.replace(g, model=model) if g.id == 1 else g for g in scene.groups)
    return scene_changed(root, groups=groups, frames_per_unit=frames_per_unit)


@case("D00")
def _(root):
    matrix = np.eye(4)
    matrix[0, 3] = 1e300
    return frame_changed(root, transform_matrix=matrix.tolist())


@case("D01")
def _(root):
    return root


@case("D02")
def _(root):
    return file_written(root, "transforms_val.json", b'{"frames": [')


@case("D03")
def _(root):
    return frame_changed(root, file_path=7)


@case("D04")
def _(root):
    return cameras_changed(root, lambda content: content["frames"][2].pop("time"))


@case("D05")
def _(root):
    return frame_changed(root, transform_matrix=[[1, 2], [3, 4]])


@case("D06")
def _(root):
    matrix = np.array(camera_matrix(0)).astype(object)
    matrix[0, 3] = None
    return frame_changed(root, transform_matrix=matrix.tolist())


@case("D07")
def _(root):
    return frame_changed(root, transform_matrix=np.diag([1.0, 1.0, -1.0, 1.0]).tolist())


@case("D08")
def _(root):
    return frame_changed(root, k1=0.2)


@case("D09")
def _(root):
    return frame_changed(root, w=2 * WIDTH, h=HEIGHT)


@case("D10")
def _(root):
    return frame_changed(root, file_path="train/nowhere")


@case("D11")
def _(root):
    (root / "film.mp4").write_bytes(b"film")
    return frame_changed(root, file_path="film.mp4")


@case("D12")
def _(root):
    write_flat(root)
    path = root / "train" / "r_001.png"
    path.write_bytes(path.read_bytes()[:-20])
    return root


@case("D13")
def _(root):
    return frame_changed(root, file_path="./train/r_001")


@case("D14")
def _(root):
    return reconstruction(root, lens=colmap_files.OPENCV)


@case("D15")
def _(root):
    return reconstruction(root, 4, 20)


@case("D16")
def _(root):
    reconstruction(root, 3, 4)
    (root / "times.json").write_text(json.dumps({"a_00.png": 0.0, "a_01.png": 0.1, "a_02.png": 0.2, "a_03.png": 0.3}))
    return root


@case("D17")
def _(root):
    write_flat(root)
    (root / "object_mask" / "train" / "r_002.png").write_bytes(b"no mask")
    return root


@case("D18")
def _(root):
    return mask_written(root, np.ones((5, 5)))


@case("D19")
def _(root):
    ids = np.zeros((HEIGHT, WIDTH, 3))
    ids[..., 1] = np.arange(WIDTH)
    ids[..., 2] = 9 * np.arange(HEIGHT)[:, None]
    return mask_written(root, ids)


@case("D20")
def _(root):
    return file_written(root, "objects.json", {"one": "mug"})


@case("D21")
def _(root):
    return file_written(root, "ground_truth.json", {"times": [0, 1]})


@case("D22")
def _(root):
    return file_written(root, "object_mask/masks.json", {"format_version": 99})


@case("D23")
def _(root):
    return cameras_changed(root, lambda content: content.update(frames_per_unit=-1))


@case("D24")
def _(root):
    return cameras_changed(root, lambda content: content.update(frames=[]))


@case("D25")
def _(root):
    write_flat(root)
    np.save(root / "points.npy", np.zeros((4, 5)))
    return root


@case("D40")
def _(root):
    return frame_changed(root, split="test", file_path="./train/r_000")


@case("D41")
def _(root):
    return frame_changed(root, split="val", time=0.9)


@case("D42")
def _(root):
    return frame_changed(root, split="test", time=0.3)


@case("D43")
def _(root):
    return cameras_changed(root, lambda content: [frame.update(time=0.5) for frame in content["frames"]])


@case("D44")
def _(root):
    return cameras_changed(root, lambda content: [frame.pop("time") for frame in content["frames"]])


@case("D45")
def _(root):
    return frame_changed(root, 4, time=0.1)


@case("D46")
def _(root):
    turned = np.array(camera_matrix(0.7)) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    return cameras_changed(
        root,
        lambda content: content["frames"].append(
            {**content["frames"][0], "file_path": "./val/r_000", "transform_matrix": turned.tolist()}
        ),
    )


@case("D47")
def _(root):
    write_flat(root)
    return root


@case("D48")
def _(root):
    write_flat(root)
    (root / "object_mask" / "train" / "r_000.png").unlink()
    return root


@case("D49")
def _(root):
    return mask_written(root, np.full((HEIGHT, WIDTH), 7))


@case("D50")
def _(root):
    return mask_written(root, np.full((HEIGHT, WIDTH), 7))


@case("D51")
def _(root):
    write_flat(root)
    shutil.copy(root / "train" / "r_000.png", root / "train" / "r_001.png")
    return root


@case("D52")
def _(root):
    return file_written(root, "objects.json", {"1": "mug", "2": "red \x1b[31m"})


@case("D53")
def _(root, monkeypatch):
    monkeypatch.setattr(data, "MIN_SPACE", 1 << 62)
    write_flat(root)
    return root


@case("D54")
def _(root):
    return reconstruction(root, 4, 5)


@case("D55")
def _(root):
    return file_written(root, "objects.json", {"1": "mug", "2": "red apple", "3": "ghost"})


@case("D60")
def _(root):
    return captures.make(root, turned=np.diag([-1.0, 1.0, -1.0]))


@case("D61")
def _(root):
    return captures.make(root, angles=(0.0, 0.01, 0.02))


@case("D62")
def _(root):
    return captures.make(root, drawn=captures.dimmed((0.8, 0.8, 0.8)))


@case("D63")
def _(root):
    return captures.make(root, drawn=captures.dimmed((-0.12, 0.0, 0.25)))


@case("D64")
def _(root):
    return captures.make(root, drawn=captures.blurred)


@case("D65")
def _(root):
    return captures.make(root, drawn=captures.rolling)


@case("D66")
def _(root):
    return captures.make(root, times=(captures.TIMES, np.delete(captures.TIMES, [4, 20]), captures.TIMES))


@case("D67")
def _(root):
    return captures.make(root, drawn=captures.late)


@case("D68")
def _(root):
    return captures.make(root, masks=captures.disagreeing)


@case("D69")
def _(root):
    return captures.make(root, masks=captures.lonely)


@case("D70")
def _(root):
    write_flat(root)
    shutil.rmtree(root / "object_mask")
    for path in (root / "train").glob("*.png"):
        images.write_png(path, np.full((960 + HEIGHT, (960 + HEIGHT) * WIDTH // HEIGHT, 3), 90, np.uint8))
    return root


@case("D71")
def _(root):
    return captures.make(root, drawn=captures.repeated)


@case("D72")
def _(root):
    write_flat(root)
    shutil.rmtree(root / "object_mask")
    unknown = {"offset_ms": 0.0, "offset_sigma_ms": None, "gaps": []}
    content = {"format_version": 1, "cameras": [{"name": "a", **unknown}, {"name": "b", **unknown}]}
    (root / "capture.json").write_text(json.dumps(content))
    return root


@case("S01")
def _(root):
    path = scene_changed(root)
    path.write_bytes(path.read_bytes()[:-200])
    return path


@case("S02")
def _(root):
    return scene_file.write(scenes.make_scene(n=0, objects=0, unassigned=0, shadows=False), root / "s.r5dgs")


@case("S10")
def _(root):
    scene = scenes.make_scene(n=60, objects=2)
    lost = dataclasses.replace(scene.objects[-1], id=9, name="ghost", start=60, count=0, aliases=())
    return scene_changed(root, {"identities": None}, objects=(*scene.objects, lost))


@case("S11")
def _(root):
    return scene_changed(root, {"log_scales": np.full((60, 3), 5, np.float32)})


@case("S12")
def _(root):
    scene = scenes.make_scene(n=60, objects=2)
    return scene_changed(root, objects=(*scene.objects[:-1], dataclasses.replace(scene.objects[-1], name=" ")))


@case("S13")
def _(root):
    rates = {"velocity": [1e15, 0, 0], "angular_velocity": [1e6, 0, 1e6], "angular_acceleration": [0, 1e6, 0]}
    return moved_by(root, radius=1e-12, kind="world_twist", **rates)


@case("S14")
def _(root):
    return moved_by(root, kind="ballistic_spin", angular_velocity=[0, 0, 1e4])


@case("S15")
def _(root):
    return moved_by(root, frames_per_unit=1e9)


@case("S16")
def _(root):
    return scene_changed(root, {"opacity_logits": np.full(60, -20, np.float32)})


@pytest.fixture(scope="module")
def small_run(tiny, tmp_path_factory):
    """A run folder of a few steps."""
    from r5dgs_core.train import run
    from tests.support import tiny_datasets

    folder = tmp_path_factory.mktemp("small") / "run"
    settings = tiny_datasets.settings("train.iterations=4", "identity.iterations=2", "train.probe_every=0")
    return run.train(tiny.root, folder, settings).folder


@case("R01")
def _(root, run):
    (run / "run.json").write_text("{")
    return run


@case("R02")
def _(root, run):
    for path in run.glob("*.pt"):
        path.unlink()
    return run


@case("R03")
def _(root, run):
    path = run / "checkpoint.pt"
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(damaged)
    return run


@case("R04")
def _(root, run):
    (run / "evaluation.json").write_text("[]")
    return run


def run_changed(run, **values):
    path = run / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))
    return run


@case("R10")
def _(root, run):
    return run_changed(run, dataset=str(root / "nowhere"))


@case("R11")
def _(root, run):
    return run_changed(run, digest="0" * 64)


@case("R12")
def _(root, run):
    content = json.loads((run / "run.json").read_text())
    content["config"]["train"]["iterations"] = 4000
    return run_changed(run, config=content["config"])


@case("P01")
def _(root):
    path = root / "a.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 5\n")
    return path


@case("C01")
def _(root):
    path = root / "c.toml"
    path.write_text("[train]\niterations = -3\n")
    return path


def assert_found(found, code):
    """Fail unless a code is among findings, with a complete text."""
    ours = [finding for finding in found if finding.code == code]
    assert ours, [str(finding) for finding in found]
    for finding in ours:
        assert finding.severity == codes.CODES[code].severity and finding.remedy and finding.problem and finding.place
        assert re.match(rf"{code} (error|warning) [^\n]+: .+ Remedy: .+", str(finding), re.DOTALL)


def test_every_code_has_a_case():
    assert set(codes.CODES) == set(CASES)


# Faults of captures are found in test_capture.py.
@pytest.mark.parametrize("code", [code for code in codes.CODES if not "D60" <= code < "E"])
def test_every_code_is_found_at_its_fault(code, tmp_path, monkeypatch, request):
    make, options = CASES[code], {}
    if code.startswith("R"):
        options["run"] = shutil.copytree(request.getfixturevalue("small_run"), tmp_path / "run")
    if "monkeypatch" in make.__code__.co_varnames:
        options["monkeypatch"] = monkeypatch
    assert_found(check.check(make(tmp_path, **options)), code)


def test_every_code_is_documented_with_its_texts():
    rows = [line.strip("| ").split(" | ") for line in DOCS.read_text().splitlines() if re.match(r"\| [A-Z]\d\d ", line)]
    assert [row[0] for row in rows] == list(codes.CODES)
    for name, severity, meaning, remedy in rows:
        code = codes.CODES[name]
        assert (severity, meaning, remedy) == (code.severity, code.meaning, code.remedy)


def test_codes_of_readers_are_in_the_table():
    sources = (Path(check.__file__).parents[1]).rglob("*.py")
    given = re.compile(r'(?:code=|coded\(|add\(\s*)"([A-Z]\d\d)"')
    used = {code for path in sources for code in given.findall(path.read_text())}
    assert used <= set(codes.CODES) and len(used) > 30


def test_a_sound_data_set_and_scene_have_no_error(tmp_path, copied):
    assert [str(finding) for finding in check.check(copied)] == []
    assert [str(finding) for finding in check.check(scene_changed(tmp_path))] == []


def test_all_faults_are_listed_not_only_the_first(tmp_path):
    files = write_flat(tmp_path)
    frames = files["train"]["frames"]
    frames[0]["transform_matrix"] = None
    frames[1]["file_path"] = "train/nowhere"
    frames[2]["k1"] = 0.3
    (tmp_path / "transforms_train.json").write_text(json.dumps(files["train"]))
    (tmp_path / "transforms_val.json").write_text("{")
    (tmp_path / "objects.json").write_text("[]")
    (tmp_path / "object_mask" / "train" / "r_003.png").write_bytes(b"")
    (tmp_path / "object_mask" / "train" / "r_004.png").write_bytes(b"")
    (tmp_path / "train" / "r_005.png").write_bytes((tmp_path / "train" / "r_005.png").read_bytes()[:-20])
    found = check.check(tmp_path)
    assert {"D02", "D05", "D08", "D10", "D12", "D17", "D20"} <= {finding.code for finding in found}
    assert sum(finding.code == "D17" for finding in found) == 2
    severities = [finding.severity for finding in found]
    assert severities == sorted(severities)


def test_the_reader_raises_the_first_of_the_faults_that_check_lists(tmp_path):
    for name in ("D05", "D07", "D10", "D13", "D18", "D20", "D21", "D23"):
        root = CASES[name](tmp_path / name) if (tmp_path / name).mkdir() is None else None
        try:
            from r5dgs_core.data import dataset

            found = dataset.read(root)
            for view in found.train:
                dataset.load_mask(view)
        except errors.DatasetError as error:
            assert error.code == name
            listed = [finding for finding in check.check(root) if finding.code == name]
            assert str(error).startswith(listed[0].place)
        else:
            pytest.fail(f"{name} was accepted")


def test_the_data_of_a_run_are_checked_as_the_run_reads_them(tmp_path, small_run):
    run, root = tmp_path / "run", tmp_path / "data"
    shutil.copytree(small_run, run)
    content = json.loads((run / "run.json").read_text())
    shutil.copytree(content["dataset"], root)
    mask = next((root / "object_mask" / "train").rglob("*.png"))
    mask.write_bytes(b"no mask")
    run_changed(run, dataset=str(root))
    assert "D17" in {found.code for found in check.check(run)}
    content["config"]["data"]["masks"] = "none"
    run_changed(run, config=content["config"])
    assert not [str(found) for found in check.check(run) if found.severity == findings.ERROR]


def test_statuses_and_the_last_line(tmp_path, capsys):
    (tmp_path / "bad").mkdir()
    (tmp_path / "warned").mkdir()
    assert main.main(["check", str(CASES["D05"](tmp_path / "bad"))]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("D05 error ") and re.fullmatch(r"1 error, \d+ warnings?", lines[-1])
    assert main.main(["check", str(CASES["D52"](tmp_path / "warned"))]) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out and "0 errors, " in out.splitlines()[-1]
    assert main.main(["check", str(tmp_path / "nowhere")]) == 3
    (tmp_path / "notes.txt").write_text("x")
    assert main.main(["check", str(tmp_path / "notes.txt")]) == 3
    with pytest.raises(SystemExit) as stop:
        main.main(["check"])
    assert stop.value.code == 2


def test_json_has_the_same_findings(tmp_path, capsys):
    root = CASES["D05"](tmp_path)
    assert main.main(["check", str(root), "--json"]) == 1
    content = json.loads(capsys.readouterr().out)
    assert content["errors"] == 1 and content["errors"] + content["warnings"] == len(content["findings"])
    assert [findings.Finding(**row) for row in content["findings"]] == check.check(root)


def test_data_sets_and_scenes_are_checked_without_torch(tmp_path):
    write_flat(tmp_path)
    scene = scene_changed(tmp_path)
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from r5dgs_core.cli import main as cli\n"
        f"sys.exit(max(cli.main(['check', path]) for path in {[str(tmp_path), str(scene)]!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + done.stdout


def codes_of(path):
    return [finding.code for finding in check.check(path) if finding.severity == findings.ERROR]


def test_numbers_that_are_not_finite_are_faults_of_their_frames(tmp_path):
    def change(content):
        content["frames"][0]["transform_matrix"][0][3] = float("nan")
        content["frames"][1]["time"] = float("inf")
        content["frames"][2]["frame"] = float("nan")
        del content["frames"][3]["transform_matrix"]

    assert sorted(codes_of(cameras_changed(tmp_path, change))) == ["D03", "D03", "D05", "D06"]


def test_a_time_that_a_scene_file_cannot_hold_is_refused(tmp_path):
    root = frame_changed(tmp_path, time=1e300)
    assert codes_of(root) == ["D03"]
    with pytest.raises(errors.DatasetError, match="frame 0 .*'time'"):
        data.dataset.read(root)


def test_a_name_that_is_too_long_for_the_file_system_is_a_fault_of_its_frame(tmp_path):
    root = frame_changed(tmp_path, file_path="x" * 5000)
    assert codes_of(root) == ["D10"]


@pytest.mark.parametrize("content", [b"", b"[]", b'{"frames": [', b'{"frames": [7]}'])
def test_a_faulty_camera_file_is_not_reported_as_empty_too(content, tmp_path):
    assert len(codes_of(file_written(tmp_path, "transforms_train.json", content))) == 1


def test_training_images_with_faults_cause_no_warnings_about_the_others(tmp_path):
    def change(content):
        for frame in content["frames"][1:]:
            frame["transform_matrix"] = None

    found = {finding.code for finding in check.check(cameras_changed(tmp_path, change))}
    assert found & {"D05"} and not found & {"D41", "D42", "D43", "D47"}


def test_all_faults_of_objects_json_are_listed(tmp_path):
    names = {"1": "mug", "2": "mug", "3": {"name": 7}, "x": "pan", "4": {"name": "pot", "aliases": "lid"}}
    root = file_written(tmp_path, "objects.json", names)
    assert codes_of(root) == ["D20"] * 4


def test_damaged_images_are_not_called_unreadable_kinds(tmp_path):
    write_flat(tmp_path)
    first, second, third = sorted((tmp_path / "train").glob("*.png"))[:3]
    first.write_bytes(b"")
    second.unlink()
    second.mkdir()
    third.unlink()
    third.symlink_to(third.name)
    assert sorted(codes_of(tmp_path)) == ["D10", "D10", "D12"]


def test_a_damaged_first_image_with_alpha_hides_no_other_fault(tmp_path):
    write_flat(tmp_path)
    first, second = sorted((tmp_path / "train").glob("*.png"))[:2]
    images.write_png(first, np.random.default_rng(0).random((HEIGHT, WIDTH, 4)))
    first.write_bytes(first.read_bytes()[:-60])
    second.write_bytes(second.read_bytes()[:-20])
    assert codes_of(tmp_path) == ["D12", "D12"]


def test_each_video_beside_a_reconstruction_is_listed(tmp_path):
    root = reconstruction(tmp_path)
    for name in ("a.mp4", "b.mov"):
        (root / "images" / name).write_bytes(b"film")
    (root / "images" / "c.heic").write_bytes(b"image")
    found = check.check(root)
    assert [finding.code for finding in found].count("D11") == 2
    assert any(finding.code == "D54" and "c.heic" in finding.problem for finding in found)


def test_a_run_without_valid_checkpoint_is_not_advised_to_resume(small_run, tmp_path):
    run = shutil.copytree(small_run, tmp_path / "run")
    for name in ("checkpoint.pt", "checkpoint.previous.pt"):
        (run / name).write_bytes(b"damaged")
    remedies = [finding.remedy for finding in check.check(run) if finding.code == "R03"]
    assert remedies == ["train again with --overwrite"] * 2


def test_all_faults_of_a_scene_are_listed(tmp_path, monkeypatch):
    scene = scenes.make_scene(n=60, objects=3)
    groups = [dataclasses.replace(g, role="ghost" if g.id in (1, 2) else g.role) for g in scene.groups]
    means = scene.gaussians.means.copy()
    means[3] = np.nan
    broken = dataclasses.replace(
        scene.with_arrays(means=means, quats=3 * scene.gaussians.quats), groups=tuple(groups), frames_per_unit=-1.0
    )
    monkeypatch.setattr(scene_file.validation, "check", lambda *_: None)
    path = scene_file.write(broken, tmp_path / "s.r5dgs", precision="exact")
    monkeypatch.undo()
    found = check.check(path)
    assert {finding.code for finding in found} == {"S01"}
    for part in ("means", "quats", "motion group 1", "motion group 2", "frames_per_unit"):
        assert any(finding.problem.startswith(part) for finding in found), part
    with pytest.raises(errors.SceneFileError, match="means"):
        scene_file.read(path)


def test_a_scene_with_unread_object_ids_is_checked_to_its_end():
    scene = scenes.make_scene()
    unread = dataclasses.replace(scene.gaussians, object_ids=findings.UNREAD)
    collect = findings.Collector(check.CODES, "S01")
    collect.add("S01", "x.r5dgs: object_ids: damaged")
    validation.check(dataclasses.replace(scene, gaussians=unread, frames_per_unit=0.0), "x.r5dgs", collect)
    assert [found.problem.split()[0] for found in collect.findings] == ["object_ids:", "frames_per_unit:"]


@pytest.mark.parametrize(
    "fault", [{"fl_x": -3}, {"camera_angle_x": 5}, {"w": "wide"}, {"h": 0}, {"k1": 0.1}], ids=lambda fault: [*fault][0]
)
def test_a_fault_of_a_whole_camera_file_is_listed_once(tiny, tmp_path, fault):
    root = tmp_path / "data"
    shutil.copytree(tiny.root, root)
    path = root / "transforms_train.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **fault}))
    (found,) = [finding for finding in check.check(root) if finding.severity == findings.ERROR]
    assert found.place == str(path) and "frame " not in found.problem
