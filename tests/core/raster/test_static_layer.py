"""Drawing moving Gaussians into a static layer gives the picture of all Gaussians, to the bit."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from r5dgs_core.raster import RasterSettings, rasterize_splats
from r5dgs_core.raster.cpu.static_layer import StaticLayer
from tests.support.splats import camera, splats


def single(scene):
    return [t.float() for t in scene]


def joined(still, moving):
    return [torch.cat(parts) for parts in zip(still, moving, strict=True)]


def assert_equal(found, expected):
    for name in ("image", "alpha", "depth", "ids"):
        a, b = getattr(found, name), getattr(expected, name)
        assert (a is None) == (b is None) and (a is None or torch.equal(a, b)), name


@pytest.mark.parametrize("n_channels", [3, 5])
@pytest.mark.parametrize("background", ["none", "one", "each"])
def test_a_body_that_moves_through_the_static_layer_is_drawn_exactly(n_channels, background):
    view = camera(150, 130, 160.0)
    behind = {"none": None, "one": torch.rand(n_channels), "each": torch.rand(130, 150, n_channels)}[background]
    still = single(splats(3000, n_channels, seed=1, radius_px=5.0))
    body = single(splats(203, n_channels, seed=2, radius_px=9.0))
    body[0] = 0.2 * body[0]
    labels, own = torch.randint(-1, 4, (3000,)), torch.full((203,), 40)
    backdrop = StaticLayer(*still, view, behind, labels=labels)
    untouched = False
    for offset in ([0.0, 0.0, 0.0], [0.4, -0.3, 0.9], [-0.5, 0.2, -0.9], [9.0, 0.0, 0.0], [0.0, 0.0, 0.1]):
        moving = [body[0] + torch.tensor(offset), *body[1:]]
        expected = rasterize_splats(*joined(still, moving), view, behind, labels=torch.cat([labels, own]))
        found = backdrop.draw(*moving, labels=own)
        assert_equal(found, expected)
        untouched |= not (found.ids == 40).any()
    assert untouched and len(found.ids.unique()) > 4


def test_equal_depths_keep_still_gaussians_in_front():
    view = camera()
    still = single(splats(200, 3, seed=3, radius_px=12.0))
    moving = [still[0].clone(), *single(splats(200, 3, seed=4, radius_px=12.0))[1:]]
    assert_equal(StaticLayer(*still, view).draw(*moving), rasterize_splats(*joined(still, moving), view))


def test_the_number_of_moving_gaussians_may_vary_between_frames():
    view, still = camera(), single(splats(100, 3, seed=5))
    backdrop = StaticLayer(*still, view)
    for count in (5, 0, 700, 1, 64):
        moving = single(splats(count, 3, seed=count, radius_px=10.0))
        assert_equal(backdrop.draw(*moving), rasterize_splats(*joined(still, moving), view))


def test_ranks_decide_at_equal_depths():
    view = camera()
    scene = single(splats(300, 3, seed=3, radius_px=12.0))
    scene[0] = scene[0][:100].repeat(3, 1)
    rows = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    still, moving = rows[:180].sort().values, rows[180:].sort().values
    backdrop = StaticLayer(*[t[still] for t in scene], view, ranks=still.numpy())
    found = backdrop.draw(*[t[moving] for t in scene], ranks=moving.numpy())
    assert_equal(found, rasterize_splats(*scene, view))


def test_a_backdrop_keeps_its_own_background():
    view, still, behind = camera(), single(splats(100, 3, seed=6)), torch.rand(40, 48, 3)
    backdrop, moving = StaticLayer(*still, view, behind), single(splats(30, 3, seed=7, radius_px=20.0))
    before = backdrop.draw(*moving)
    behind.zero_()
    assert_equal(backdrop.draw(*moving), before)


def test_a_refused_call_leaves_the_backdrop_as_it_was():
    view, still, moving = camera(), single(splats(100, 3, seed=6)), single(splats(9, 3, seed=7, radius_px=20.0))
    labels = torch.arange(100) % 4
    backdrop = StaticLayer(*still, view, labels=labels)
    good = torch.full((9,), 9)
    expected = backdrop.draw(*moving, labels=good)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"labels.*at index 0"):
            backdrop.draw(*moving, labels=torch.full((9,), 2**25))
    assert_equal(backdrop.draw(*moving, labels=good), expected)


def test_several_threads_may_draw_on_one_backdrop():
    view, still = camera(150, 130, 160.0), single(splats(2000, 3, seed=1, radius_px=5.0))
    backdrop = StaticLayer(*still, view)
    bodies = [single(splats(50 + 40 * k, 3, seed=k, radius_px=9.0)) for k in range(4)]
    expected = [rasterize_splats(*joined(still, body), view) for body in bodies]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda k: backdrop.draw(*bodies[k % 4]), range(24)))
    for k, picture in enumerate(found):
        assert_equal(picture, expected[k % 4])


def test_results_belong_to_the_caller():
    view, still = camera(), single(splats(100, 3, seed=6))
    backdrop, moving = StaticLayer(*still, view), single(splats(3, 3, seed=7))
    first = backdrop.draw(*moving)
    expected = first.image.clone()
    first.image.zero_()
    assert torch.equal(backdrop.draw(*moving).image, expected)


def test_settings_hold_for_both_parts():
    view, settings = camera(), RasterSettings(near_plane=2.9, alpha_min=0.05)
    still, moving = single(splats(300, 3, seed=8)), single(splats(50, 3, seed=9))
    found = StaticLayer(*still, view, settings=settings).draw(*moving)
    assert_equal(found, rasterize_splats(*joined(still, moving), view, settings=settings))


def test_incompatible_parts_are_refused():
    view, still = camera(), single(splats(30, 3))
    with pytest.raises(ValueError, match="channels: expected 3"):
        StaticLayer(*still, view).draw(*single(splats(5, 4)))
    with pytest.raises(ValueError, match="labels"):
        StaticLayer(*still, view, labels=torch.zeros(30, dtype=torch.int64)).draw(*single(splats(5, 3)))
    moving = single(splats(5, 3))
    moving[0][2, 1] = np.nan
    with pytest.raises(ValueError, match=r"means.*\(2, 1\)"):
        StaticLayer(*still, view).draw(*moving)
