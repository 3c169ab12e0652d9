"""Run folders as others write them, with their real names and shapes and random weights, and what their rules make of
them: an oracle in float64 that shares no code with the importers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from r5dgs_core.scene import spherical_harmonics
from r5dgs_core.scene.cameras import Camera
from tests.support import scenes

COUNT = 24
T_MAX = 0.7
Weights = dict[str, Tensor]


@dataclass(frozen=True)
class Cloud:
    """The numbers of a PLY file. All [COUNT, ...] float64; ``quats`` are not normalised."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logits: Tensor
    sh: Tensor
    identities: Tensor | None = None


@dataclass(frozen=True)
class Drawn:
    """Gaussians that a rule draws: centres [N, 3] and covariances [N, 3, 3]."""

    means: Tensor
    covariances: Tensor


def cloud(seed: int = 0, identities: bool = False) -> Cloud:
    """A handful of Gaussians around the origin, longer than wide, of degree 3."""
    random = np.random.default_rng(seed)

    def draw(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values.astype(np.float32)).double()

    sh = random.normal(size=(COUNT, 16, 3)) * np.where(np.arange(16) == 0, 0.8, 0.1)[:, None]
    return Cloud(
        draw(random.uniform(-0.8, 0.8, (COUNT, 3))),
        draw(random.normal(size=(COUNT, 4))),
        draw(np.log(random.uniform(0.03, 0.25, (COUNT, 3)))),
        draw(random.normal(1.0, 1.0, COUNT)),
        draw(sh),
        draw(random.normal(size=(COUNT, 16))) if identities else None,
    )


