"""The report's tasks on scenes whose motion is known: integrators, poses, pictures, thresholds."""

import csv
import dataclasses
import json
import math

import numpy as np
import pytest

from r5dgs_core import errors, timing
from r5dgs_core.cli import main
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images
from r5dgs_core.error_vs_time import (
    candidate_count_task,
    image_task,
    integrator_task,
    pose_task,
    rasterizer_task,
    report_rows,
    tables,
    task_names,
    tasks,
)
from r5dgs_core.error_vs_time import report as error_vs_time_report
from r5dgs_core.evaluation import ground_truth_poses, lpips
from r5dgs_core.motion import models, se3
from r5dgs_core.motion.history import EMPTY, Band, History
from r5dgs_core.motion_fit import candidates
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import lpips_weights, pictures, scenes
from tests.support.command_line import complaint

pytestmark = pytest.mark.heavy

BACKEND = pictures.BACKEND


FAMILY = ("static", "translation, quadratic", "constant twist", "hinge", "ballistic + spin, accelerating")


def choose_from(patch, names):
    """Fit only these candidate motions."""
    patch.setattr(candidates, "FAMILY", tuple(candidates.BY_NAME[name] for name in names))


def hurry(patch):
    """Use one call per turn, few frames and two candidate motions; other tests check the quality of the fit."""
    patch.setattr(timing, "SAMPLE_MS", 0.0)
    patch.setattr(image_task, "FRAMES", 1)
    patch.setattr(rasterizer_task, "VIEWS", 1)
    patch.setattr(rasterizer_task, "SETTINGS", ({}, *({"alpha_min": a} for a in (1 / 1000, 4 / 255, 16 / 255))))
    patch.setattr(pose_task, "MODELS", ("static", "hinge"))
    choose_from(patch, FAMILY[:2])


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    hurry(monkeypatch)


@pytest.fixture(scope="module")
def scene():
    """A scene whose bodies have wide confidence bands."""
    made = scenes.make_scene(n=240, objects=4, seed=5, identities=False)
    wide = History(band=Band((made.t_max, 2.0), (1.0, 1.0), (1.0, 1.0)))
    groups = [dataclasses.replace(g, history=wide) if g.role == "body" else g for g in made.groups]
    return dataclasses.replace(made, groups=tuple(groups))


@pytest.fixture(scope="module")
def field(scene):
    """The same scene with dynamics of its Gaussians."""
    rng = np.random.default_rng(0)
    dynamics = np.where(
        scene.gaussians.motion_ids[:, None] > 0, rng.normal(scale=0.3, size=(len(scene.gaussians.means), 12)), 0
    )
    return scene.with_arrays(dynamics=dynamics.astype(np.float32), canonical_means=scene.gaussians.means)


@pytest.fixture(scope="module")
def data(scene, tmp_path_factory):
    return pictures.write_dataset(tmp_path_factory.mktemp("own pictures"), scene)


def changed_group(scene, index, **model):
    groups = list(scene.groups)
    groups[index] = dataclasses.replace(groups[index], model=dataclasses.replace(groups[index].model, **model))
    return dataclasses.replace(scene, groups=tuple(groups))


def pick(rows, **wanted):
    return [row for row in rows if all(getattr(row, name) == value for name, value in wanted.items())]


def only(rows, **wanted):
    (row,) = pick(rows, **wanted)
    return row


# Integrators.


@pytest.mark.default_cases("Magnus-4-4.0", "trace_rk2, per group-2.0")
@pytest.mark.parametrize(
    ("method", "order"),
    [("Magnus-4", 4.0), ("Magnus-2", 2.0), ("trace_rk2, per group", 2.0), ("trace_rk2, per Gaussian", 2.0)],
)
def test_integrators_show_their_order(scene, method, order):
    turning = changed_group(
        scene, 1, kind="world_twist", angular_velocity=[0, 3.0, 1.0], angular_acceleration=[2.0, 0, 0.5]
    )
    alone = dataclasses.replace(turning, groups=(*turning.groups[:2], *static(turning.groups[2:])))
    rows, _ = integrator_task.measure(alone, 1.0, 1)
    coarse, fine = (only(rows, method=method, setting=f"{n} steps", error_kind="position").error for n in (16, 32))
    assert math.log2(coarse / fine) == pytest.approx(order, abs=0.15)


def static(groups):
    return [dataclasses.replace(g, model=models.STATIC) for g in groups]


def test_exact_methods_have_no_error(scene):
    rows, _ = integrator_task.measure(scene, 0.5, 1)
    for kind in ("position", "rotation"):
        closed = only(rows, method="closed form", error_kind=kind)
        assert closed.error_worst < 1e-9 and closed.ms > 0 and closed.count == 4
        assert only(rows, method="Magnus-4", setting="step rule", error_kind=kind).error_worst < 1e-6


