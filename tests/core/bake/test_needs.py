"""The parts of a scene follow from the measurements, and the table of needs lists them."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.bake import bake, camera_needs, contact, needs
from r5dgs_core.bake.draft import Need
from r5dgs_core.config import config, training_needs
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import unexplained
from r5dgs_core.errors import ConfigError
from r5dgs_core.motion import rotations
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.scene.camera_correction import Correction
from r5dgs_core.scene.scene import MotionGroup
from r5dgs_core.train import checkpoint, observed_motion, run
from r5dgs_core.train.refinement.refinement import PARTS
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

RADIUS = 0.4


def table(
    travel=0.0,
    turn=0.0,
    *,
    shading=0.0,
    sky=1,
    bases=1,
    shadow=False,
    bodies=1,
    classified=True,
    wanted=None,
    bent=0,
    moves=None,
):
    """The decisions for bodies of which the first moves by ``travel`` diameters and turns by ``turn`` radians."""
    poses = [np.tile([1.0, 0, 0, 0, 0, 0, 0], (3, 1)) for _ in range(bodies + 2)]
    if bodies:
        poses[1][0, :4] = rotations.rotvecs_to_quats(np.array([0, 0, turn]))
        poses[1][0, 4] = travel * 2 * RADIUS
    groups = [MotionGroup(0, 0, "pinned", 0, np.zeros(3), MotionModel())]
    groups += [MotionGroup(k, k, "body", 0, np.zeros(3), MotionModel(radius=RADIUS)) for k in range(1, bodies + 1)]
    if shadow:
        groups.append(MotionGroup(bodies + 1, 1, "shadow", 0, np.zeros(3), MotionModel(), 1, np.eye(3)))
    ids = np.array([0] * 5 + [1] * 5 * (bodies > 0) + [bodies + 1] * 5 * shadow)
    gradients = np.full((len(ids), 3), shading)
    found = needs.decide(
        groups,
        poses,
        motion_ids=ids,
        shading=gradients,
        light=np.array([0, 0, 1.0]),
        sky_bases=sky,
        bases=bases,
        classified=classified,
        residuals=Need("residuals", float(bent), 0.5, bent > 0, "gain", bent > 0),
        moves=moves,
        wanted=config.NeedsSection(**(wanted or {})),
    )
    return {need.name: need.row() for need in found}


def decisions(**given):
    return {name: row["decision"] for name, row in table(**given).items()}


def test_a_scene_at_rest_needs_nothing_that_moves():
    found = decisions()
    assert found["tracks"] == found["rotation"] == found["shading"] == found["shadows"] == "off"
    assert found["view_dependent_colour"] == found["sky_gradient"] == "off" and found["classifier"] == "on"


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"travel": 0.01}, "tracks"),
        ({"turn": 0.01}, "tracks"),
        ({"turn": 0.01}, "rotation"),
        ({"turn": 1.0, "shading": 0.1}, "shading"),
        ({"shadow": True}, "shadows"),
        ({"bases": 4}, "view_dependent_colour"),
        ({"sky": 4}, "sky_gradient"),
        ({"bent": 3}, "residuals"),
    ],
)
def test_each_need_follows_its_own_cause(given, name):
    row = table(**given)[name]
    assert row["decision"] == "on" and row["reason"]
    assert decisions()[name] == "off"


def test_an_object_that_only_slides_needs_no_rotation_and_no_shading():
    found = decisions(travel=1.0, shading=0.5)
    assert (found["tracks"], found["rotation"], found["shading"]) == ("on", "off", "off")


def test_the_table_has_the_numbers_of_the_motion():
    rows = table(travel=1.5, turn=0.7)
    assert rows["tracks"]["value"] == pytest.approx(1.5)
    assert rows["rotation"]["value"] == pytest.approx(0.7)


def test_without_objects_nothing_moves():
    assert decisions(bodies=0)["tracks"] == "off"


def test_a_classifier_is_on_if_it_was_trained():
    assert decisions(classified=False)["classifier"] == "off"


@pytest.mark.slow
def test_disabled_parts_are_not_in_the_scene(baked):
    found = {row["name"]: row["decision"] for row in baked.needs if "object" not in row}
    assert (found["shading"] == "on") == (baked.shading is not None)
    assert (found["classifier"] == "on") == (baked.gaussians.identities is not None)
    assert (found["sky_gradient"] == "on") == (len(baked.background_sh) > 1)


def test_the_tiny_scene_needs_the_features_that_it_shows(baked):
    found = {row["name"]: row["decision"] for row in baked.needs if "object" not in row}
    assert found["tracks"] == found["rotation"] == found["classifier"] == "on"
    assert found["view_dependent_colour"] == "off"


EVERYTHING = {"travel": 1.0, "turn": 1.0, "shading": 0.1, "sky": 9, "bases": 4, "shadow": True, "bent": 3}
EVERYTHING["moves"] = observed_motion.RegroupCounts(3, moving=9)
NAMES = [field.name for field in dataclasses.fields(config.NeedsSection)]
MEASURED = [name for name in NAMES if name not in (*PARTS, unexplained.NEED, contact.NAME)]  # of all scenes, by baking


def test_every_row_of_the_table_can_be_overridden():
    assert list(table()) == MEASURED


@pytest.mark.parametrize("name", MEASURED)
def test_overrides_of_the_user_win_over_the_measured_value_and_are_marked(name):
    measured, decided = table(**EVERYTHING)[name], table(**EVERYTHING, wanted={name: "off"})[name]
    assert (measured["decision"], decided["decision"]) == ("on", "off")
    assert decided["value"] == measured["value"] and decided["reason"].startswith("set off by the user")
    others = [table(**EVERYTHING, wanted={name: "off"})[other] == table(**EVERYTHING)[other] for other in MEASURED]
    assert others == [other != name for other in MEASURED]


@pytest.mark.parametrize("name", ["tracks", "rotation"])
def test_the_user_can_declare_a_resting_object_moving(name):
    row = table(wanted={name: "on"})[name]
    assert row["decision"] == "on" and row["reason"].startswith("set on by the user;")


@pytest.mark.parametrize(
    "name", ["shading", "shadows", "view_dependent_colour", "sky_gradient", "classifier", "residuals"]
)
def test_parts_that_were_not_trained_cannot_be_switched_on(name):
    row = table(classified=False, wanted={name: "on"})[name]
    assert row["decision"] == "off" and "set on by the user, but not trained" in row["reason"]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("needs.shadws=off", "needs.shadws: unknown key; did you mean 'shadows'?"),
        ("needs.shadows=no", "needs.shadows: expected auto or on or off, got 'no'"),
    ],
)
def test_unknown_needs_are_refused(override, message):
    with pytest.raises(ConfigError, match=message.replace("?", r"\?")):
        config.load(None, [override])


@pytest.mark.parametrize(
    ("need", "key"),
    [("shading", "train.shading=false"), ("shadows", "train.shadows=false"), ("classifier", "identity.iterations=0")],
)
def test_contradictions_are_refused(need, key):
    with pytest.raises(ConfigError, match=f"needs.{need} is on, but {key.split('=')[0]} is .*leave one of them out"):
        config.load(None, [f"needs.{need}=on", key])


def test_training_omits_parts_that_the_user_disables(tiny, tmp_path):
    off = [f"needs.{name}=off" for name in NAMES]
    settings = tiny_datasets.settings("train.iterations=60", *off)
    done = run.train(tiny.root, tmp_path / "run", settings)
    tensors = checkpoint.load(done.folder).tensors
    assert not tensors["gaussians.shading"].any()
    assert not [name for name in tensors if name.startswith("tracks.")]
    assert "identities" not in tensors and len(tensors["background"]) == 1
    assert done.config == settings  # the run folder stores the request
    scene = bake.bake(done, datasets.read(tiny.root))
    assert {row["decision"] for row in scene.needs} == {"off"}
    assert all(row["reason"].startswith("set off by the user") for row in scene.needs)


def test_view_dependent_colour_is_learned_if_the_user_enables_it(tiny):
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings("needs.view_dependent_colour=on"))
    assert trainer.gaussians.params["sh_rest"].shape[1] == 3
    kept = training_needs.resolve(config.load(None, ["needs.view_dependent_colour=on", "train.sh_degree=2"]))
    assert kept.train.sh_degree == 2


def test_a_run_can_be_baked_without_learned_features(trained, baked, tiny, tmp_path):
    off = [f"needs.{name}=off" for name in NAMES]
    scene = bake.run_bake(trained.folder, tmp_path / "bare.r5dgs", None, off)
    assert scene.gaussians.identities is None and scene.shading is None and len(scene.background_sh) == 1
    assert {group.role for group in scene.groups} == {"pinned", "body"} < {group.role for group in baked.groups}
    assert (scene.tracks.poses == [1.0, 0, 0, 0, 0, 0, 0]).all()
    assert len(scene.gaussians.means) == sum(baked.groups[k].role != "shadow" for k in baked.gaussians.motion_ids)
    sliding = bake.run_bake(trained.folder, tmp_path / "sliding.r5dgs", None, ["needs.rotation=off"])
    assert (sliding.tracks.poses[..., :4] == needs.STILL_QUAT).all() and np.ptp(
        sliding.tracks.poses[1, :, 4:], 0
    ).max() > 0.1


def test_bake_accepts_only_overrides_of_needs(trained, tmp_path):
    with pytest.raises(ConfigError, match="--set train.seed=1: .*bake accepts only needs.NAME"):
        bake.run_bake(trained.folder, tmp_path / "x.r5dgs", None, ["train.seed=1"])


def test_the_table_lists_regrouped_gaussians():
    row = table(moves=observed_motion.RegroupCounts(3, 2, 1, 1, 60))["regrouping"]
    assert (row["value"], row["decision"]) == (6, "on")
    for part in ("of 60", "3 went to another body", "2 to a shadow", "1 to rest", "1 shadows rest"):
        assert part in row["reason"]
    assert table(moves=observed_motion.RegroupCounts(moving=60))["regrouping"]["decision"] == "off"
    assert table()["regrouping"]["decision"] == "off"


def test_refined_cameras_have_rows_with_sizes():
    sizes = {"camera_poses": 1.5, "focal_lengths": 0.0, "time_offsets": None, "camera_colours": 0.001}
    corrections = {"left": Correction(rotvec=np.full(3, 0.01)).to_dict()}
    record = {"refined": ["camera_poses"], "sizes": sizes, "corrections": corrections, "pixels": {"left": 0.7}}
    rows = {need.name: need.row() for need in camera_needs.rows(record, config.Config())}
    assert list(rows) == list(PARTS)
    assert rows["camera_poses"]["decision"] == "on" and rows["camera_poses"]["value"] == 1.5
    assert "moved by 0.7 (at most 0.7) px" in rows["camera_poses"]["reason"]
    assert rows["camera_colours"]["decision"] == "off" and rows["camera_colours"]["threshold"] == 0.01
    assert rows["time_offsets"]["reason"] == "not examined"
    assert {need.reason for need in camera_needs.rows({}, config.Config())} == {"not examined"}
