"""Regions that move although no mask names them are found from images and masks alone."""

import numpy as np
import pytest
from scipy import ndimage

from r5dgs_core.data import masks, unexplained

HEIGHT, WIDTH, FRAMES = 60, 90, 9
BODY, THING = np.array([0.7, 0.3, 0.25]), np.array([0.2, 0.4, 0.8])


def room(seed=0):
    """Textured background. [H, W, 3]"""
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH, 3))
    return np.clip(0.5 + 1.2 * ndimage.gaussian_filter(noise, (2, 2, 0)), 0, 1)


def square(x, y=20, size=14):
    shown = np.zeros((HEIGHT, WIDTH), bool)
    shown[y : y + size, x : x + size] = True
    return shown


def recording(*, body=False, thing=False, shadow=1.0, light=0.0, noise=0.01, wobble=False):
    """Frames with a body without a mask, a thing with a mask and a shadow, and the places of the body."""
    rng, still, frames, places = np.random.default_rng(1), room(), [], []
    cloth = room(2)
    for k in range(FRAMES):
        image, mask = still.copy(), np.zeros((HEIGHT, WIDTH), np.uint8)
        image[square(64 - 5 * k, 44)] *= shadow
        if thing:
            mask[square(70 - 5 * k, 42)] = 1
            image[mask > 0] = THING
        place = square(5 + 8 * k) if not wobble else square(30, size=24)
        if wobble:
            image[place] = np.roll(cloth, 3 * k, axis=(0, 1))[place] * BODY
        elif body:
            image[place] = BODY
        image = image * (1 + light * (-1) ** k) + noise * rng.normal(size=image.shape)
        frames.append((np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), mask))
        places.append(place)
    return frames, places


def overlap(found, true):
    return (found & true).sum() / (found | true).sum()


def test_a_body_without_a_mask_is_found_where_it_is():
    frames, places = recording(body=True, thing=True)
    usual = unexplained.usual(frames)
    found = [usual.blocks(*frame) for frame in frames]
    assert np.mean([overlap(one, place) for one, place in zip(found, places, strict=True)]) > 0.6
    assert all(one[place].mean() > 0.9 for one, place in zip(found, places, strict=True))
    assert usual.share == pytest.approx(np.mean(found))


@pytest.mark.parametrize(
    "given",
    [
        {"noise": 0.02},
        {"thing": True},
        {"thing": True, "shadow": 0.6},
        {"light": 0.15},
    ],
)
def test_noise_objects_with_masks_their_shadows_and_flickering_light_are_explained(given):
    frames, _ = recording(**given)
    usual = unexplained.usual(frames)
    assert usual.share == 0.0 and not usual.unsteady.any()


def test_what_a_restless_body_hides_is_unexplained_at_all_times():
    frames, places = recording(wobble=True)
    usual = unexplained.usual(frames)
    assert usual.unsteady[places[0]].mean() > 0.9
    assert overlap(usual.unsteady, places[0]) > 0.6
    empty = np.round(255 * room()).astype(np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
    assert (usual.blocks(*empty) >= usual.unsteady).all()


def test_pixels_of_masks_are_never_unexplained():
    frames, _ = recording(body=True)
    usual = unexplained.usual(frames)
    image, mask = frames[4]
    mask = mask.astype(np.uint16)
    mask[:, :45] = masks.UNKNOWN
    assert not usual.blocks(image, mask)[:, :45].any()


def test_a_change_of_the_whole_picture_is_no_body():
    frames, _ = recording(body=True)
    usual = unexplained.usual(frames)
    image, mask = frames[4]
    assert usual.blocks(image, mask).any()
    tinted = np.minimum(image * np.array([0.6, 1.0, 1.4]), 255).astype(np.uint8)
    assert not usual.blocks(tinted, mask).any()
    assert not usual.blocks(np.roll(image, 30, axis=(0, 1)), mask).any()


def test_too_few_frames_are_no_evidence():
    frames, _ = recording(body=True)
    assert unexplained.usual(frames[: unexplained.MIN_FRAMES - 1]) is None


@pytest.mark.parametrize(("height", "width"), [(37, 50), (361, 203), (720, 1280)])
def test_blocks_cover_images_of_any_size(height, width):
    image = np.zeros((height, width, 3), np.uint8)
    usual = unexplained.usual([(image, None)] * unexplained.MIN_FRAMES)
    image[: height // 2, : width // 2] = 255
    found = unexplained.enlarged(usual.blocks(image, None), height, width)
    assert found.shape == (height, width) and usual.known.shape[0] <= unexplained.LINES
    assert found[: height // 3, : width // 3].all() and not found[2 * height // 3 :].any()
