"""Weights of other projects: dense tensors of real numbers are accepted, all other kinds are named."""

import zipfile

import pytest
import torch

from r5dgs_core.errors import CheckpointError
from r5dgs_core.importing import weights

PLAIN = torch.arange(6.0).reshape(2, 3)
ODD = {
    "sparse": PLAIN.to_sparse,
    "sparse_csr": PLAIN.to_sparse_csr,
    "quantized": lambda: torch.quantize_per_tensor(PLAIN, 0.1, 0, torch.qint8),
    "meta": lambda: PLAIN.to("meta"),
    "stride_0": lambda: torch.zeros(1).expand(1 << 40),
    "complex": lambda: PLAIN.to(torch.complex64),
    "overlapping": lambda: torch.zeros(20).as_strided((3, 4), (1, 2)),
}


@pytest.mark.filterwarnings("ignore:Sparse CSR tensor support", "ignore:torch.quantize_per", "ignore:TypedStorage")
@pytest.mark.parametrize("kind", ODD)
def test_a_tensor_that_is_not_dense_and_real_is_named(tmp_path, kind):
    torch.save({"fine": PLAIN, kind: ODD[kind]()}, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match=f"a.pth: '{kind}': expected a dense tensor"):
        weights.load(tmp_path / "a.pth")


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.bool])
def test_all_real_types_become_float32(tmp_path, dtype):
    torch.save({"a": torch.nn.Parameter(PLAIN.to(dtype), requires_grad=False)}, tmp_path / "a.pth")
    assert weights.load(tmp_path / "a.pth").tensors["a"].dtype == torch.float32


def test_compressed_members_are_refused_as_they_could_inflate_to_any_size(tmp_path):
    torch.save({"a": torch.zeros(1 << 20)}, tmp_path / "plain.pth")
    with zipfile.ZipFile(tmp_path / "plain.pth") as source, zipfile.ZipFile(tmp_path / "a.pth", "w", 8) as target:
        for name in source.namelist():
            target.writestr(name, source.read(name))
    with pytest.raises(CheckpointError, match="compressed members"):
        weights.load(tmp_path / "a.pth")
