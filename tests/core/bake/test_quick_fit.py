"""The fit without images predicts like baking, and training names what it cannot predict."""

import dataclasses
import json

import numpy as np

from r5dgs_core.bake import quick_fit
from r5dgs_core.cli.commands import train
from r5dgs_core.motion.history import Band, History
from tests.support import tiny_datasets


def test_the_fit_without_images_has_bands_and_no_errors_of_poses(trained, baked):
    scene = quick_fit.scene_of(trained)
    assert [group.role for group in scene.groups] == [group.role for group in baked.groups]
    moving = [g for g in scene.groups if g.role == "body" and np.any(scene.tracks.poses[g.id, :, 1:] != 0)]
    assert moving and all(group.history.band is not None and group.history.errors is None for group in moving)


def test_training_names_objects_whose_motion_is_not_predictable(tiny, tmp_path, monkeypatch, capsys):
    fit = quick_fit.scene_of

    def doubtful(run):
        scene = fit(run)
        band = Band((scene.t_max, 2 * scene.t_max), (0.0, 9.0), (0.0, 0.0), predictable_until=0.85)
        groups = [dataclasses.replace(g, history=History(band=band)) if g.id == 1 else g for g in scene.groups]
        return dataclasses.replace(scene, groups=tuple(groups))

    monkeypatch.setattr(quick_fit, "scene_of", doubtful)
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
