import dataclasses
import json
import os

import numpy as np
import pytest

from r5dgs_core.scene import quality, scene_file
from tests.support import scenes


@pytest.fixture
def scene():
    made = scenes.make_scene(n=120, objects=2, seed=2)
    still = tuple(dataclasses.replace(group, rigid_rms=0.0, rigid_max=0.0) for group in made.groups)
    return dataclasses.replace(made, groups=still, residuals=None)


@pytest.fixture
def path(scene, tmp_path):
    return scene_file.write(scene, tmp_path / "scene.r5dgs")


def evaluation(of, **changes):
    splits = {"val": {"rigid": {"psnr": 31.25}}, "test": {"rigid": {"psnr": 28.5}}}
    return {"scene": of.name, "train": {"gaussians": len(of.gaussians.means)}, "splits": splits, **changes}


def write(place, content, later=10.0):
    place.write_text(json.dumps(content))
    now = place.stat().st_mtime + later
    os.utime(place, (now, now))


def test_unmeasured_quality_names_the_evaluate_command(scene, path):
    found = quality.measure(scene, path)
    assert (found.psnr_observed, found.psnr_later, found.rigid_rms, found.bending) == (None, None, None, 0)
    assert "r5dgs evaluate" in found.text()


@pytest.mark.parametrize("name", ["scene.evaluation.json", "evaluation.json"])
def test_an_evaluation_beside_the_file_is_found(scene, path, name):
    write(path.with_name(name), evaluation(scene))
    found = quality.measure(scene, path)
    assert (found.psnr_observed, found.psnr_later) == (31.25, 28.5)
    assert "31.2 dB" in found.text() and "28.5 dB past" in found.text()


@pytest.mark.parametrize(
    "content",
    [
        {"scene": "another"},
        {"train": {"gaussians": 3}},
        {"train": None},
        {"splits": None},
        {"splits": {"val": {"rigid": {"psnr": None}}}},
    ],
)
def test_an_evaluation_of_another_scene_is_ignored(scene, path, content):
    write(path.with_name("evaluation.json"), evaluation(scene, **content))
    assert quality.measure(scene, path).psnr_observed is None


def test_an_evaluation_of_an_older_file_is_ignored(scene, path):
    write(path.with_name("evaluation.json"), evaluation(scene), later=-100.0)
    assert quality.measure(scene, path).psnr_observed is None
    path.with_name("evaluation.json").write_text("no JSON")
    assert quality.measure(scene, path).psnr_observed is None


def test_the_rigid_motions_error_is_weighted_by_gaussians_and_a_share_of_the_size(scene):
    groups = list(scene.groups)
    groups[1] = dataclasses.replace(groups[1], rigid_rms=0.3, rigid_max=0.5)
    bent = dataclasses.replace(scene, groups=tuple(groups))
    share = np.mean(scene.gaussians.motion_ids == 1)
    found = quality.measure(bent)
    assert found.rigid_rms == pytest.approx(0.3 * np.sqrt(share) / scene.extent)
    assert "%" in found.text() and "picture error not measured" in found.text()
