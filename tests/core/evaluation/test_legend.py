"""The legend: objects wear their colours, names are readable at any size, and all objects are listed."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.evaluation import legend
from r5dgs_core.render import viewpoints
from tests.support import pictures, scenes

pytestmark = pytest.mark.heavy

BACKEND = pictures.BACKEND


def board(height=720, width=960):
    """An id map: object 1 large, object 2 small, object 3 not there."""
    ids = np.zeros((height, width), np.int32)
    ids[height // 4 : height // 2, width // 8 : width // 2] = 1
    ids[int(0.8 * height) : int(0.85 * height), int(0.8 * width) : int(0.83 * width)] = 2
    return ids


def annotated(scene, ids, title="a title"):
    return legend.annotate(scene, np.full((*ids.shape, 3), 0.5, np.float32), ids, title)


def close(picture, color):
    return (np.abs(picture.astype(int) - np.rint(255 * np.array(color)).astype(int)) <= 2).all(axis=-1)


def test_objects_are_outlined_in_their_colours_and_the_background_is_dimmed(scene):
    ids = board()
    picture = annotated(scene, ids)[: len(ids)]
    own = close(picture, scene.object(1).color)
    edge = (ids == 1) & ~np.roll(ids == 1, 1, axis=1)
    assert own[edge].mean() > 0.95
    far = np.zeros_like(edge)
    far[:20, :20] = True
    assert close(picture, (0.5 * legend.BEHIND,) * 3)[far].all()


def test_names_are_light_on_dark_and_stand_on_large_objects_and_beside_small_ones(scene):
    ids = board()
    picture = annotated(scene, ids)[: len(ids)]
    light = (picture > 230).all(axis=-1)
    rows, columns = np.nonzero(light & (ids == 1))
    assert len(rows) > 20
    column, row, _ = legend.middle(ids == 1)
    assert abs(columns.mean() - column) < 12 and abs(rows.mean() - row) < 12
    beside = light & (ids == 0)
    beside[: len(ids) // 2] = False
    assert beside.sum() > 20 and not (light & (ids == 2)).any()


def test_every_object_is_listed_and_invisible_ones_are_faint(scene):
    ids = board()
    strip = annotated(scene, ids)[len(ids) :]
    for object_id in (1, 2, 3):
        assert close(strip, scene.object(object_id).color).sum() > 20
    fewer = dataclasses.replace(scene, objects=scene.objects[:-1])
    assert not close(annotated(fewer, ids)[len(ids) :], scene.object(3).color).any()
    blue = (strip[..., 2] - strip[..., 0].astype(int) == 8) & (strip[..., 0] > 100)  # of the faint letters alone
    ids[:8, :8] = 3
    seen = annotated(scene, ids)[len(ids) :]
    assert blue.sum() > 20
    assert (seen > 230).all(axis=-1).sum() > (strip > 230).all(axis=-1).sum() + 20


def test_names_with_markup_are_only_text(scene, recwarn):
    for name in ("$x_1$", "_under", "100 % {a}", "日本", "a" * 200):
        odd = tuple(dataclasses.replace(item, name=name) if item.id == 1 else item for item in scene.objects)
        assert annotated(dataclasses.replace(scene, objects=odd), board()).shape[1] == 960
    assert not recwarn.list


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (40, 300), (900, 700)])
def test_any_size_gives_a_picture_of_its_width(scene, size):
    for ids in (board(*size), np.zeros(size, np.int32), np.ones(size, np.int32)):
        picture = annotated(scene, ids)
        assert picture.dtype == np.uint8 and picture.shape[1] == size[1] and len(picture) > size[0] + 10


def test_the_middle_lies_in_the_largest_part():
    mask = np.zeros((20, 30), bool)
    mask[2:4, 2:4], mask[8:17, 10:25] = True, True
    column, row, depth = legend.middle(mask)
    assert 8 <= row < 17 and 10 <= column < 25 and depth == 5.0
    ring = np.ones((9, 9), bool)
    ring[3:6, 3:6] = False
    column, row, _ = legend.middle(ring)
    assert ring[int(row), int(column)]


def test_a_legend_is_readable_and_marks_times_past_t_max(scene, monkeypatch):
    titles = []
    real = legend.annotate
    monkeypatch.setattr(legend, "annotate", lambda *given: titles.append(given[-1]) or real(*given))
    small = scenes.orbit_camera(0.5, 32, 24)
    picture = legend.draw(scene, viewpoints.Viewpoint(small, 0.3), backend="auto")
    assert picture.shape[1] == legend.LONGEST
    assert legend.draw(scene, viewpoints.Viewpoint(small, 1.0), longest=64, backend=BACKEND).shape[1] == 64
    assert "past t_max" not in titles[0] and "past t_max = 0.75" in titles[1] and small.name in titles[0]
