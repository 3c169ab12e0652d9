"""Canonical Gaussians to splats: group poses, activations and shading in one fused pass.

For a Gaussian of group g, with rotation R, quaternion q_g, displacement d and centre c of the group:

    mean' = R (mean - c) + c + d          quat' = q_g * quat
    scale' = exp(log_scale)               opacity' = sigmoid(logit)
    colour' = max(0, rgb) max(0, 1 + (R^T l - l) . g_i)

``l`` is one light direction and ``g_i`` a vector per Gaussian: the first-order change of diffuse shading as the body
turns in fixed light. Both passes are one loop over the Gaussians; the backward pass sums per group over a fixed number
of chunks in a fixed order, so that results do not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...model.group_poses import GroupPoses
from ...motion import rotations
from ...raster import arrays, thread_pool
from ...raster import compilation as kernels

CHUNKS = 16


@dataclass(frozen=True)
class PosedSplats:
    """Posed, activated Gaussians: means [N, 3], quats [N, 4], scales [N, 3], opacities [N], colors [N, 3]."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


def pose(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    log_scales: Tensor,  # [N, 3]
    opacity_logits: Tensor,  # [N]
    colors: Tensor,  # [N, 3]
    shading: Tensor,  # [N, 3]
    light: Tensor,  # [3]
    motion_ids: Tensor,  # [N]
    group_poses: GroupPoses,
    centers: Tensor,  # [G, 3]
) -> PosedSplats:
    """Move canonical Gaussians with their groups and activate their parameters.

    Args:
        means: Canonical centres. [N, 3]
        quats: Canonical rotations wxyz, any positive norm. [N, 4]
        log_scales: Logarithms of the standard deviations. [N, 3]
        opacity_logits: Opacities before the sigmoid. [N]
        colors: RGB before clamping at zero. [N, 3]
        shading: Shading vector g of each Gaussian; zeros for constant colours. [N, 3]
        light: The light vector l; it is not normalised. [3]
        motion_ids: Group of each Gaussian. [N] int64
        group_poses: Poses of the G groups at the time of the splats.
        centers: Centres of rotation of the groups. [G, 3]

    Returns:
        Splats for the rasterizer; differentiable in everything but ``motion_ids`` and ``centers``.
    """
    if not arrays.takes_kernels(means):
        given = means, quats, log_scales, opacity_logits, colors, shading, light, motion_ids, group_poses, centers
        return _pose_in_torch(*given)
    return PosedSplats(
        *_Pose.apply(
            means,
            quats,
            log_scales,
            opacity_logits,
            colors,
            shading,
            light,
            group_poses.quats,
            group_poses.rotmats,
            group_poses.displacements,
            motion_ids,
            centers,
        )
    )


def activate(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    log_scales: Tensor,  # [N, 3]
    opacity_logits: Tensor,  # [N]
    colors: Tensor,  # [N, 3]
) -> PosedSplats:
    """Activate the parameters of Gaussians that are already in their pose; see `pose` for the arguments.

    It is `pose` with one group at rest and no shading, so that its exponentials are the same to the bit.
    """
    if not arrays.takes_kernels(means):
        return PosedSplats(means, quats, log_scales.exp(), opacity_logits.sigmoid(), colors.clamp(min=0))
    at_rest = GroupPoses(torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.eye(3)[None], torch.zeros(1, 3))
    return pose(
        means,
        quats,
        log_scales,
        opacity_logits,
        colors,
        torch.zeros_like(means),
        torch.zeros(3),
        torch.zeros(len(means), dtype=torch.int64),
        at_rest,
        torch.zeros(1, 3),
    )


def _pose_in_torch(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    colors: Tensor,
    shading: Tensor,
    light: Tensor,
    motion_ids: Tensor,
    group_poses: GroupPoses,
    centers: Tensor,
) -> PosedSplats:
    """Implement `pose` by the formulas of the kernels, for tensors on other devices."""
    rotmats = group_poses.rotmats
    arm = centers - (rotmats @ centers[..., None])[..., 0] + group_poses.displacements
    turned_light = light @ rotmats - light
    table = torch.cat([rotmats.flatten(1), arm, group_poses.quats, turned_light], 1)
    # index_select sums gradients into the rows of the table; indexing would sort them first.
    rotmat, arm, turn, towards = table.index_select(0, motion_ids).split([9, 3, 4, 3], 1)
    lit = (1 + (towards * shading).sum(1, keepdim=True)).clamp(min=0)
    return PosedSplats(
        (rotmat.view(-1, 3, 3) * means[:, None]).sum(-1) + arm,
        rotations.multiply(turn, quats),
        log_scales.exp(),
        opacity_logits.sigmoid(),
        colors.clamp(min=0) * lit,
    )


class _Pose(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, log_scales, logits, colors, shading, light, gq, gr, gd, ids, centers):
        arrays = [
            t.detach().contiguous().numpy()
            for t in (means, quats, log_scales, logits, colors, shading, light, gq, gr, gd)
        ]
        ids_array, centers_array = ids.numpy(), centers.detach().numpy()
        n = len(arrays[0])
        out = [np.empty((n, 3), np.float32), np.empty((n, 4), np.float32), np.empty((n, 3), np.float32)]
        out += [np.empty(n, np.float32), np.empty((n, 3), np.float32)]
        thread_pool.run(_forward, CHUNKS, *arrays, ids_array, centers_array, *out)
        ctx.saved = (arrays, ids_array, centers_array, out)
        return tuple(torch.from_numpy(a) for a in out)

    @staticmethod
    def backward(ctx, *grads):
        arrays, ids, centers, out = ctx.saved
        upstream = [np.zeros_like(o) if g is None else g.contiguous().numpy() for g, o in zip(grads, out, strict=True)]
        groups = len(centers)
        result = [np.empty_like(a) for a in arrays[:6]]
        group_grads = np.zeros((CHUNKS, groups, 16), np.float64)
        light_grad = np.zeros((CHUNKS, 3), np.float64)
        inputs = (*arrays, ids, centers, out[2], out[3], *upstream)
        thread_pool.run(_backward, CHUNKS, *inputs, *result, group_grads, light_grad)
        total = group_grads.sum(0)
        tensors = [torch.from_numpy(a) for a in result]
        return (
            *tensors,
            torch.from_numpy(light_grad.sum(0).astype(np.float32)),
            torch.from_numpy(total[:, 12:16].astype(np.float32)),
            torch.from_numpy(total[:, :9].astype(np.float32)).reshape(groups, 3, 3),
            torch.from_numpy(total[:, 9:12].astype(np.float32)),
            None,
            None,
        )