def test_the_state_of_a_model_is_its_twist():
    v, a, w, e = np.random.default_rng(1).normal(size=(4, 3))
    twist = models.MotionModel("world_twist", v, a, w, e)
    np.testing.assert_allclose(integrator_task.state_of(twist), [v, w, a, e], atol=1e-6)
    screw = models.MotionModel("constant_twist", v, angular_velocity=w)
    np.testing.assert_allclose(integrator_task.state_of(screw), [v, w, 0 * v, 0 * v], atol=1e-6)


def test_single_gaussians_are_integrated_if_there_are_dynamics(scene, field):
    rows, absent = integrator_task.measure(field, 0.25, 1)
    steps = only(rows, method="Magnus-4, own dynamics", error_kind="position")
    assert steps.count == int((scene.gaussians.motion_ids > 0).sum())
    assert steps.error_worst < 1e-3 and not absent
    trace = [only(rows, method="trace_rk2, own dynamics", setting=s, error_kind="position").error for s in TRACE]
    assert trace == sorted(trace, reverse=True) and trace[0] > steps.error
    _, absent = integrator_task.measure(scene, 0.25, 1)
    assert any("holds none" in text for text in absent)


TRACE = [f"{n} step{'s' * (n > 1)}" for n in integrator_task.POINT_STEPS]


def test_a_scene_at_rest_has_nothing_to_integrate(scene):
    still = dataclasses.replace(scene, groups=tuple(static(scene.groups)))
    rows, absent = integrator_task.measure(still, 0.25, 1)
    assert rows == [] and any("no group of the scene moves" in text for text in absent)


# Poses.


def test_a_perfect_scene_has_no_pose_error_and_a_wrong_one_has_the_difference(scene, data):
    rows, _ = pose_task.measure(scene, data.ground_truth, 1)
    mine = only(rows, method="group poses", error_kind="position")
    assert mine.error_worst < 1e-6 and mine.count == 4
    moved = changed_group(scene, 2, velocity=np.asarray(scene.groups[2].model.velocity) + [0, 0, 0.6])
    rows, _ = pose_task.measure(moved, data.ground_truth, 1)
    off = only(rows, method="group poses", error_kind="position")
    assert off.error_worst == pytest.approx(0.6 * 0.25 / (2 * scene.groups[2].model.radius), rel=1e-5)
    assert off.error == pytest.approx(0, abs=1e-6)  # the median object is right
    early = only(rows, method="group poses", error_kind="position@t=0.85")
    assert early.error_worst == pytest.approx(0.4 * off.error_worst, rel=1e-5)


def test_each_motion_model_is_right_about_its_own_motion(scene, data, monkeypatch):
    """Offsets that fade in are noise of the fit: small scenes without them show the models themselves."""
    choose_from(monkeypatch, FAMILY)
    groups = tuple(
        dataclasses.replace(g, model=dataclasses.replace(g.model, offset_rotvec=[0] * 3, offset_displacement=[0] * 3))
        for g in scene.groups
    )
    plain = dataclasses.replace(scene, groups=groups)
    truth = truth_of(plain)
    rows, _ = pose_task.measure(plain, truth, 1)
    chosen = only(rows, method="chosen of the family", error_kind="position")
    assert chosen.error_worst < 0.02 and chosen.ms_once_cpu > 0
    assert only(rows, method="static", error_kind="position").error_worst > 0.2
    band = only(rows, error_kind="outside_band")
    assert band.error == 0 and math.isnan(band.ms) and not band.pareto


@pytest.mark.slow
def test_the_stored_band_is_compared_with_the_stored_motion(scene):
    truth = truth_of(scene)
    narrow = History(band=Band((scene.t_max, 2.0), (1e-6, 1e-6), (1e-6, 1e-6)))
    groups = list(scene.groups)
    groups[2] = dataclasses.replace(groups[2], history=narrow)
    off = changed_group(dataclasses.replace(scene, groups=tuple(groups)), 2, velocity=[5.0, 0, 0])
    rows, _ = pose_task.measure(off, truth, 1)
    count = sum(group.role == "body" for group in scene.groups)
    assert only(rows, error_kind="outside_band").error == pytest.approx(1 / count)
    bare = dataclasses.replace(scene, groups=tuple(dataclasses.replace(g, history=EMPTY) for g in scene.groups))
    rows, missing = pose_task.measure(bare, truth, 1)
    assert not pick(rows, error_kind="outside_band") and any("band" in line for line in missing)


def truth_of(scene):
    bodies = [group for group in scene.groups if group.role == "body"]
    times = np.array([0.0, 0.3, 0.75, 0.85, 1.0])
    return datasets.GroundTruth(
        times,
        tuple(g.object_id for g in bodies),
        tuple(scene.object(g.object_id).name for g in bodies),
        ground_truth_poses.motion(scene, bodies, times),
        scene.t_max,
    )


