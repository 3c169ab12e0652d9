"""The cuda backend agrees with the reference; without a GPU, a stand-in replaces gsplat.

The stand-in (`tests/support/gsplat_stand_in.py`) shows that our side of the border is right: projection, order,
culling, padding, chunks, ids, gradients. That gsplat does what the stand-in does is shown by the same tests with the
marker `gpu`: `pytest -m gpu` on a machine that has one. Where gsplat is installed without a GPU, its signatures and its
own tile lists in plain torch are compared.
"""

import dataclasses
import inspect
import logging
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r5dgs_core import errors
from r5dgs_core.raster import RasterSettings, RasterStats, SplatImage, backends, cuda, rasterize_splats
from tests.support import gsplat_stand_in, processes, splats
from tests.support.gsplat_stand_in import OLD_STAND_IN, STAND_IN
from tests.support.splats import camera, relative

pytestmark = pytest.mark.heavy

ROOT = Path(__file__).parents[3]
TOLERANCE = 2e-5  # float32 against float64, as for the other backends; about 4e-6 was seen with the stand-in
# On a GPU fast exponentials move a few pixels over a cut-off (share of them), and the backward pass starts from
# 1 - alpha in float32, which has three digits where a pixel is finished (tolerance of gradients).
LIMITS = {"stand-in": (0.0, TOLERANCE), "gsplat": (0.005, 2e-3)}


def use(kernels, monkeypatch):
    """Let the backend find these kernels, and take tensors that are on the CPU."""
    monkeypatch.setattr(cuda, "find_kernels", lambda: kernels)
    monkeypatch.setattr(cuda, "why_unavailable", lambda device, dtype: None)


@pytest.fixture(params=["stand-in", pytest.param("gsplat", marks=pytest.mark.gpu)])
def rasterize_cuda(request, monkeypatch):
    """`rasterize_splats` with backend cuda for tensors on the CPU: by the stand-in there, or by gsplat on a GPU."""
    if request.param == "stand-in":
        use(STAND_IN, monkeypatch)
        device = torch.device("cpu")
    else:
        device = torch.device("cuda")
        reason = cuda.why_unavailable(device, torch.float32)
        if reason is not None:
            pytest.skip(f"gsplat cannot draw here: {reason}")

    def rasterize(*inputs, labels=None, **options):
        inputs = [t.to(device) if isinstance(t, torch.Tensor) else t for t in inputs]
        labels = None if labels is None else labels.to(device)
        result = rasterize_splats(*inputs, labels=labels, backend="cuda", **options)
        parts = (result.image, result.alpha, result.depth, result.ids)
        assert all(part is None or part.device.type == device.type for part in parts)
        return SplatImage(*(None if part is None else part.cpu() for part in parts))

    rasterize.limits = LIMITS[request.param]
    return rasterize


def draw(rasterize, *arguments, monkeypatch, **options):
    """`splats.draw` with the backend cuda through this function."""
    with monkeypatch.context() as patch:
        patch.setattr(splats, "rasterize_splats", lambda *inputs, backend, **more: rasterize(*inputs, **more))
        result, gradients, stats = splats.draw(*arguments, "cuda", **options)
    values = dataclasses.asdict(stats)
    return (
        result,
        gradients,
        RasterStats(**{name: v.cpu() if isinstance(v, torch.Tensor) else v for name, v in values.items()}),
    )


def assert_agrees(rasterize, monkeypatch, scene, view, background=None):
    """Images, gradients and statistics are those of the reference, within the limits of this rasterizer."""
    moved, gradient_tolerance = rasterize.limits
    expected, expected_gradients, expected_stats = splats.draw(scene, view, "reference", background)
    found, gradients, stats = draw(rasterize, scene, view, background=background, monkeypatch=monkeypatch)
    for name in ("image", "alpha", "depth"):
        differences = (getattr(found, name) - getattr(expected, name)).abs() / getattr(expected, name).abs().max()
        assert (differences > TOLERANCE).float().mean() <= moved, name
        assert differences.max() < 0.02, name
    for name, gradient in expected_gradients.items():
        assert relative(gradients[name], gradient) < gradient_tolerance, name
    assert torch.equal(stats.visible, expected_stats.visible)
    assert relative(stats.radii, expected_stats.radii) < 1e-6
    assert relative(stats.grad_norm, expected_stats.grad_norm) < gradient_tolerance
    return found


# It agrees with the reference