def write_cloud(path: Path, cloud: Cloud, extra: tuple[str, ...] = ()) -> None:
    """Write the PLY in the order of 3DGS: positions, normals, colours channel by channel, opacity, scales, rotation."""
    columns = {name: cloud.means[:, i] for i, name in enumerate("xyz")}
    columns |= {name: torch.zeros(COUNT) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{c}": cloud.sh[:, 0, c] for c in range(3)}
    columns |= {f"f_rest_{c * 15 + k}": cloud.sh[:, 1 + k, c] for c in range(3) for k in range(15)}
    columns |= {"opacity": cloud.logits}
    columns |= {f"scale_{i}": cloud.log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": cloud.quats[:, i] for i in range(4)}
    if cloud.identities is not None:
        columns |= {f"obj_dc_{i}": cloud.identities[:, i] for i in range(16)}
    columns |= {name: torch.zeros(COUNT) for name in extra}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {COUNT}"]
    header += [f"property float {name}" for name in columns] + ["end_header", ""]
    table = np.stack([values.numpy() for values in columns.values()], -1).astype("<f4")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("\n".join(header).encode() + table.tobytes())


def write_common(folder: Path, cloud: Cloud, iteration: int, config: str, extra: tuple[str, ...] = ()) -> None:
    """Files of all layouts: the PLY of an iteration, ``cfg_args`` and ``cameras.json``."""
    write_cloud(folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply", cloud, extra)
    (folder / "cfg_args").write_text(f"Namespace(data_device='cuda', sh_degree=3, {config})")
    camera = view()
    entry = {
        "id": 0,
        "img_name": "r_0",
        "width": camera.width,
        "height": camera.height,
        "position": camera.center.tolist(),
        "rotation": camera.T_cam_world[:3, :3].T.tolist(),
        "fx": camera.intrinsics[0, 0],
        "fy": camera.intrinsics[1, 1],
    }
    (folder / "cameras.json").write_text(json.dumps([entry, {**entry, "id": 1, "img_name": "r_1"}]))


def write_weights(path: Path, weights: Weights) -> None:
    """Save a state dictionary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({name: tensor.float() for name, tensor in weights.items()}, path)


def view() -> Camera:
    """A small camera that sees all Gaussians."""
    return scenes.looking_camera([2.6, 1.5, 1.1], [-2.6, -1.5, -1.1], 0.8, 28, 24, "r_0")


# Networks.


def linears(random: torch.Generator, **shapes: tuple[int, int]) -> Weights:
    """Layers by name (``_`` stands for a dot) of [outputs, inputs], in the size that torch starts them with."""
    weights: Weights = {}
    for name, (outputs, inputs) in shapes.items():
        bound = 1 / math.sqrt(max(inputs, 1))
        for part, shape in (("weight", (outputs, inputs)), ("bias", (outputs,))):
            values = (torch.rand(shape, generator=random, dtype=torch.float64) * 2 - 1) * bound
            weights[f"{name.replace('__', '.')}.{part}"] = values.float().double()
    return weights


def deform_weights(seed: int, width: int, depth: int, inputs: int, *, time: int = 13, screws: bool = False) -> Weights:
    """``deform.pth``: a row of layers with a skip after ``depth // 2``, heads, and a network of ``time`` unless 0."""
    random = torch.Generator().manual_seed(seed)
    shapes = {"timenet__0": (width, time), "timenet__2": (30, width)} if time else {}
    for i in range(depth):
        taken = inputs if i == 0 else width + inputs * (i == depth // 2 + 1)
        shapes[f"linear__{i}"] = (width, taken)
    shapes |= {"branch_w": (3, width), "branch_v": (3, width)} if screws else {"gaussian_warp": (3, width)}
    shapes |= {"gaussian_rotation": (4, width), "gaussian_scaling": (3, width)}
    weights = linears(random, **shapes)
    for name in ("gaussian_warp", "branch_w", "branch_v", "gaussian_rotation"):
        if f"{name}.weight" in weights:
            weights[f"{name}.weight"] = 6 * weights[f"{name}.weight"]  # so that motion depends on place and time
    if time:
        weights["timenet.2.weight"] = 6 * weights["timenet.2.weight"]
    weights["gaussian_rotation.bias"] += torch.tensor([0.4, 0, 0, 0])
    return weights


def gate_weights(width: int = 256) -> Weights:
    """The gate that TRACE's files hold and nobody uses; its first layer has no inputs."""
    shapes = linears(torch.Generator().manual_seed(9), gate_func__2=(1, width))
    return {"gate_func.0.weight": torch.zeros(width, 0), "gate_func.0.bias": torch.zeros(width), **shapes}


def code_weights(seed: int, size: int) -> Weights:
    """``code_field.pth``."""
    shapes = {"linear__0": (128, 51), "linear__1": (128, 128), "linear__2": (128, 128), "linear__3": (128, 179)}
    shapes |= {"output__0": (size, 128), "seg__0": (4 * size, size), "seg__2": (4 * size, 4 * size)}
    return linears(torch.Generator().manual_seed(seed), **shapes, seg__4=(size, 4 * size))


def velocity_weights(seed: int, inputs: int, width: int, hidden: int, outputs: int, bands: int) -> Weights:
    """``vel.pth``: ``hidden`` layers between the first and the last."""
    shapes = {"vel_net__weight_net__0": (width, inputs * (1 + 2 * bands))}
    shapes |= {f"vel_net__weight_net__{i + 2}__0": (width, width) for i in range(hidden)}
    shapes[f"vel_net__weight_net__{hidden + 2}__0"] = (outputs, width)
    weights = linears(torch.Generator().manual_seed(seed), **shapes)
    last = f"vel_net.weight_net.{hidden + 2}.0"
    weights[f"{last}.weight"], weights[f"{last}.bias"] = 4 * weights[f"{last}.weight"], 8 * weights[f"{last}.bias"]
    return {"vel_net.embedder.frequency_bands": 2.0 ** torch.arange(bands), **weights}


# The rules.


def encoded(x: Tensor, bands: int) -> Tensor:
    """Identity, then sine and cosine of every octave."""
    return torch.cat([x] + [f(2**k * x) for k in range(bands) for f in (torch.sin, torch.cos)], dim=1)


def affine(weights: Weights, name: str, x: Tensor) -> Tensor:
    """One layer."""
    return x @ weights[f"{name}.weight"].double().T + weights[f"{name}.bias"].double()


def trunk(weights: Weights, depth: int, inputs: Tensor) -> Tensor:
    """ReLU layers; the inputs are joined to the output of layer ``depth // 2``, before it."""
    hidden = inputs
    for i in range(depth):
        hidden = torch.relu(affine(weights, f"linear.{i}", hidden))
        if i == depth // 2:
            hidden = torch.cat([inputs, hidden], dim=1)
    return hidden


def deform(weights: Weights, depth: int, bands: int, means: Tensor, t: float, codes: Tensor | None = None):
    """Moved centres, raw rotation and raw scale of a deformation network."""
    time = torch.full((len(means), 1), t, dtype=torch.float64)
    if "timenet.0.weight" in weights:
        time = affine(weights, "timenet.2", torch.relu(affine(weights, "timenet.0", encoded(time, 6))))
    else:
        time = encoded(time, 10)
    parts = [encoded(means, bands), time] + ([] if codes is None else [codes])
    hidden = trunk(weights, depth, torch.cat(parts, dim=1))
    if "gaussian_warp.weight" in weights:
        moved = means + affine(weights, "gaussian_warp", hidden)
    else:
        moved = torch.stack(
            [
                screwed(x, w, v)
                for x, w, v in zip(
                    means, affine(weights, "branch_w", hidden), affine(weights, "branch_v", hidden), strict=True
                )
            ]
        )
    return moved, affine(weights, "gaussian_rotation", hidden), affine(weights, "gaussian_scaling", hidden)


def screwed(x: Tensor, w: Tensor, v: Tensor) -> Tensor:
    """A point moved by the screw of Deformable-3DGS with six degrees of freedom: an exponential of 4 x 4."""
    theta = w.norm()
    axis, speed = w / theta + 1e-5, v / theta + 1e-5
    square = skew(axis) @ skew(axis)
    turn = torch.eye(3) + torch.sin(theta) * skew(axis) + (1 - torch.cos(theta)) * square
    shift = theta * torch.eye(3) + (1 - torch.cos(theta)) * skew(axis) + (theta - torch.sin(theta)) * square
    return turn @ x + shift @ speed


def skew(w: Tensor) -> Tensor:
    """Matrix of the cross product with w."""
    zero = torch.zeros((), dtype=w.dtype)
    return torch.stack(
        [torch.stack([zero, -w[2], w[1]]), torch.stack([w[2], zero, -w[0]]), torch.stack([-w[1], w[0], zero])]
    )


def matrices(quats: Tensor) -> Tensor:
    """Matrices that the kernel of 3DGS computes from quaternions of any length, unnormalised. [N, 3, 3]"""
    return torch.stack(
        [torch.eye(3, dtype=torch.float64) + 2 * q[0] * skew(q[1:]) + 2 * skew(q[1:]) @ skew(q[1:]) for q in quats]
    )


def drawn(means: Tensor, quats: Tensor, scales: Tensor) -> Drawn:
    """Covariances that the kernel of 3DGS draws."""
    linear = matrices(quats) * scales[:, None, :]
    return Drawn(means, linear @ linear.transpose(1, 2))


def hamilton(p: Tensor, q: Tensor) -> Tensor:
    """Product of quaternions wxyz."""
    w = p[:, :1] * q[:, :1] - (p[:, 1:] * q[:, 1:]).sum(1, keepdim=True)
    return torch.cat([w, p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + torch.linalg.cross(p[:, 1:], q[:, 1:])], 1)


def unit(x: Tensor) -> Tensor:
    """Rows of length one."""
    return x / x.norm(dim=1, keepdim=True)


def resting(cloud: Cloud) -> Drawn:
    """3DGS and Gaussian Grouping."""
    return drawn(cloud.means, unit(cloud.quats), cloud.log_scales.exp())


def added(cloud: Cloud, weights: Weights, t: float) -> Drawn:
    """Deformable-3DGS: rotation and scale are added to the canonical ones."""
    moved, dq, ds = deform(weights, 8, 10, cloud.means, t)
    return drawn(moved, unit(cloud.quats) + dq, cloud.log_scales.exp() + ds)


def twisted(cloud: Cloud, moved: Tensor, turn: Tensor, growth: Tensor, velocity: Callable | None, t: float) -> Drawn:
    """TRACE and FreeGave: rotation before the canonical one, log scales add; past T_MAX by midpoint steps of 1/60.

    Args:
        cloud: The canonical Gaussians.
        moved: Centres by the deformation network.
        turn: Its raw rotations.
        growth: Its raw scales.
        velocity: From a time since T_MAX to the Gaussians' v, w in the world, each [N, 3].
        t: The time.
    """
    rest, delta, x = t - T_MAX, torch.eye(3, dtype=torch.float64).expand(len(moved), 3, 3), moved
    done = 0.0
    while velocity is not None and rest - done > 1e-9:
        h = min(1 / 60, rest - done)
        v, w = velocity(done)
        middle = x + h / 2 * (v + torch.linalg.cross(w, x))
        v, w = velocity(done + h / 2)
        x = x + h * (v + torch.linalg.cross(w, middle))
        delta = torch.stack([torch.linalg.matrix_exp(h * skew(row)) for row in w]) @ delta
        done += h
    quats = hamilton(unit(turn), unit(cloud.quats))
    linear = delta @ matrices(quats) * (cloud.log_scales + growth).exp()[:, None, :]
    return Drawn(x, linear @ linear.transpose(1, 2))


def picture(cloud: Cloud, shown: Drawn, camera: Camera, background: float) -> np.ndarray:
    """Blend Gaussians in order of depth as 3DGS does, one pixel at a time. [H, W, 3]"""
    turn, shift = (torch.from_numpy(camera.T_cam_world[:3, s]) for s in (slice(0, 3), 3))
    local = shown.means @ turn.T + shift
    fx, fy, cx, cy = (camera.intrinsics[i] for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y, z = local.T
    zero = torch.zeros_like(z)
    slopes = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).reshape(-1, 2, 3) @ turn
    flat = slopes @ shown.covariances @ slopes.transpose(1, 2) + 0.3 * torch.eye(2)
    sharp = torch.linalg.inv(flat)
    centers = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    directions = shown.means - torch.from_numpy(camera.center)
    rgb = spherical_harmonics.to_rgb(cloud.sh, unit(directions)).clamp_min(0)
    image = np.zeros((camera.height, camera.width, 3))
    for row in range(camera.height):
        for column in range(camera.width):
            color, left = torch.zeros(3, dtype=torch.float64), 1.0
            offset = torch.tensor([column + 0.5, row + 0.5]) - centers
            power = (offset[:, None] @ sharp @ offset[:, :, None])[:, 0, 0]
            alphas = (torch.sigmoid(cloud.logits) * torch.exp(-power / 2)).clamp_max(0.99)
            for i in torch.argsort(z).tolist():
                if alphas[i] >= 1 / 255 and left * (1 - float(alphas[i])) >= 1e-4:
                    color, left = color + left * alphas[i] * rgb[i], left * (1 - float(alphas[i]))
            image[row, column] = (color + left * background).numpy()
    return image
