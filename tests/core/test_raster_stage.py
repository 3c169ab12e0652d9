"""A stage shows what rendering every frame from the start would show."""

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("numba", reason="a stage keeps what stands still where the cpu backend draws")

from r5dgs_core.raster import backdrop, scene_render, stage  # noqa: E402
from r5dgs_core.raster.scene_render import Instance  # noqa: E402
from tests import scenes  # noqa: E402
from tests.core.test_scene_render import group_instances  # noqa: E402

CAMERA, OTHER = scenes.orbit_camera(0.7, 80, 72), scenes.orbit_camera(1.1, 80, 72)


@pytest.fixture(scope="module", params=[0, 2])
def scene(request):
    return scenes.make_scene(n=900, sh_degree=request.param, seed=3)


@pytest.fixture
def made(monkeypatch):
    """Counts the backdrops that are made."""
    count = []
    original = backdrop.Backdrop.__init__

    def counted(self, *arguments, **options):
        count.append(1)
        original(self, *arguments, **options)

    monkeypatch.setattr(backdrop.Backdrop, "__init__", counted)
    return count


def assert_shows(theatre, scene, instances, camera, sky=True):
    found = theatre.render(instances, camera, sky=sky)
    posed = scene_render.pose_instances(scene, instances)
    expected = scene_render.render_frame(scene, posed, camera, background="scene" if sky else None)
    for name in ("color", "alpha", "depth", "ids"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def test_playing_shows_every_frame_and_draws_what_stands_still_once(scene, made):
    theatre = stage.Stage(scene)
    for t in (0.0, 0.1, 0.2, 0.9, 1.4):
        assert_shows(theatre, scene, group_instances(scene, t), CAMERA)
    assert len(made) == 1


def test_another_camera_sky_or_selection_starts_again(scene, made):
    theatre = stage.Stage(scene)
    for t in (0.0, 0.3, 0.5):
        assert_shows(theatre, scene, group_instances(scene, t), CAMERA)
    assert_shows(theatre, scene, group_instances(scene, 0.5), OTHER)
    assert_shows(theatre, scene, group_instances(scene, 0.6), OTHER, sky=False)
    assert_shows(theatre, scene, group_instances(scene, 0.7)[:-1], OTHER, sky=False)
    assert len(made) == 1
    assert_shows(theatre, scene, group_instances(scene, 0.8)[:-1], OTHER, sky=False)
    assert len(made) == 2


def test_what_begins_to_move_later_is_taken_out_of_what_stands_still(scene, made):
    theatre, instances = stage.Stage(scene), group_instances(scene, 0.4)
    for moving in ((), (1,), (1, 2), (2,), ()):
        shown = []
        for i, instance in enumerate(instances):
            matrix = instance.matrix.copy()
            matrix[0, 3] += 0.1 * (i in moving)
            shown.append(Instance(instance.start, instance.count, matrix))
        assert_shows(theatre, scene, shown, CAMERA)
    assert len(made) == 2


def test_where_almost_all_moves_everything_is_drawn(scene, made):
    theatre = stage.Stage(scene)
    for shift in (0.0, 0.1, 0.2):
        matrix = np.eye(4)
        matrix[0, 3] = shift
        assert_shows(theatre, scene, [Instance(0, len(scene.means), matrix)], CAMERA)
    assert not made


def test_bodies_at_equal_depths_keep_their_order_whoever_moves():
    scene = scenes.make_scene(n=900, seed=3)
    flat = dataclasses.replace(scene, means=scene.means * np.array([1, 1, 0], np.float32))
    above = scenes.looking_camera((0, 0, 5.0), (0, 0, -1.0), 0.8, 80, 72, up=(0, 1.0, 0))
    instances = group_instances(flat, 1.0)
    instances = [Instance(one.start, one.count, np.eye(4)) for one in instances]
    theatre = stage.Stage(flat)
    for shift in (0.0, 0.1, 0.2):
        shown = []
        for i, instance in enumerate(instances):
            matrix = np.eye(4)
            matrix[0, 3] = shift * (i in (1, 2))
            shown.append(Instance(instance.start, instance.count, matrix))
        shown = [shown[1], shown[0], *shown[2:]]
        assert_shows(theatre, flat, shown, above)


def test_a_bad_instance_is_numbered_as_the_caller_does(scene):
    theatre, instances = stage.Stage(scene), group_instances(scene, 0.4)
    theatre.render(instances, CAMERA)
    theatre.render(group_instances(scene, 0.5), CAMERA)
    last = len(instances) - 1
    bad = [*instances[:last], Instance(instances[last].start, instances[last].count, np.zeros((4, 4)))]
    for _ in range(2):
        with pytest.raises(ValueError, match=f"instance {last}: "):
            theatre.render(bad, CAMERA)
    assert_shows(theatre, scene, instances, CAMERA)
