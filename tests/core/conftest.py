"""Shared fixtures: the tiny data set, a run on it, a synthetic scene and a data set of its images."""

import copy
import hashlib
import pickle
import shutil

import pytest

from r5dgs_core.bake import bake, image_evidence
from r5dgs_core.bench import playback_speed
from r5dgs_core.data import dataset as datasets
from r5dgs_core.train import learning_curves, run
from r5dgs_core.train.initialization import initialize
from tests.support import pictures, scenes, tiny_datasets


@pytest.fixture(scope="session", autouse=True)
def no_plots():
    """Disable plots of learning curves, which take a third of a tiny run. Returns the original function."""
    update = learning_curves.LearningCurves.update
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learning_curves.LearningCurves, "update", lambda self, *, finished=False: None)
        yield update


@pytest.fixture(scope="session", autouse=True)
def few_views():
    """Limit the image evidence of baking to a dozen images."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(image_evidence, "MIN_VIEWS", 8)
        patch.setattr(image_evidence, "MAX_VIEWS", 12)
        yield


@pytest.fixture(scope="session", autouse=True)
def short_playback():
    """Limit the measurement of playback speed to a dozen frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(playback_speed, "MIN_FRAMES", 12)
        yield


@pytest.fixture(scope="session", autouse=True)
def shared_starts():
    """Compute the initial Gaussians of equal runs once, and give trainers copies.

    Data without masks or motion is initialised each time, because that logs a warning. Settings that the
    initialisation does not read may differ.
    """
    start, made = initialize.start, {}

    def shared(views, config, motion, find_sky, rng, cloud=None):
        if not all(view.has_mask for view in views) or len({view.t for view in views}) == 1:
            return start(views, config, motion, find_sky, rng, cloud)
        train = config.train
        shown = (train.sh_degree, train.shadows, train.shading, train.representation, config.needs.camera_colours)
        settings = (config.init, config.curriculum, shown, motion.name)
        pixels = [(view.name, view.camera, view.t, view.image, view.mask, view.alpha) for view in views]
        given = (pixels, settings, find_sky, rng.bit_generator.state, cloud)
        key = hashlib.sha1(pickle.dumps(given)).digest()
        if key not in made:
            made[key] = start(views, config, motion, find_sky, rng, cloud), rng.bit_generator.state
        found, rng.bit_generator.state = copy.deepcopy(made[key])
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initialize, "start", shared)
        yield


@pytest.fixture
def plots(no_plots, monkeypatch):
    """Enable plots of learning curves."""
    monkeypatch.setattr(learning_curves.LearningCurves, "update", no_plots)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """The data set of `tests/support/tiny_datasets.py` with masks."""
    return tiny_datasets.make_dataset(tmp_path_factory.mktemp("tiny"))


@pytest.fixture
def copied(tiny, tmp_path):
    """Folder of a copy of the tiny data set that a test may change."""
    return shutil.copytree(tiny.root, tmp_path / "data")


@pytest.fixture(scope="session")
def trained(tiny, tmp_path_factory):
    """Finished run on the tiny data set."""
    folder = tmp_path_factory.mktemp("runs") / "trained"
    return run.train(tiny.root, folder, tiny_datasets.settings("train.iterations=300"))


@pytest.fixture(scope="session")
def baked(trained, tiny):
    """Scene baked from `trained`."""
    return bake.bake(trained, datasets.read(tiny.root))


@pytest.fixture(scope="session")
def kept(trained, tiny):
    """Scene of `trained` with unsimplified motion."""
    return bake.bake(tiny_datasets.as_trained(trained), datasets.read(tiny.root))


@pytest.fixture(scope="session")
def scene():
    """Synthetic scene of three objects."""
    return scenes.make_scene(n=240, objects=3, seed=5)


@pytest.fixture(scope="session")
def data(scene, tmp_path_factory):
    """Data set of images of `scene`."""
    return pictures.write_dataset(tmp_path_factory.mktemp("own pictures"), scene)