@pytest.mark.parametrize("n_channels", [1, 3, 6, 19, 40])
def test_images_and_gradients_are_those_of_the_reference(rasterize_cuda, monkeypatch, n_channels):
    scene = splats.splats(n_channels=n_channels, seed=n_channels)
    background = torch.rand(40, 48, n_channels, generator=torch.Generator().manual_seed(1)).double()
    assert_agrees(rasterize_cuda, monkeypatch, scene, camera(), background)


@pytest.mark.parametrize("size", [(1, 1), (33, 31), (65, 70)])
def test_any_size_and_skew_is_that_of_the_reference(rasterize_cuda, monkeypatch, size):
    view = camera(*size, skew=2.0, offset=(1.5, -2.0))
    background = torch.tensor([0.2, 0.5, 0.7]).double()
    assert_agrees(rasterize_cuda, monkeypatch, splats.splats(300, 3, seed=5), view, background)


def test_pixels_finish_where_those_of_the_reference_do(rasterize_cuda, monkeypatch):
    scene = splats.splats(800, 3, seed=6, radius_px=25.0)
    scene[3] = (0.9 + 0.1 * scene[3]).float().double()
    assert assert_agrees(rasterize_cuda, monkeypatch, scene, camera()).alpha.min() > 0.99


def test_the_nearer_of_two_layers_at_the_alpha_cap_matches_the_reference(rasterize_cuda, monkeypatch):
    if isinstance(cuda.find_kernels(), cuda.Kernels) and cuda.find_kernels().alpha_max != 0.99:
        pytest.skip("this gsplat has another cap")
    scene = [t[:2].clone() for t in splats.splats(2, 2)]
    scene[0][:], scene[2][:], scene[3][:], scene[4] = torch.zeros(3), 1e3, 1.0, torch.eye(2).double()
    found = assert_agrees(rasterize_cuda, monkeypatch, scene, camera())
    assert (found.image[..., 0] - 0.99).abs().max() < TOLERANCE and not found.image[..., 1].any()


def test_gaussians_off_the_frustum_keep_their_gradients(rasterize_cuda, monkeypatch):
    scene = splats.splats(200, 3, seed=9, radius_px=60.0)
    scene[0] = (scene[0] * torch.tensor([4.0, 4.0, 1.0])).float().double()
    assert_agrees(rasterize_cuda, monkeypatch, scene, camera())


def test_needles_and_discs_keep_their_gradients(rasterize_cuda, monkeypatch):
    scene = splats.splats(60, 3, seed=8)
    scene[2][:20] = torch.tensor([3e-4, 3e-4, 1.0])
    scene[2][20:40] = torch.tensor([1.0, 1.0, 1e-3])
    scene[2][40:50] = torch.tensor([0.0, 0.0, 0.5])
    assert_agrees(rasterize_cuda, monkeypatch, [t.float().double() for t in scene], camera())


def test_ids_are_those_of_the_reference(rasterize_cuda):
    scene = [t.float() for t in splats.splats(400, 3, seed=4)]
    labels = torch.from_numpy(np.random.default_rng(4).choice([-2, -1, 0, 3, *range(100, 140)], 400))
    expected = rasterize_splats(*scene, camera(), labels=labels, backend="reference").ids
    found = rasterize_cuda(*scene, camera(), labels=labels).ids
    assert found.dtype == torch.int32 and len(expected.unique()) > 20
    assert (found != expected).float().mean() < 0.002


@pytest.mark.parametrize("labels", [[5, 7], [7, 5], [-1, 2], [7, 999], [999, 7]])
def test_equal_votes_go_to_the_smallest_label(rasterize_cuda, labels):
    scene = [t.float().clone() for t in splats.splats(42, 3)]
    scene[0][:], scene[2][:], scene[3][:] = 0.0, 1e6, 0.005
    scene[3][:2] = torch.tensor([1 / 4, 1 / 3])  # so the second one has 3/4 * 1/3, which is 1/4 in float32
    others = torch.arange(100, 140)  # more labels than gsplat blends at a time
    ids = rasterize_cuda(*scene, camera(), labels=torch.cat([torch.tensor(labels), others])).ids
    assert (ids == min(labels)).all()


@pytest.mark.parametrize("n", [0, 3])
def test_an_empty_view_shows_the_background_with_zero_gradients(rasterize_cuda, n):
    scene = [t[:n].float().requires_grad_() for t in splats.splats(3, 3)]
    view = camera()
    view.T_cam_world[2, 3] = -30.0
    background, stats = torch.rand(40, 48, 3), RasterStats()
    result = rasterize_cuda(*scene, view, background, labels=torch.arange(n), stats=stats)
    assert torch.equal(result.image, background) and not result.alpha.any() and not result.depth.any()
    assert (result.ids == -1).all() and not stats.visible.any()
    (result.image.sum() + result.alpha.sum() + result.depth.sum()).backward()
    assert all(torch.equal(t.grad, torch.zeros_like(t)) for t in scene)