@pytest.mark.slow
def test_modes_of_single_gaussians_have_poses_too(field, data):
    rows, absent = pose_task.measure(field, data.ground_truth, 1)
    assert {row.mode for row in rows} >= {"standard", "rigid_paper", "rigid/median", "rigid"}
    assert only(rows, mode="standard", error_kind="position").error > 0.01
    assert any("hybrid" in text for text in absent)


def test_poses_without_ground_truth_are_listed_as_absent(scene, data):
    assert "no true poses" in pose_task.measure(scene, None, 1)[1][0]
    truth = data.ground_truth
    early = dataclasses.replace(truth, times=truth.times[:3], matrices=truth.matrices[:, :3])
    rows, absent = pose_task.measure(scene, early, 1)
    assert rows == [] and "past t_max" in absent[0]


def test_poses_and_matrices_are_inverse():
    rng = np.random.default_rng(3)
    quat, displacement, pivot = rng.normal(size=4), rng.normal(size=3), rng.normal(size=3)
    quat /= np.copysign(np.linalg.norm(quat), quat[0])
    back = se3.matrix_to_pose(pivot, se3.pose_to_matrix(pivot, quat, displacement))
    np.testing.assert_allclose(back[0] * np.sign(back[0][0]), quat, atol=1e-12)
    np.testing.assert_allclose(back[1], displacement, atol=1e-12)


@pytest.mark.slow
def test_a_larger_family_takes_longer_and_the_worst_object_is_named(scene, data):
    rows, _ = candidate_count_task.measure(scene, data.ground_truth)
    found = pick(rows, error_kind="position")
    assert [row.setting for row in found][-1] == candidate_count_task.WHOLE and found[0].method == "1 candidate"
    names = {o.name for o in scene.objects}
    assert all(row.worst_name in names and row.clock == "cpu" and row.ms > 0 for row in found)
    assert found[-1].error_worst < found[0].error_worst  # a body at rest is no candidate for the others


# Pictures.


def test_true_poses_are_the_oracle_of_a_scene_with_a_wrong_future(scene, data):
    wrong = changed_group(scene, 2, velocity=np.asarray(scene.groups[2].model.velocity) + [0, 0, 2.0])
    rows, _ = image_task.measure(wrong, data, ("test",), 1, backend=BACKEND)
    ours, oracle = (only(rows, method=m, error_kind="psnr") for m in ("playback", image_task.ORACLE))
    assert ours.error < 40 < 55 < oracle.error
    assert ours.ms == pytest.approx(ours.ms_motion + ours.ms_raster)
    assert only(rows, method="playback", error_kind="miou").error < 1


def test_there_is_no_oracle_without_true_poses_at_the_times_of_the_views(scene, data):
    blind = dataclasses.replace(data, ground_truth=None)
    network = lpips.Lpips(lpips.NETWORKS["alex"], lpips_weights.tensors("alex"))
    rows, absent = image_task.measure(scene, blind, ("test",), 1, backend=BACKEND, perceptual=network)
    assert only(rows, error_kind="lpips").error == pytest.approx(0, abs=1e-3)  # its own pictures
    assert not pick(rows, method=image_task.ORACLE) and any("ground_truth.json" in text for text in absent)
    move, why = image_task.true_move(scene, data, [0.8])
    assert move is None and "t = 0.8" in why


# The rasterizer.


def test_coarser_thresholds_differ_more_from_the_finest_picture(scene, data):
    rows, _ = rasterizer_task.measure(scene, data.test, 1, backend=BACKEND)
    settings = ("alpha 0.26/255", "3DGS (alpha 1/255, stop 0.0001)", "alpha 4/255", "alpha 16/255")
    errors_ = [only(rows, setting=s, error_kind="difference").error for s in settings]
    assert errors_ == sorted(errors_) and errors_[0] < errors_[-1]
    assert only(rows, setting="finest", error_kind="psnr").error > 30


def test_without_a_data_set_the_cameras_of_the_scene_serve(scene):
    rows, absent = rasterizer_task.measure(scene, (), 1, backend=BACKEND)
    assert {row.error_kind for row in rows} == {"difference"} and "needs a data set" in absent[0]
    assert rasterizer_task.measure(dataclasses.replace(scene, cameras=()), (), 1, backend=BACKEND)[0] == []


# All of it.


def whole(scene, data=None, place=None, **options):
    """The report on one run."""
    chosen = error_vs_time_report.Options(rounds=1, backend=BACKEND, **options)
    return error_vs_time_report.collect([error_vs_time_report.measure(scene, data, chosen, place=place)], chosen)


