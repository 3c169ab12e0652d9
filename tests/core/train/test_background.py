"""The learned sky shows each camera its own rays."""

import dataclasses

import numpy as np
import torch

from r5dgs_core.scene import cameras, spherical_harmonics
from r5dgs_core.train import background
from tests.support import scenes


def test_images_of_other_sizes_show_their_own_part_of_the_sky():
    coefficients = np.random.default_rng(0).normal(size=(9, 3)) * 0.2
    sky, camera = background.learned(coefficients), scenes.orbit_camera(0.3, 8, 6)
    for width, height in ((8, 6), (12, 4), (5, 3)):  # the first two of as many pixels
        cut = dataclasses.replace(camera, width=width, height=height)
        shown = sky.image(cut)
        assert shown.shape == (height, width, 3)
        assert torch.equal(shown, background.learned(coefficients).image(cut))
    whole, part = sky.image(camera), sky.image(dataclasses.replace(camera, width=5, height=3))
    torch.testing.assert_close(part, whole[:3, :5])


def test_harmonics_are_computed_in_parts_that_fit_into_a_cache(monkeypatch):
    camera = scenes.orbit_camera(0.3, 7, 75)
    skewed = camera.intrinsics + [[0.3, 0.02, 0.1], [0, 0.7, 0.37], [0, 0, 0]]
    camera = dataclasses.replace(camera, intrinsics=skewed)
    rays = cameras.pixel_rays(camera).astype(np.float32)
    computed, pixel_rays = [], cameras.pixel_rays

    def counted(*given):
        found = pixel_rays(*given)
        computed.append(len(found))
        return found

    monkeypatch.setattr(cameras, "pixel_rays", counted)
    found = background.learned(np.zeros((1, 3)), degree=3).basis(camera)
    assert torch.equal(found, spherical_harmonics.basis(torch.from_numpy(rays), 3).reshape(-1, 16))
    assert sum(computed) == 75 and max(computed) == background.ROWS


def test_the_first_cameras_that_fit_stay_in_the_cache(monkeypatch):
    cameras_seen = [scenes.orbit_camera(angle, 8, 6) for angle in (0.1, 0.2, 0.3, 0.4, 0.5)]
    computed, harmonics = [], background._harmonics
    monkeypatch.setattr(background, "_harmonics", lambda *given: computed.append(given[0]) or harmonics(*given))
    monkeypatch.setattr(background, "BASES_BYTES", 3 * 8 * 6 * 9 * 4 + 1)  # three cameras of degree 2
    sky = background.learned(np.zeros((1, 3)), degree=2)
    for order, missing in (((0, 1, 2, 3, 4), [0, 1, 2, 3, 4]), ((4, 2, 0, 3, 1), [4, 3]), ((3, 1, 4, 0, 2), [3, 4])):
        computed.clear()
        found = [sky.basis(cameras_seen[k]) for k in order]
        assert computed == [cameras_seen[k] for k in missing]
        assert sum(basis.nbytes for basis in sky._bases.values()) <= background.BASES_BYTES
        assert all(torch.equal(b, harmonics(cameras_seen[k], 9)) for k, b in zip(order, found, strict=True))