def test_gradients_do_not_depend_on_the_other_requested_gradients(rasterize_cuda):
    scene = [t.float() for t in splats.splats(100, 3, seed=17)]

    def gradient(position, others):
        leaves = [t.clone().requires_grad_(others or i == position) for i, t in enumerate(scene)]
        rasterize_cuda(*leaves, camera()).image.square().sum().backward()
        return leaves[position].grad

    for position in range(5):
        alone, beside = gradient(position, False), gradient(position, True)
        assert relative(alone, beside) < 1e-5  # gsplat adds in any order


def test_frames_without_gradients_are_the_same(rasterize_cuda):
    scene = [t.float() for t in splats.splats(100, 3, seed=18)]
    with_graph = rasterize_cuda(*[t.requires_grad_() for t in scene], camera())
    with torch.no_grad():
        without = rasterize_cuda(*scene, camera())
    assert with_graph.image.requires_grad and not without.image.requires_grad
    assert torch.equal(with_graph.image, without.image)


@pytest.mark.parametrize("capacity", [0, 20000])
def test_the_fused_projection_draws_nearly_the_same(rasterize_cuda, monkeypatch, capacity):
    scene = splats.splats(400, 3, seed=21)
    scene[3] = scene[3].clamp_max(0.9).float().double()  # below the cap of any gsplat
    draft = RasterSettings(exact=False)
    expected, gradients, stats = splats.draw(scene, camera(), "reference")
    with monkeypatch.context() as patch:

        def rasterize(*inputs, backend, **options):
            options["stats"].capacity = capacity
            return rasterize_cuda(*inputs, settings=draft, **options)

        patch.setattr(splats, "rasterize_splats", rasterize)
        found, drafted, more = splats.draw(scene, camera(), "cuda")
    moved = ((found.image - expected.image).abs() > 1e-3).float().mean()
    assert moved < 0.005 and (found.image - expected.image).abs().max() < 0.05
    for name, gradient in gradients.items():
        assert relative(drafted[name], gradient) < 5e-3, name
    visible, radii, norms = (getattr(more, name).cpu() for name in ("visible", "radii", "grad_norm"))
    assert (visible != stats.visible).float().mean() < 0.01  # boxes of whole pixels
    both = visible & stats.visible
    assert relative(radii[both], stats.radii[both]) < 1e-3 and relative(norms, stats.grad_norm) < 5e-3
    assert not capacity or 0 < int(more.pairs) <= capacity


def test_pairs_beyond_the_capacity_are_left_out_and_counted(rasterize_cuda):
    scene = [t.float() for t in splats.splats(400, 3, seed=21)]
    whole, few = RasterStats(capacity=20000), RasterStats(capacity=50)
    for stats in (whole, few):
        found = rasterize_cuda(*scene, camera(), settings=RasterSettings(exact=False), stats=stats)
        assert bool(torch.isfinite(found.image).all())
    assert int(whole.pairs) == int(few.pairs) > 50


def test_coordinates_far_outside_the_image_do_not_reach_gsplat(monkeypatch):
    """Its tile boxes are integers, so a Gaussian of a million pixels must be cut to the image before."""
    seen = {}

    def spy(means2d, radii, *others):
        seen.update(means2d=means2d, radii=radii)
        return gsplat_stand_in.isect_tiles(means2d, radii, *others)

    use(dataclasses.replace(STAND_IN, isect_tiles=spy), monkeypatch)
    scene = [t.float() for t in splats.splats(30, 3, radius_px=1e9)]
    alpha = rasterize_splats(*scene, camera(), backend="cuda").alpha
    expected = rasterize_splats(*scene, camera(), backend="reference").alpha
    assert seen["radii"].max() <= 24 and seen["means2d"].min() >= 0 and seen["means2d"].max() <= 48
    torch.testing.assert_close(alpha, expected, atol=0.01, rtol=0)


# What gsplat itself says


class Recorder:
    """Kernels of the stand-in that record their calls."""

    def __init__(self):
        self.calls = []

    def kernels(self):
        def recorded(name):
            def call(*arguments, **options):
                self.calls.append((name, arguments, options))
                return getattr(STAND_IN, name)(*arguments, **options)

            return call

        names = ("isect_tiles", "isect_offset_encode", "rasterize_to_pixels")
        return dataclasses.replace(STAND_IN, **{name: recorded(name) for name in names})


