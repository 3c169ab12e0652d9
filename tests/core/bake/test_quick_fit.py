"""The fit without images predicts like baking, and training names what it cannot predict."""

import dataclasses
import json
import shutil
import signal

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.bake import bake, quick_fit
from r5dgs_core.cli.commands import train
from r5dgs_core.motion.history import Band, History
from tests.support import tiny_datasets


def test_the_fit_without_images_has_bands_and_no_errors_of_poses(trained, baked):
    scene = quick_fit.scene_of(trained)
    assert [group.role for group in scene.groups] == [group.role for group in baked.groups]
    moving = [g for g in scene.groups if g.role == "body" and np.any(scene.tracks.poses[g.id, :, 1:] != 0)]
    assert moving and all(group.history.band is not None and group.history.errors is None for group in moving)


def doubtful(fit):
    """Return a function that returns the scene of another one, with an object that is not predictable."""

    def changed(*given):
        scene = fit(*given)
        band = Band((scene.t_max, 2 * scene.t_max), (0.0, 9.0), (0.0, 0.0), predictable_until=0.85)
        groups = [dataclasses.replace(g, history=History(band=band)) if g.id == 1 else g for g in scene.groups]
        return dataclasses.replace(scene, groups=tuple(groups))

    return changed


def test_training_names_objects_whose_motion_is_not_predictable(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(quick_fit, "scene_of", doubtful(quick_fit.scene_of))
    settings = [*tiny_datasets.SETTINGS, "train.iterations=3", "identity.iterations=1"]
    for kind in ("json", "auto", "none"):
        resume = kind != "json"
        given = {"config_path": None, "overrides": [] if resume else settings, "resume": resume, "overwrite": False}
        train.run_train(tiny.root, tmp_path / "run", progress_kind=kind, **given)
        lines = capsys.readouterr().out.splitlines()
        wanted = {"event": "warning", "text": "brick: not predictable past 0.85"}
        if kind == "json":
            assert wanted in [json.loads(line) for line in lines]
        else:
            assert (wanted["text"] in lines) == (kind == "auto")


@pytest.mark.parametrize("kind", ["json", "auto"])
def test_training_with_a_scene_file_names_them_by_that_scene_and_fits_no_other(
    trained, tiny, tmp_path, monkeypatch, capsys, kind
):
    run = shutil.copytree(trained.folder, tmp_path / "run")
    monkeypatch.setattr(quick_fit, "scene_of", lambda run: pytest.fail("the motion is fitted twice"))
    monkeypatch.setattr(bake, "bake", doubtful(bake.bake))
    given = {"config_path": None, "overrides": [], "resume": True, "overwrite": False, "scene": tmp_path / "a.r5dgs"}
    train.run_train(tiny.root, run, progress_kind=kind, **given)
    lines, text = capsys.readouterr().out.splitlines(), "brick: not predictable past 0.85"
    if kind == "json":
        assert json.loads(lines[-1]) == {"event": "warning", "text": text}
    else:
        (line,) = [line for line in lines if "not predictable past 0.85" in line]
        assert line.startswith("  brick: ")  # of the summary


def test_stopping_while_the_scene_file_is_made_names_the_command_that_makes_it(trained, tiny, tmp_path, monkeypatch):
    run = shutil.copytree(trained.folder, tmp_path / "run")
    monkeypatch.setattr(bake, "bake", lambda *_: signal.raise_signal(signal.SIGINT))
    given = {"config_path": None, "overrides": [], "resume": True, "overwrite": False, "scene": tmp_path / "a.r5dgs"}
    with pytest.raises(errors.Interrupted, match=f"is trained; .*r5dgs bake {run} --out {tmp_path / 'a.r5dgs'}"):
        train.run_train(tiny.root, run, progress_kind="none", **given)