@kernels.kernel
def _forward(
    worker,
    workers,
    means,
    quats,
    log_scales,
    logits,
    colors,
    shading,
    light,
    gq,
    gr,
    gd,
    ids,
    centers,
    om,
    oq,
    os,
    oo,
    oc,
):
    n = len(ids)
    for chunk in range(worker, CHUNKS, workers):
        for i in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            g = ids[i]
            x0 = means[i, 0] - centers[g, 0]
            x1 = means[i, 1] - centers[g, 1]
            x2 = means[i, 2] - centers[g, 2]
            turn = np.float32(1.0)
            for a in range(3):
                om[i, a] = gr[g, a, 0] * x0 + gr[g, a, 1] * x1 + gr[g, a, 2] * x2 + centers[g, a] + gd[g, a]
                os[i, a] = np.exp(log_scales[i, a])
                towards = gr[g, 0, a] * light[0] + gr[g, 1, a] * light[1] + gr[g, 2, a] * light[2]
                turn += (towards - light[a]) * shading[i, a]
            oo[i] = np.float32(1.0) / (np.float32(1.0) + np.exp(-logits[i]))
            aw, ax, ay, az = gq[g, 0], gq[g, 1], gq[g, 2], gq[g, 3]
            bw, bx, by, bz = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
            oq[i, 0] = aw * bw - ax * bx - ay * by - az * bz
            oq[i, 1] = aw * bx + ax * bw + ay * bz - az * by
            oq[i, 2] = aw * by - ax * bz + ay * bw + az * bx
            oq[i, 3] = aw * bz + ax * by - ay * bx + az * bw
            turn = max(turn, np.float32(0.0))
            for a in range(3):
                oc[i, a] = max(colors[i, a], np.float32(0.0)) * turn


@kernels.kernel
def _backward(
    worker, workers, means, quats, log_scales, logits, colors, shading, light, gq, gr, gd, ids, centers,
    scales, opacities, dm, dq, ds, do, dc, rm, rq, rs, ro, rc, rg, group_grads, light_grad,
):  # fmt: skip
    n = len(ids)
    for chunk in range(worker, CHUNKS, workers):
        for i in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            g = ids[i]
            acc = group_grads[chunk, g]
            turn = np.float32(1.0)
            for a in range(3):
                towards = gr[g, 0, a] * light[0] + gr[g, 1, a] * light[1] + gr[g, 2, a] * light[2]
                turn += (towards - light[a]) * shading[i, a]
            lit = turn > 0
            dturn = np.float32(0.0)
            for a in range(3):
                positive = colors[i, a] > 0
                rc[i, a] = dc[i, a] * turn if (positive and lit) else np.float32(0.0)
                if positive and lit:
                    dturn += dc[i, a] * colors[i, a]
            for a in range(3):
                rm[i, a] = gr[g, 0, a] * dm[i, 0] + gr[g, 1, a] * dm[i, 1] + gr[g, 2, a] * dm[i, 2]
                rs[i, a] = ds[i, a] * scales[i, a]
                towards = gr[g, 0, a] * light[0] + gr[g, 1, a] * light[1] + gr[g, 2, a] * light[2]
                rg[i, a] = dturn * (towards - light[a])
                turned = gr[g, a, 0] * shading[i, 0] + gr[g, a, 1] * shading[i, 1] + gr[g, a, 2] * shading[i, 2]
                light_grad[chunk, a] += dturn * (turned - shading[i, a])
                for b in range(3):
                    acc[3 * a + b] += dm[i, a] * (means[i, b] - centers[g, b]) + dturn * light[a] * shading[i, b]
                acc[9 + a] += dm[i, a]
            ro[i] = do[i] * opacities[i] * (np.float32(1.0) - opacities[i])
            # quat' = q_g * quat is linear in both factors; a product's transpose is the product with the conjugate.
            uw, ux, uy, uz = dq[i, 0], dq[i, 1], dq[i, 2], dq[i, 3]
            aw, ax, ay, az = gq[g, 0], -gq[g, 1], -gq[g, 2], -gq[g, 3]
            rq[i, 0] = aw * uw - ax * ux - ay * uy - az * uz
            rq[i, 1] = aw * ux + ax * uw + ay * uz - az * uy
            rq[i, 2] = aw * uy - ax * uz + ay * uw + az * ux
            rq[i, 3] = aw * uz + ax * uy - ay * ux + az * uw
            bw, bx, by, bz = quats[i, 0], -quats[i, 1], -quats[i, 2], -quats[i, 3]
            acc[12] += uw * bw - ux * bx - uy * by - uz * bz
            acc[13] += uw * bx + ux * bw + uy * bz - uz * by
            acc[14] += uw * by - ux * bz + uy * bw + uz * bx
            acc[15] += uw * bz + ux * by - uy * bx + uz * bw
