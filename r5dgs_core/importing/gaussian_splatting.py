"""Reader of 3D Gaussian Splatting and Gaussian Grouping runs: static Gaussians, the latter with identities."""

from __future__ import annotations

from ..errors import CheckpointError
from ..formats import ply
from ..scene.scene import IDENTITY_DIM
from . import weights
from .foreign_run import SPLATTING_NEAR, ForeignRun
from .run_folder import RunFolder


def read(run: RunFolder) -> ForeignRun:
    """Read the Gaussians, and the classifier if there is one.

    Raises:
        CheckpointError: The classifier does not fit the identities.
    """
    splats = ply.read(run.ply)
    if "classifier.pth" not in run.files:
        return ForeignRun("3dgs", splats, SPLATTING_NEAR)
    loaded = weights.load(run.weights("classifier.pth"))
    if splats.identities is None or splats.identities.shape[1] != IDENTITY_DIM:
        found = "none" if splats.identities is None else str(splats.identities.shape[1])
        raise CheckpointError(
            f"{run.ply}: expected the columns obj_dc_0..{IDENTITY_DIM - 1} beside a classifier.pth, found {found}"
        )
    weight = loaded.tensor("weight", (None, IDENTITY_DIM, 1, 1))
    bias = loaded.tensor("bias", (weight.shape[0],))
    return ForeignRun(
        "gaussian_grouping", splats, SPLATTING_NEAR, classifier=(weight[:, :, 0, 0].numpy(), bias.numpy())
    )