def test_calls_fit_the_signatures_of_gsplat_and_its_tile_lists_are_ours(monkeypatch):
    gsplat = pytest.importorskip("gsplat", reason="gsplat does not import here", exc_type=ImportError)
    from gsplat.cuda import _torch_impl

    recorder = Recorder()
    use(recorder.kernels(), monkeypatch)
    rasterize_splats(*[t.float() for t in splats.splats(60, 3)], camera(), labels=torch.arange(60), backend="cuda")
    assert {name for name, *_ in recorder.calls} == {"isect_tiles", "isect_offset_encode", "rasterize_to_pixels"}
    for name, arguments, options in recorder.calls:
        inspect.signature(getattr(gsplat, name)).bind(*arguments, **options)
    _, arguments, _ = recorder.calls[0]
    _, keys, pairs = _torch_impl._isect_tiles(*arguments)
    _, our_keys, our_pairs = gsplat_stand_in.isect_tiles(*arguments)
    assert torch.equal(keys, our_keys) and torch.equal(pairs, our_pairs)
    starts = _torch_impl._isect_offset_encode(keys, 1, *arguments[4:6])
    assert torch.equal(starts, gsplat_stand_in.isect_offset_encode(keys, 1, *arguments[4:6]))
    assert cuda._read_thresholds()["alpha_max"] in (0.99, 0.999)


# Settings


@pytest.mark.parametrize("change", [{"alpha_min": 0.01}, {"transmittance_min": 1e-3}, {"alpha_max": 0.9}])
def test_settings_that_gsplat_cannot_meet_are_named(monkeypatch, change):
    use(STAND_IN, monkeypatch)
    scene = [t.float() for t in splats.splats(10, 3)]
    scene[3][0] = 1.0
    ((name, value),) = change.items()
    with pytest.raises(errors.BackendError, match=rf"cuda.*{name}.*1\.6\.0.*got {value}.*remedy"):
        rasterize_splats(*scene, camera(), settings=RasterSettings(**change), backend="cuda")


def test_a_cap_above_all_opacities_is_exact(monkeypatch):
    use(OLD_STAND_IN, monkeypatch)
    scene = splats.splats(100, 3)
    scene[3] = scene[3].clamp_max(0.9)
    scene = [t.float() for t in scene]
    for alpha_max in (0.9, 0.99):
        options = {"settings": RasterSettings(alpha_max=alpha_max)}
        found, expected = (rasterize_splats(*scene, camera(), backend=b, **options) for b in ("cuda", "reference"))
        torch.testing.assert_close(found.image, expected.image, atol=TOLERANCE, rtol=0)


def test_an_old_gsplat_uses_another_alpha_cap_and_warns_once(monkeypatch, caplog):
    use(OLD_STAND_IN, monkeypatch)
    cuda._warn_once.cache_clear()
    scene = [t.float() for t in splats.splats(1, 3)]
    scene[0][:], scene[2][:], scene[3][:] = 0.0, 0.5, 1.0
    found = [rasterize_splats(*scene, camera(), backend="cuda").alpha.max().item() for _ in range(2)]
    assert found == pytest.approx([0.999, 0.999], abs=1e-3)
    assert caplog.text.count("caps alpha at 0.999") == 1 and "gsplat 1.6" in caplog.text


# Where it cannot draw


@pytest.fixture
def cuda_machine(monkeypatch):
    """Pretend that torch has CUDA and a device, so that only other missing parts are reported."""
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    saved = {name: module for name, module in sys.modules.items() if name.split(".")[0] == "gsplat"}
    forget_gsplat()
    yield
    forget_gsplat()
    sys.modules.update(saved)


def forget_gsplat():
    for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
        del sys.modules[name]
    cuda.find_kernels.cache_clear()


def install(folder, monkeypatch, version="1.5.3", init="", backend="_C = object()", constants=None):
    """Package named gsplat with only the names that the backend looks up when it loads it."""
    package = folder / "gsplat"
    (package / "cuda").mkdir(parents=True)
    functions = "isect_tiles = isect_offset_encode = rasterize_to_pixels = fully_fused_projection = print"
    (package / "__init__.py").write_text(f"{init}\n__version__ = '{version}'\n{functions}\n")
    (package / "cuda" / "__init__.py").write_text("")
    (package / "cuda" / "_backend.py").write_text(backend)
    if constants is not None:
        (package / "cuda" / "_constants.py").write_text(constants)
    monkeypatch.syspath_prepend(folder)


