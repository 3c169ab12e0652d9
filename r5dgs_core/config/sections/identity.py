"""Section of the identity encodings."""

from __future__ import annotations

from dataclasses import dataclass

IDENTITY_TRAINING = ("after", "joint", "detached", "off")
INCLUDE_SELF = ("auto", "on", "off")


@dataclass(frozen=True)
class IdentitySection:
    """Identity encodings and their classifier (Gaussian Grouping).

    Attributes:
        training: ``after`` trains them after the run, on frozen geometry; ``joint`` from the first step together with
            the geometry (the paper); ``detached`` during the run, without gradients to the geometry; ``off`` leaves
            them out.
        iterations: Steps of ``after``. 0 has the effect of ``off``.
        rate: Learning rate of the encodings.
        classifier_rate: Learning rate of the classifier.
        weight: Weight of the pixel cross-entropy (divided by ln C for C classes) relative to the photometric loss.
        every: Steps between two evaluations of the pixel loss with ``detached``.
        spatial: Weight of the divergence between the classes of neighbouring Gaussians (L_3d). 0 turns it off.
        majority: Weight of the distance to the mean class of the neighbours (L_major). 0 turns it off.
        regularise_every: Steps between two evaluations of L_3d and L_major (tau_reg).
        neighbours: Neighbours per Gaussian in L_3d and L_major.
        include_self: Count a Gaussian as its own neighbour in L_3d, as Gaussian Grouping does: ``on``, ``off`` or
            ``auto`` (on with ``field``).
        samples: Gaussians per evaluation of L_3d and L_major.
        hygiene: Correct uncertain labels after the run by the neighbours and the motion of their Gaussians
            (`train/identity/label_cleanup.py`).
    """

    training: str = "after"
    iterations: int = 400
    rate: float = 1e-2
    classifier_rate: float = 5e-3
    weight: float = 1.0
    every: int = 4
    spatial: float = 0.0
    majority: float = 0.0
    regularise_every: int = 2
    neighbours: int = 5
    include_self: str = "auto"
    samples: int = 1000
    hygiene: bool = True
