"""Sections of the motion: deformation field, discovery of moving objects, residual motion."""

from __future__ import annotations

from dataclasses import dataclass

VARIANTS = ("5dgs", "r5dgs", "r5dgs_extra")
FIELD_SIZES = ("complex", "light", "small")
MOVERS = ("all", "labelled", "measured")


@dataclass(frozen=True)
class FieldSection:
    """Representation ``field``: a deformation field for the observed time, and the TRD for extrapolation.

    Attributes:
        variant: ``5dgs`` extrapolates each Gaussian by its own dynamics, ``r5dgs`` trains in the same way but
            extrapolates objects rigidly, ``r5dgs_extra`` also trains with the rigidity and majority losses.
        size: Depth and width of field and TRD: ``complex`` (8 x 256 and 10 x 256, as in the paper), ``light`` (6 x 128
            and 8 x 128) or ``small`` (4 x 128 and 5 x 64, for CPUs).
        width: Width of the hidden layers of both networks, at the depth of ``size``. 0 takes that of ``size``.
        horizon: Last scene time of the deformation field; later observed frames train the extrapolation. 0 leaves out
            the last fifteenth of the observed span (0.70 of 0.75 in NVFi).
        step: Time step of the TRD in training: a scene time if all times lie in [0, 1], else a share of the observed
            span. 0 uses two observed intervals.
        warm_up: Steps without deformation at the start of the run, which make the first time the canonical state.
        trd_share: Share of the steps up to the horizon that train field and TRD together; the others train the field
            alone. 1 is TRACE's scheme.
        movers: Gaussians that the networks move: ``all``; ``labelled`` (those that masks assign to an object or its
            shadow); or ``measured`` (all at first, and after ``gate`` only those that were found to move). Without
            masks, ``labelled`` means ``measured``.
        gate: Share of the field's run after which ``measured`` freezes Gaussians at rest, but not before all times take
            part.
        still: Displacement over the observed times below which a Gaussian is at rest, normalised units.
        calm: Weight of the mean distance from the canonical state, which keeps Gaussians still if no image requires
            motion. Used with ``measured``, until ``gate``.
        place_steps: Steps that fit the field to the triangulated positions of the objects, before the first image.
        tracks_share: Share of the run that trains ``tracks`` first; the field then starts from them. 0 starts with the
            field.
        distill_steps: Steps that fit field and TRD to the motion of these tracks.
        trd_steps: Steps of each fit of the TRD to the motion of the field, without images. 0 turns these fits off.
        trd_every: Interval between these fits, as a share of the run. 0 fits only at the start.
        twist: Weight of the cross-Gaussian twist loss in these fits, which applies the twist of each Gaussian to
            another Gaussian of its group.
        stiffness: Weight of the mean squared distance of moved Gaussians from the best rigid motion of their group.
        chunk: Gaussians per forward pass of the networks; bounds memory.
    """

    variant: str = "r5dgs"
    size: str = "small"
    width: int = 0
    horizon: float = 0.0
    step: float = 0.0
    warm_up: int = 0
    trd_share: float = 0.5
    movers: str = "labelled"
    gate: float = 0.3
    still: float = 0.01
    calm: float = 0.01
    place_steps: int = 300
    tracks_share: float = 0.0
    distill_steps: int = 600
    trd_steps: int = 200
    trd_every: float = 0.2
    twist: float = 1.0
    stiffness: float = 1.0
    chunk: int = 65536


@dataclass(frozen=True)
class DiscoverySection:
    """Discovery of moving objects in data without masks (`train/object_discovery.py`).

    A short run of ``field`` is trained, and its rigidly moving parts become the objects.

    Attributes:
        iterations: Steps of the short run. 0 trains data without masks as one static scene.
        gate: Share of the short run after which Gaussians at rest are frozen.
        still: Displacement over the observed times below which a Gaussian is at rest, normalised units.
        fewest: Minimum number of Gaussians of an object; smaller parts join the background.
    """

    iterations: int = 1200
    gate: float = 0.5
    still: float = 0.03
    fewest: int = 20


@dataclass(frozen=True)
class ResidualSection:
    """Residual motion of non-rigid objects (`train/residual_trial.py`).

    Attributes:
        start: Share of the run after which all objects are tested for residual motion, but not before all times take
            part.
        trial_steps: Steps of the test; fewer in runs of fewer than 2000 steps.
        threshold: Gain in PSNR on an object, dB, above which it keeps its residual motion.
        nodes: Control points per object.
        size: Weight of the mean squared residual, relative to the object's size.
        roughness: Weight of the mean squared second difference of the residual over time.
    """

    start: float = 0.4
    trial_steps: int = 300
    threshold: float = 0.4
    nodes: int = 40
    size: float = 1e-3
    roughness: float = 0.01