ON_GPU = SimpleNamespace(device=torch.device("cuda"), dtype=torch.float32)


def refusal(means=ON_GPU):
    with pytest.raises(errors.BackendError) as caught:
        backends.choose("cuda", means)
    return str(caught.value)


def test_torch_without_cuda_raises_backend_error(monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", None)
    with pytest.raises(errors.BackendError, match=r"rasterizer 'cuda': torch .* without CUDA; remedy: install"):
        rasterize_splats(*[t.float() for t in splats.splats(3, 3)], camera(), backend="cuda")


def test_a_machine_without_cuda_device_raises_backend_error(monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    message = refusal()
    assert "no CUDA device" in message and "nvidia-smi" in message and "12.8" in message


def test_tensors_that_gsplat_cannot_take_raise_backend_error(cuda_machine):
    assert "got cpu; remedy: move" in refusal(torch.zeros(3))
    double = refusal(SimpleNamespace(device=torch.device("cuda"), dtype=torch.float64))
    assert "float32" in double and "float64" in double and "remedy" in double


def test_a_missing_gsplat_raises_backend_error(cuda_machine, monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    assert "gsplat is not installed; remedy: pip install 'r5dgs[cuda]'" in refusal()


@pytest.mark.parametrize(
    ("package", "said"),
    [
        ({"version": "1.4.0"}, r"1\.4\.0 is too old.*gsplat>=1\.5"),
        ({"backend": "_C = None"}, r"1\.5\.3 finds no CUDA toolkit.*CUDA_HOME"),
        ({"backend": "raise RuntimeError('no ninja\\nlog')"}, r"does not load \(RuntimeError: no ninja\).*nvcc"),
        ({"init": "import a_package_that_is_not_there"}, r"does not load \(ModuleNotFoundError.*a_package_that"),
    ],
)
def test_a_gsplat_that_does_not_load_raises_backend_error(cuda_machine, monkeypatch, tmp_path, package, said):
    install(tmp_path, monkeypatch, **package)
    message = refusal()
    assert message == refusal() and "remedy" in message
    assert re.search(said, message), message


def test_gsplat_is_loaded_once_and_leaves_stdout_alone(cuda_machine, monkeypatch, tmp_path, capsys):
    install(tmp_path, monkeypatch, backend="print('building')\n_C = object()")
    assert backends.choose("cuda", ON_GPU).name == backends.choose("auto", ON_GPU).name == "cuda"
    assert capsys.readouterr() == ("", "building\n")


@pytest.mark.parametrize(
    ("constants", "alpha_max"),
    [(None, 0.999), ("ALPHA_THRESHOLD = 1 / 255\nMAX_ALPHA = 0.99\nTRANSMITTANCE_THRESHOLD = 1e-4", 0.99)],
)
def test_thresholds_are_those_of_the_installed_gsplat(cuda_machine, monkeypatch, tmp_path, constants, alpha_max):
    install(tmp_path, monkeypatch, constants=constants)
    kernels = cuda.find_kernels()
    assert (kernels.alpha_min, kernels.alpha_max, kernels.transmittance_min) == (1 / 255, alpha_max, 1e-4)


def test_auto_uses_the_reference_on_a_gpu_without_gsplat_and_warns_once(cuda_machine, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    backends._warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert [backends.choose("auto", ON_GPU).name for _ in range(2)] == ["reference", "reference"]
    assert caplog.text.count("pip install 'r5dgs[cuda]'") == 1


def test_the_cpu_draws_without_looking_for_a_gpu(tmp_path):
    """gsplat is installed, and its import would raise an error."""
    (tmp_path / "gsplat.py").write_text("raise AssertionError('gsplat was imported')")
    script = (
        "import sys\n"
        "sys.path[:0] = sys.argv[1:]\n"
        "import torch, r5dgs_core.raster as raster\n"
        "from tests.support.splats import camera, splats\n"
        "for backend in ('auto', 'reference'):\n"
        "    raster.rasterize_splats(*[t.float() for t in splats(5, 3)], camera(), backend=backend)\n"
        "assert 'gsplat' not in sys.modules\n"
        "assert not torch.cuda.is_initialized()\n"
        "print('drawn')"
    )
    result = processes.run(script, tmp_path, ROOT)
    assert result.stdout == "drawn\n", result.stderr