@pytest.fixture(scope="module")
def report(field, data):
    with pytest.MonkeyPatch.context() as patch:
        hurry(patch)
        return whole(field, data, splits=("test", "val"))


@pytest.mark.slow
def test_the_report_is_written_for_programs_and_people(report, field, tmp_path):
    paths = error_vs_time_report.write(report, tmp_path / "deep" / "out")
    by_name = {path.name: path for path in paths}
    assert json.loads(by_name["report.json"].read_text()) == report
    table = list(csv.DictReader(by_name["report.csv"].open()))
    assert len(table) == len(report["rows"]) and {row["task"] for row in table} == {*task_names.TASKS} - {"training"}
    text = by_name["report.md"].read_text()
    for word in (
        "Magnus-4",
        "outside 95 % band",
        "rigid/least_squares",
        "true poses",
        "PSNR",
        "alpha 4/255",
        "Not measured",
    ):
        assert word in text
    picture = images.read_png(by_name["report.png"])
    assert picture.ndim == 3 and picture.std() > 5


@pytest.mark.slow
def test_every_mode_is_shown_past_t_max_and_one_before(report, field):
    rows = report_rows.from_dicts(report["rows"])
    assert {row.mode for row in pick(rows, method="playback", error_kind="psnr")} == set(scene_player.modes(field))
    assert {row.mode for row in pick(rows, error_kind="psnr@val")} == {"rigid"}
    assert any("all modes are the same up to t_max" in text for text in report["scenes"][0]["absent"])


def test_the_tasks_have_the_names_and_the_order_of_the_command_line():
    assert tuple(tasks.BY_NAME) == task_names.TASKS


@pytest.mark.slow
def test_every_task_has_a_front(report):
    rows = report_rows.from_dicts(report["rows"])
    for task, kind in (("dynamics", "rotation"), ("poses", "position"), ("images", "psnr"), ("raster", "difference")):
        assert 1 <= len([r for r in pick(rows, task=task, error_kind=kind) if r.pareto]) < len(pick(rows, task=task))


@pytest.mark.slow
def test_the_terminal_shows_the_tables_and_absent_tasks(report, capsys):
    tables.show(report)
    text = capsys.readouterr().out
    assert "Dynamics" in text and "Poses along the horizon" in text and "not measured" in text
    assert "wall ms" in text and "processor ms" in text and "recommended: images" in text


def test_tasks_without_their_data_are_listed_as_absent(scene, tmp_path):
    report = whole(scene, tasks=("poses", "images", "raster", "training"))
    text = "\n".join(report["scenes"][0]["absent"])
    assert "training: a scene file holds no log" in text
    assert "poses: no data set" in text and "images: no data set" in text and "dynamics: not requested" in text
    assert report["scenes"][0]["horizon"] == {"tau": pytest.approx(0.25), "why": "a third of the observed time"}
    error_vs_time_report.write(report, tmp_path)


def test_a_report_without_any_row_is_still_written(scene, tmp_path):
    nothing = whole(scene, tasks=("poses",))
    assert nothing["rows"] == [] and len(error_vs_time_report.write(nothing, tmp_path)) == 4


@pytest.mark.slow
def test_the_command_reports_a_scene_file(scene, data, tmp_path, capsys):
    path = tmp_path / "s.r5dgs"
    scene_file.write(scene, path)
    given = ["report", str(path), str(data.root), "--out", str(tmp_path / "out"), "--repeats", "1"]
    assert main.main([*given, "--tasks", "dynamics", "poses", "--progress", "none"]) == 0
    assert "written" in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"report.json", "report.csv", "report.md", "report.png"}
    alone = ["report", str(path), "--out", str(tmp_path / "alone"), "--tasks", "images"]
    assert main.main([*alone, "--progress", "none"]) == 3
    assert f"--tasks images: require the data set: r5dgs report {path} DATA" in capsys.readouterr().err
    assert not (tmp_path / "alone").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "RUN|SCENE and --out DIR, or --stability"),
        (["x.r5dgs", "--out", "o", "--tasks", "poise"], "--tasks: invalid choice: 'poise'"),
        (["x.r5dgs", "--out", "o", "--splits", "tset"], "--splits: invalid choice: 'tset'"),
        (["x.r5dgs", "--out", "o", "--repeats", "0"], "--repeats: expected an integer of at least 1"),
    ],
)
def test_a_wrong_call_is_an_error_of_one_line(arguments, words, capsys):
    assert words in complaint(capsys, "report", *arguments, status=ExitStatus.USAGE)


def test_an_unwritable_report_raises(scene, tmp_path):
    (tmp_path / "file").write_text("mine")
    report = whole(scene, tasks=("poses",))
    with pytest.raises(errors.ConfigError, match="--out"):
        error_vs_time_report.write(report, tmp_path / "file")
