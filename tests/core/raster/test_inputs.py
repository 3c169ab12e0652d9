"""Invalid inputs are named by the caller's argument; all others are drawn."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r5dgs_core.raster import RasterSettings, RasterStats, rasterize, rasterize_splats
from r5dgs_core.raster.cpu import projection
from r5dgs_core.scene import cameras
from tests.support.splats import camera, splats

BACKENDS = ("cpu", "reference")


def scene(n=10, n_channels=3):
    return [t.float() for t in splats(n, n_channels)]


def gaussians(count=4, **changes):
    """Inputs of `rasterize`: raw parameters with harmonics of ``count`` coefficients."""
    means, quats, scales, opacities, _ = scene()
    raw = {
        **{"means": means, "quats": quats, "log_scales": scales.log(), "opacity_logits": torch.logit(opacities, 1e-4)},
        **{"sh": torch.linspace(-1, 1, 10 * count * 3).reshape(10, count, 3), "object_ids": torch.arange(10)},
    }
    return SimpleNamespace(**{**raw, **changes})


# Backgrounds


@pytest.mark.parametrize("shape", [(3,), (40, 48, 3)])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_background_of_another_float_dtype_is_converted_and_gets_its_gradient(backend, dtype, shape):
    background = torch.full(shape, 0.25, dtype=dtype, requires_grad=True)
    result = rasterize_splats(*scene(), camera(), background, backend=backend)
    expected = rasterize_splats(*scene(), camera(), background.detach().float(), backend=backend)
    assert result.image.dtype == torch.float32 and torch.equal(result.image, expected.image)
    result.image.mean().backward()
    assert background.grad.dtype == dtype and background.grad.all()


@pytest.mark.parametrize(("background", "kind", "message"), [
    ([0.0, 0.0, 0.0], TypeError, "expected a tensor, got list"),
    (np.zeros(3), TypeError, "expected a tensor, got ndarray"),
    (torch.full((3,), 255, dtype=torch.uint8), ValueError, "expected floating-point values, got torch.uint8; rem"),
    (torch.zeros(3, device="meta"), ValueError, "expected a tensor on cpu, like the means, got one on meta"),
    (torch.zeros(4), ValueError, r"expected shape \(3,\) or \(40, 48, 3\), got \(4,\)"),
    (torch.zeros(48, 40, 3), ValueError, r"expected shape \(3,\) or \(40, 48, 3\), got \(48, 40, 3\)"),
])  # fmt: skip
@pytest.mark.parametrize("features", [None, torch.zeros(10, 2)])
def test_an_invalid_background_raises_with_its_shape(background, kind, message, features):
    with pytest.raises(kind, match=f"^background: {message}"):
        rasterize_splats(*scene(), camera(), background)
    with pytest.raises(kind, match=f"^background: {message}"):
        rasterize(gaussians(), camera(), features, background)


# Labels


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.uint16])
@pytest.mark.parametrize("backend", BACKENDS)
def test_labels_may_be_of_any_integer_type(backend, dtype):
    labels = torch.arange(10)
    expected = rasterize_splats(*scene(), camera(), labels=labels, backend=backend).ids
    assert torch.equal(rasterize_splats(*scene(), camera(), labels=labels.to(dtype), backend=backend).ids, expected)


@pytest.mark.parametrize(("labels", "kind", "message"), [
    (list(range(10)), TypeError, r"expected a tensor, got list; remedy: torch.as_tensor\(labels\)"),
    (np.arange(10), TypeError, "expected a tensor, got ndarray"),
    (torch.ones(10, dtype=torch.bool), ValueError, "expected 10 integers, got torch.bool"),
    (torch.zeros(10, 1, dtype=torch.int32), ValueError, r"expected 10 integers, got torch.int32 of shape \(10, 1\)"),
    (torch.zeros(10, dtype=torch.int32, device="meta"), ValueError, "expected a tensor on cpu.*got one on meta"),
    (torch.arange(10) + 2**31 - 5, ValueError, "expected at most 2147483647, found 2147483652 at index 9"),
])  # fmt: skip
@pytest.mark.parametrize("backend", BACKENDS)
def test_invalid_labels_raise(labels, kind, message, backend):
    with pytest.raises(kind, match=f"^labels: {message}"):
        rasterize_splats(*scene(), camera(), labels=labels, backend=backend)


def test_ids_of_the_reference_are_the_labels_as_large_as_int32():
    inputs = scene(300)
    inputs[2], inputs[3] = 2 * inputs[2], torch.full((300,), 0.9)
    small = torch.arange(300) % 7 - 2
    large = torch.where(small > 0, small + 2**31 - 5, small)
    ids, expected = (rasterize_splats(*inputs, camera(), labels=x, backend="reference").ids for x in (large, small))
    assert len(expected.unique()) > 4 and expected.max() > 0
    assert torch.equal(ids.long(), torch.where(expected > 0, expected.long() + 2**31 - 5, expected.long()))


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixels_without_alpha_have_no_id_at_threshold_zero(backend):
    labels, settings = torch.arange(10) + 3, RasterSettings(id_alpha_min=0.0)
    result = rasterize_splats(*scene(), camera(), labels=labels, settings=settings, backend=backend)
    seen = result.alpha > 0
    assert seen.any() and not seen.all()
    assert (result.ids[~seen] == -1).all() and (result.ids[seen] >= 3).all()


def test_boxes_can_count_the_tiles_of_the_largest_image():
    assert projection.MAX_TILES * projection.TILE >= cameras.MAX_SIDE


# Gaussians


@pytest.mark.parametrize("position", range(5))
def test_inputs_that_are_not_tensors_raise(position):
    inputs = scene()
    inputs[position] = inputs[position].numpy()
    name = ("means", "quats", "scales", "opacities", "channels")[position]
    with pytest.raises(TypeError, match=f"^{name}: expected a tensor, got ndarray"):
        rasterize_splats(*inputs, camera())


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize(("name", "index", "value"), [
    ("means", (3, 1), math.nan), ("quats", (2, 0), math.inf), ("log_scales", (4, 2), math.nan),
    ("log_scales", (9, 0), math.inf), ("log_scales", (1, 1), 100.0), ("opacity_logits", (6,), math.nan),
    ("sh", (7, 0, 2), math.nan), ("sh", (8, 0, 0), math.inf),
])  # fmt: skip
def test_a_raw_parameter_that_cannot_be_drawn_is_named_with_its_index(name, index, value, count):
    broken = gaussians(count)
    getattr(broken, name)[index] = value
    with pytest.raises(ValueError, match=rf"^{name}: expected .*, found {value} at index ") as caught:
        rasterize(broken, camera())
    assert str(index) in str(caught.value)


@pytest.mark.parametrize("changes", [{"log_scales": torch.zeros(10)}, {"opacity_logits": torch.zeros(10, 1)}])
def test_a_raw_parameter_of_another_shape_is_named(changes):
    with pytest.raises(ValueError, match=f"^{next(iter(changes))}: expected shape"):
        rasterize(gaussians(**changes), camera())


def test_meaningful_infinities_of_raw_parameters_are_drawn():
    dots = gaussians()
    dots.log_scales[:], dots.opacity_logits[:5], dots.opacity_logits[5:] = -math.inf, math.inf, -math.inf
    alpha = rasterize(dots, camera()).alpha
    assert torch.isfinite(alpha).all() and alpha.max() > 0.5


@pytest.mark.parametrize("name", ["colors", "features"])
def test_given_colours_and_features_are_named_by_their_own_index(name):
    values = torch.zeros(10, 3)
    values[6, 1] = math.nan
    with pytest.raises(ValueError, match=rf"^{name}: expected finite values, found nan at index \(6, 1\)"):
        rasterize(gaussians(), camera(), **{name: values})


@pytest.mark.parametrize(("given", "kind", "message"), [
    ({"colors": torch.zeros(10, 4)}, ValueError, r"^colors: expected shape \(10, 3\), got \(10, 4\)"),
    ({"colors": torch.zeros(10)}, ValueError, r"^colors: expected shape \(10, 3\), got \(10,\)"),
    ({"colors": torch.zeros(1, 3)}, ValueError, r"^colors: expected shape \(10, 3\), got \(1, 3\)"),
    ({"colors": [[0, 0, 0]] * 10}, TypeError, "^colors: expected a tensor, got list"),
    ({"features": torch.zeros(9, 2)}, ValueError, r"^features: expected shape \(10, F\), got \(9, 2\)"),
    ({"features": torch.zeros(10, 2, device="meta")}, ValueError, "^features: expected a tensor on cpu"),
])  # fmt: skip
def test_colours_and_features_that_do_not_fit_are_named(given, kind, message):
    with pytest.raises(kind, match=message):
        rasterize(gaussians(), camera(), **given)


def test_features_and_colours_of_another_dtype_are_converted():
    colors, features = torch.rand(10, 3), torch.rand(10, 2)
    found = rasterize(gaussians(), camera(), features.double(), colors=colors.double())
    expected = rasterize(gaussians(), camera(), features, colors=colors)
    assert torch.equal(found.color, expected.color) and torch.equal(found.features, expected.features)


# Cameras


@pytest.mark.parametrize(("name", "index", "message"), [
    ("intrinsics", (1, 0), r"intrinsics: expected 0 at index \(1, 0\), found 0.5"),
    ("intrinsics", (2, 0), r"intrinsics: expected \[0.0, 0.0, 1.0\] as the last row, found \[0.5, 0.0, 1.0\]"),
    ("intrinsics", (2, 2), "intrinsics: expected .* as the last row"),
    ("T_cam_world", (3, 3), r"T_cam_world: expected \[0.0, 0.0, 0.0, 1.0\] as the last row"),
    ("T_cam_world", (3, 1), "T_cam_world: expected .* as the last row"),
])  # fmt: skip
def test_unused_entries_of_a_camera_must_have_their_assumed_values(name, index, message):
    def changed(value):
        matrix = getattr(camera(), name).copy()
        matrix[index] = value
        return dataclasses.replace(camera(), **{name: matrix})

    with pytest.raises(ValueError, match=f"^camera: {message}"):
        rasterize_splats(*scene(), changed(0.5))
    exact = 1.0 if index in ((2, 2), (3, 3)) else 0.0
    found = rasterize_splats(*scene(), changed(exact + 1e-12)).image  # as inverting a matrix leaves
    assert torch.equal(found, rasterize_splats(*scene(), camera()).image)


@pytest.mark.parametrize(
    "rotation", [np.zeros((3, 3)), 2 * np.eye(3), np.diag([-1.0, 1.0, 1.0]), np.eye(3) + 0.01 * np.eye(3)[::-1]]
)
def test_a_pose_that_is_not_a_rotation_is_refused(rotation):
    pose = np.eye(4)
    pose[:3, :3] = rotation
    view = dataclasses.replace(camera(), T_cam_world=pose)
    with pytest.raises(ValueError, match=r"T_cam_world: expected a rotation"):
        rasterize_splats(*[t.float() for t in splats(5, 3)], view)


def test_labels_beyond_signed_numbers_are_refused():
    labels = torch.tensor([1, 2**64 - 1, 3], dtype=torch.uint64)
    with pytest.raises(ValueError, match=r"labels.*at index 1"):
        rasterize_splats(*[t.float() for t in splats(3, 3)], camera(), labels=labels)


def test_integer_and_mixed_dtypes_raise_different_errors():
    whole = [t.long() for t in splats(3, 3)]
    with pytest.raises(ValueError, match=r"means: expected floating-point values.*means\.float\(\)"):
        rasterize_splats(*whole, camera())
    mixed = [splats(3, 3)[0], *(t.float() for t in splats(3, 3)[1:])]
    with pytest.raises(ValueError, match=r"quats: expected torch.float64 on cpu, like the means.*remedy"):
        rasterize_splats(*mixed, camera())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 64.0}, "whole numbers of pixels"),
        ({"T_cam_world": np.eye(4).tolist()}, "T_cam_world: expected an array, got list"),
        ({"intrinsics": torch.eye(3)}, "intrinsics: expected an array, got Tensor"),
    ],
)
def test_cameras_of_the_wrong_kinds_are_refused(change, message):
    with pytest.raises(TypeError, match=message):
        rasterize_splats(*[t.float() for t in splats(3, 3)], dataclasses.replace(camera(), **change))


def test_invalid_camera_or_settings_raise():
    scene = [t.float() for t in splats(3, 3)]
    with pytest.raises(TypeError, match="camera: expected a Camera, got NoneType"):
        rasterize_splats(*scene, None)
    with pytest.raises(TypeError, match="settings: expected RasterSettings, got dict"):
        rasterize_splats(*scene, camera(), settings={"alpha_min": 0.1})


# Arrays


@pytest.mark.parametrize("backend", ["auto", *BACKENDS])
def test_arrays_give_the_bits_of_tensors_as_arrays(backend):
    inputs, background, labels = scene(60), torch.full((3,), 0.25), torch.arange(60)
    found, expected = RasterStats(), RasterStats()
    tensors = rasterize_splats(*inputs, camera(), background, labels=labels, backend=backend, stats=expected)
    arrays = rasterize_splats(
        *(t.numpy() for t in inputs), camera(), background.numpy(), labels=labels.numpy(), backend=backend, stats=found
    )
    for name in ("image", "alpha", "depth", "ids"):
        assert type(getattr(arrays, name)) is np.ndarray
        np.testing.assert_array_equal(getattr(arrays, name), getattr(tensors, name).numpy())
    for name in ("visible", "radii", "grad_norm"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name).numpy())


@pytest.mark.parametrize("backend", ["auto", *BACKENDS])
def test_raw_parameters_may_be_arrays(backend):
    raw, features = gaussians(9), torch.rand(10, 2)
    arrays = SimpleNamespace(**{name: value.numpy() for name, value in vars(raw).items()})
    expected = rasterize(raw, camera(), features, torch.full((3,), 0.5), backend=backend)
    found = rasterize(arrays, camera(), features.numpy(), np.full(3, 0.5), backend=backend)
    for name in ("color", "alpha", "depth", "features", "ids"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name).numpy(), atol=1e-6)


def test_arrays_that_kernels_cannot_take_as_they_are_are_copied():
    inputs = [t.numpy() for t in scene()]
    expected = rasterize_splats(*inputs, camera()).image
    frozen = [np.asfortranarray(a) for a in inputs]
    for array in frozen:
        array.flags.writeable = False
    np.testing.assert_array_equal(rasterize_splats(*frozen, camera()).image, expected)


def test_arrays_and_tensors_are_not_mixed():
    inputs = [t.numpy() for t in scene()]
    with pytest.raises(TypeError, match="^labels: expected an array, got Tensor; remedy: numpy.asarray"):
        rasterize_splats(*inputs, camera(), labels=torch.arange(10))
    with pytest.raises(ValueError, match=r"^means: expected floating-point values, got int64; .*astype\('float32'\)"):
        rasterize_splats(*(a.astype(np.int64) for a in inputs), camera())
