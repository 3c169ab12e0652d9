"""The device of a run is the named one, or the best one that can train; errors name the remedy."""

import pytest
import torch

from r5dgs_core.config import config
from r5dgs_core.errors import BackendError, UsageError
from r5dgs_core.raster import cuda
from r5dgs_core.train import devices


@pytest.fixture
def two_gpus(monkeypatch):
    """Pretend that torch finds two GPUs and gsplat loads; returns the devices that become the current one."""
    current = []
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", current.append)
    monkeypatch.setattr(cuda, "why_unavailable", lambda device, dtype: None)
    return current


def test_without_cuda_auto_is_the_cpu_and_cuda_an_error_with_remedy(monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", None)
    assert devices.select("auto") == devices.select("cpu") == torch.device("cpu")
    with pytest.raises(BackendError, match="device cuda: torch .* without CUDA; remedy: .*--device cpu"):
        devices.select("cuda")


def test_auto_needs_gsplat(two_gpus, monkeypatch):
    assert devices.select("auto") == devices.select("cuda") == torch.device("cuda:0")
    assert devices.select("cuda:1") == torch.device("cuda:1")
    monkeypatch.setattr(cuda, "why_unavailable", lambda device, dtype: "gsplat is not installed; remedy: install it")
    assert devices.select("auto") == torch.device("cpu")
    with pytest.raises(BackendError, match="gsplat is not installed"):
        devices.select("cuda")


def test_the_gpu_of_a_run_is_the_current_device(two_gpus):
    devices.select("cuda:1")
    assert two_gpus == [torch.device("cuda:1")]


def test_a_gpu_that_does_not_exist_is_named(two_gpus):
    with pytest.raises(BackendError, match=r"cuda:2: torch finds 2 .*remedy: --device cuda:1"):
        devices.select("cuda:2")


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:x", "CPU"])
def test_other_names_are_refused(name):
    with pytest.raises(UsageError, match="auto, cpu, cuda or cuda:N"):
        config.load(None, [f"train.device={name}"])
