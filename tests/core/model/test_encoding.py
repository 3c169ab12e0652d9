"""Networks take rows in chunks: the same values and gradients, in the memory of one chunk."""

import pytest
import torch

from r5dgs_core.model import encoding

WIDTH, ROWS = 16, 60


def evaluate(chunk):
    """Output of a network of three layers, its gradients, and how many numbers were kept for the way back."""
    generator = torch.Generator().manual_seed(5)
    layers = torch.nn.Sequential(
        *(module for _ in range(3) for module in (encoding.linear(WIDTH, WIDTH, generator), torch.nn.SiLU()))
    ).double()
    rows = torch.randn(ROWS, WIDTH, generator=generator, dtype=torch.float64).requires_grad_(True)
    kept = []

    def keep(tensor):
        if tensor.requires_grad and not tensor.is_leaf:
            kept.append(tensor.numel())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        out = encoding.in_chunks(layers, rows, chunk)
    out.sin().sum().backward()
    return out.detach(), [rows.grad, *(p.grad for p in layers.parameters())], sum(kept)


@pytest.mark.parametrize("chunk", [1, 7, 59])
def test_chunks_change_neither_values_nor_gradients_but_memory(chunk):
    whole, gradients, kept = evaluate(ROWS)
    parts, others, less = evaluate(chunk)
    torch.testing.assert_close(parts, whole, atol=1e-14, rtol=0)
    for ours, theirs in zip(others, gradients, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-12, rtol=0)
    assert kept >= 5 * ROWS * WIDTH and less <= ROWS * WIDTH


def test_without_gradients_nothing_is_kept():
    with torch.no_grad():
        out = encoding.in_chunks(lambda rows: rows**2, torch.arange(10.0), 3)
    assert out.tolist() == [k**2 for k in range(10)] and not out.requires_grad
