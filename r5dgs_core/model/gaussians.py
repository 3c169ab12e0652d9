"""Trainable Gaussians: raw parameters by name, with labels that are updated together with them.

Notation: N Gaussians, K spherical harmonics bases.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

# ``sh`` [N, 1, 3] is the constant colour and ``sh_rest`` [N, K - 1, 3] the view-dependent part, as they have different
# learning rates. ``shading`` is the vector g of `train.representations.fused_posing`.
PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "sh", "sh_rest", "shading")
# Parameters of some runs only: identity encodings.
OPTIONAL = ("identities",)


class Gaussians:
    """Raw parameters and labels of N Gaussians.

    Args:
        params: Tensors by name: ``means`` [N, 3], ``quats`` [N, 4] wxyz, ``log_scales`` [N, 3], ``opacity_logits`` [N],
            ``sh`` [N, 1, 3], ``sh_rest`` [N, K - 1, 3] and ``shading`` [N, 3]; optionally ``identities`` [N, 16], if
            they are trained together.
        motion_ids: Motion group of each Gaussian. [N] int64

    Raises:
        ValueError: A name is unknown or the lengths differ.
    """

    def __init__(self, params: Mapping[str, Tensor], motion_ids: Tensor):
        for name, tensor in params.items():
            _check(name, tensor, len(motion_ids))
        self.params: dict[str, Tensor] = {name: tensor.detach().requires_grad_(True) for name, tensor in params.items()}
        self.motion_ids = motion_ids

    def __len__(self) -> int:
        return len(self.motion_ids)

    def __getattr__(self, name: str) -> Tensor:
        params = self.__dict__.get("params", {})
        if name in params:
            return params[name]
        raise AttributeError(name)

    def to(self, device: torch.device) -> Gaussians:
        """Return the Gaussians on a device."""
        return Gaussians({n: t.detach().to(device) for n, t in self.params.items()}, self.motion_ids.to(device))

    def add(self, name: str, values: Tensor) -> None:
        """Add a parameter [N, ...]. Call it before the optimizer is created."""
        _check(name, values, len(self))
        self.params[name] = values.detach().requires_grad_(True)

    def extend(self, optimizer: torch.optim.Optimizer | None, params: Mapping[str, Tensor], motion_ids: Tensor) -> None:
        """Append Gaussians; the optimizer's moments of the new rows start at zero."""
        self.motion_ids = torch.cat([self.motion_ids, motion_ids])
        self._rebuild(
            optimizer,
            lambda name, tensor: torch.cat([tensor, params[name].detach().to(tensor.dtype)]),
            lambda name, moment: torch.cat([moment, torch.zeros_like(params[name], dtype=moment.dtype)]),
        )

    def keep(self, optimizer: torch.optim.Optimizer | None, mask: Tensor) -> None:
        """Keep the rows for which ``mask`` [N] is True, including the optimizer's state."""
        rows = torch.nonzero(mask)[:, 0]
        if len(rows) == len(mask):
            return
        self.motion_ids = self.motion_ids[rows]
        self._rebuild(optimizer, lambda _, tensor: tensor[rows], lambda _, moment: moment[rows])

    def _rebuild(self, optimizer, change_param, change_moment) -> None:
        for name, old in list(self.params.items()):
            new = change_param(name, old.detach()).contiguous().requires_grad_(True)
            self.params[name] = new
            if optimizer is None:
                continue
            state = optimizer.state.pop(old, None)
            for group in optimizer.param_groups:
                group["params"] = [new if p is old else p for p in group["params"]]
            if state is not None:
                for key in ("exp_avg", "exp_avg_sq"):
                    state[key] = change_moment(name, state[key]).contiguous()
                optimizer.state[new] = state


def _check(name: str, values: Tensor, count: int) -> None:
    if name not in PARAMETERS + OPTIONAL:
        raise ValueError(f"unknown parameter '{name}'; known are {', '.join(PARAMETERS + OPTIONAL)}")
    if len(values) != count:
        raise ValueError(f"'{name}' has {len(values)} rows, motion_ids has {count}")
