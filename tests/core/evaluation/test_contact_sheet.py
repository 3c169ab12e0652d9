"""The contact sheet: choice of its views and content of each row."""

import dataclasses

import numpy as np

from r5dgs_core.data import dataset, images
from r5dgs_core.evaluation import contact_sheet, evaluate
from tests.support import pictures

BACKEND = pictures.BACKEND


def test_the_contact_sheet_takes_two_observed_and_two_later_times_of_one_camera(scene, data, tmp_path):
    views = contact_sheet.choose_views(data)
    assert [view.t for view in views] == [0.1, 0.6, 0.85, 1.0]
    assert {view.camera.name for view in views} == {"cam2"}
    path = contact_sheet.write(scene, data, tmp_path / "sheet.png", backend=BACKEND)
    width, height, channels = images.size(path)
    assert width > 4 * 200 and height > 4 * 150 and channels == 3


def test_the_contact_sheet_works_with_fewer_times(scene, data, tmp_path):
    assert [view.t for view in contact_sheet.choose_views(dataclasses.replace(data, test=()))] == [0.1, 0.6]
    only = dataclasses.replace(data, val=(), test=())
    assert len(contact_sheet.choose_views(only)) == 4
    late = dataclasses.replace(data, val=())
    assert sum(view.t > 0.75 for view in contact_sheet.choose_views(late)) == 2


def test_the_difference_is_black_where_nothing_differs(scene, data):
    views = contact_sheet.choose_views(data)[:1]
    shown = [evaluate.render(scene, view.camera, view.t, backend=BACKEND) for view in views]
    truths = [dataset.load_image(view) for view in views]
    panel = contact_sheet.PANEL_PX**2 * pictures.HEIGHT / pictures.WIDTH
    for change, least, most in ((0.0, 0.85, 1.2), (0.2, 0.0, 0.15)):
        sheet = contact_sheet.draw(scene, views, shown, [truth + np.float32(change) for truth in truths], [None])
        assert least < (sheet == 0).all(axis=-1).sum() / panel < most


def test_an_id_map_is_painted_in_the_objects_colours(scene):
    picture = contact_sheet.color_ids(scene, np.array([[0, 1, 2], [3, 77, 0]]))
    for object_id, place in ((1, (0, 1)), (2, (0, 2)), (3, (1, 0))):
        np.testing.assert_allclose(picture[place], scene.object(object_id).color, atol=1e-6)
    np.testing.assert_allclose(picture[1, 1], contact_sheet.UNKNOWN_COLOR)
    np.testing.assert_allclose(picture[0, 0], contact_sheet.BACKGROUND_COLOR, atol=1e-6)
