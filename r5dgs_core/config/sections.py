"""Sections of the configuration; the docstring of each describes its keys.

Lengths are in the normalised coordinates of training, in which the cameras are about 4 units from the point that they
look at (`train/normalization.py`). Numbers of steps are meant for runs of ``train.iterations`` = 6000, unless stated
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

REPRESENTATIONS = ("tracks", "field")
VARIANTS = ("5dgs", "r5dgs", "r5dgs_extra")
FIELD_SIZES = ("complex", "light", "small")
MOVERS = ("all", "labelled", "measured")
CURRICULA = ("best", "first")
PLACEMENTS = ("scene", "random")
IDENTITY_TRAINING = ("after", "joint", "detached", "off")
BACKGROUNDS = ("auto", "learned", "white", "black")
STRATEGIES = ("share", "default", "mcmc")
NEEDS = ("auto", "on", "off")
INCLUDE_SELF = ("auto", "on", "off")


@dataclass(frozen=True)
class TrainSection:
    """Representation, length and reporting of the run.

    Attributes:
        iterations: Optimisation steps, one view each.
        seed: Seed of all random draws.
        representation: Motion representation: ``tracks`` (one SE(3) track per object) or ``field`` (deformation field
            and TRD, as in the paper).
        background: Colour behind the scene: ``learned`` (a sky), ``white`` or ``black``. ``auto`` is white if the
            images have alpha, else learned.
        sh_degree: Degree of the spherical harmonics of view-dependent colour, 0 to 3.
        sh_every: Steps between raising the trained degree by one, up to ``sh_degree`` (1000 in 3DGS). 0 trains all
            degrees from the start.
        threads: CPU threads of torch. More than one does not make training faster, as its arrays are small.
        checkpoint_every: Steps between checkpoints.
        log_every: Steps between lines of the log.
        probe_every: Steps between measurements of the PSNR on held-out views (split ``val``). 0 turns them off.
        probe_views: Largest number of held-out views to measure.
        shading: Learn how the colours of an object change as it turns in fixed light.
        shadows: Learn shadow Gaussians, which follow their objects on the supporting plane.
    """

    iterations: int = 6000
    seed: int = 0
    representation: str = "tracks"
    background: str = "auto"
    sh_degree: int = 0
    sh_every: int = 0
    threads: int = 1
    checkpoint_every: int = 500
    log_every: int = 50
    probe_every: int = 500
    probe_views: int = 5
    shading: bool = True
    shadows: bool = True


@dataclass(frozen=True)
class DataSection:
    """Reading of the data set.

    Attributes:
        masks: Folder with the masks of the training views, inside the data set or elsewhere. ``none`` ignores masks.
        min_registered: Smallest share of the images that a COLMAP reconstruction must have registered.
    """

    masks: str = "object_mask"
    min_registered: float = 0.5


@dataclass(frozen=True)
class InitSection:
    """Initial placement of Gaussians.

    Attributes:
        placement: ``scene`` places objects in the visual hulls of their masks and the background by a plane sweep.
            ``random`` spreads all Gaussians at random over the space that the cameras see, as in the paper's data.
        object_points: Gaussians per object.
        background_points: Gaussians of the background.
        shadow_points: Gaussians per shadow.
        sweep_depths: Depths per ray that the plane sweep compares.
        opacity: Initial opacity of objects and background.
        min_mask_pixels: Size of the smallest mask that helps to locate an object, as a share of the image's pixels.
    """

    placement: str = "scene"
    object_points: int = 500
    background_points: int = 5000
    shadow_points: int = 60
    sweep_depths: int = 96
    opacity: float = 0.25
    min_mask_pixels: float = 5e-4


@dataclass(frozen=True)
class RatesSection:
    """Learning rates of Adam, in normalised units per step.

    Attributes:
        means: Centres of the Gaussians.
        log_scales: Sizes, as logarithms of the standard deviations.
        sh: Constant colour (harmonics of degree 0).
        sh_rest: View-dependent colour (harmonics of degree 1 and higher).
        opacity_logits: Opacities, before the sigmoid.
        quats: Orientations.
        shading: Shading vectors, by which colours change as objects turn.
        light: Direction of the light that the shading assumes.
        translations: Translations of the object tracks.
        rotvecs: Rotations of the object tracks, rad.
        slope: Shift of a shadow along the plane per unit that its object rises.
        field: Weights of the deformation field.
        trd: Weights of the TRD network.
        residual: Residual motion of non-rigid objects.
        background: Harmonics of the sky.
        decay: Final learning rate as a factor of the initial one; the decay is exponential. It applies to the geometry
            (centres, tracks, light, residuals) and the appearance (sizes, colours, opacities, sky).
        decay_networks: The same factor for the two networks of ``field``.
        decay_floor_appearance: Smallest factor to which the decay lowers the rates of the appearance.
        decay_from: Share of the run at which the decay begins (for ``residual``: ``residual.start``).
    """

    means: float = 1e-3
    log_scales: float = 1e-2
    sh: float = 5e-3
    sh_rest: float = 2.5e-4
    opacity_logits: float = 0.05
    quats: float = 2e-3
    shading: float = 1e-2
    light: float = 1e-2
    translations: float = 3e-3
    rotvecs: float = 6e-3
    slope: float = 1e-2
    field: float = 8e-4
    trd: float = 8e-4
    residual: float = 6e-3
    background: float = 2e-3
    decay: float = 0.02
    decay_networks: float = 0.02
    decay_floor_appearance: float = 0.1
    decay_from: float = 0.1


@dataclass(frozen=True)
class FieldSection:
    """Representation ``field``: a deformation field for the observed time, and the TRD for extrapolation.

    Attributes:
        variant: ``5dgs`` extrapolates each Gaussian by its own dynamics, ``r5dgs`` trains in the same way but
            extrapolates objects rigidly, ``r5dgs_extra`` also trains with the rigidity and majority losses.
        size: Depth and width of field and TRD: ``complex`` (8 x 256 and 10 x 256, as in the paper), ``light`` (6 x 128
            and 8 x 128) or ``small`` (4 x 128 and 5 x 64, for CPUs).
        horizon: Last scene time of the deformation field; later observed frames train the extrapolation. 0 leaves out
            the last fifteenth of the observed span (0.70 of 0.75 in NVFi).
        step: Time that the TRD bridges in a training step: a scene time if all times lie in [0, 1], else a share of the
            observed span. 0 uses two observed intervals.
        warm_up: Steps without deformation at the start of the run, which make the first time the canonical state.
        trd_share: Share of the steps up to the horizon that train field and TRD together; the others train the field
            alone. 1 is TRACE's scheme.
        movers: Gaussians that the networks move: ``all``; ``labelled`` (those that masks assign to an object or its
            shadow); or ``measured`` (all at first, and after ``gate`` only those that were found to move). Without
            masks, ``labelled`` means ``measured``.
        gate: Share of the field's run after which ``measured`` freezes Gaussians at rest, but not before all times take
            part.
        still: Displacement over the observed times below which a Gaussian is at rest, normalised units.
        calm: Weight of the mean distance from the canonical state, which brings Gaussians to rest that no image moves.
            Used with ``measured``, until ``gate``.
        place_steps: Steps that fit the field to the triangulated positions of the objects, before the first image.
        tracks_share: Share of the run that trains ``tracks`` first; the field then starts from them. 0 starts with the
            field.
        distill_steps: Steps that fit field and TRD to the motion of these tracks.
        trd_steps: Steps of each fit of the TRD to the motion of the field, without images. 0 turns these fits off.
        trd_every: Interval between these fits, as a share of the run. 0 fits only at the start.
        twist: Weight of the cross-Gaussian twist loss in these fits, by which the twist of each Gaussian must also move
            another Gaussian of its group.
        stiffness: Weight of the mean squared distance of moved Gaussians from the best rigid motion of their group.
        chunk: Gaussians per forward pass of the networks; bounds memory.
    """

    variant: str = "r5dgs"
    size: str = "small"
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
class LossSection:
    """Weights of the losses.

    Attributes:
        ssim: Share of 1 - SSIM in the photometric loss; the rest is L1.
        roughness: Weight of the mean squared second difference of the tracks.
        rigid: Weight of the rigidity loss, the change of each Gaussian's distance to the representative of its object
            (variant ``r5dgs_extra`` only).
        rigid_start: Share of the run after which the rigidity loss is active.
    """

    ssim: float = 0.2
    roughness: float = 0.02
    rigid: float = 0.5
    rigid_start: float = 0.25


@dataclass(frozen=True)
class CurriculumSection:
    """Order in which observed times enter training; runs of fewer than 2000 steps shorten the schedule in proportion.

    Attributes:
        start: First time to train: ``best`` (the time at which most objects are well visible) or ``first``.
        first: Steps that train the first time alone.
        grow: Steps during which the other times enter, from the first one outwards.
        stages: Number of stages in which they enter. 0 adds one time after another.
        newest: Share of the steps that draw a view of the newest times while times enter.
    """

    start: str = "best"
    first: int = 200
    grow: int = 400
    stages: int = 0
    newest: float = 0.4

    def steps(self, iterations: int) -> tuple[int, int]:
        """Return the number of steps on the first time alone, and the step at which all times have entered.

        Args:
            iterations: Length of the run, steps.
        """
        scale = min(1.0, iterations / 2000)
        return int(self.first * scale), int((self.first + self.grow) * scale)


@dataclass(frozen=True)
class DensifySection:
    """Schedule and limits of densification; all keys but ``strategy`` and ``max_gaussians`` apply to ``share`` alone.

    Attributes:
        strategy: ``share`` (in each round, the Gaussians with the largest gradients grow, up to a share of all),
            ``default`` (adaptive density control of 3DGS) or ``mcmc`` (3DGS as Markov Chain Monte Carlo).
        start: First step of densification.
        stop: Last step of densification, as a share of the run.
        every: Steps between two rounds.
        gradient: Mean screen-space gradient above which a Gaussian grows, per half image width (as in 3DGS).
        share: Largest share of the Gaussians that grow in a round.
        split_pixels: Standard deviation in pixels above which a growing Gaussian is split; smaller ones are cloned.
        max_gaussians: Largest number of Gaussians. 0 chooses it from the image size (3/4 of an image's pixels, at most
            60000).
        prune_opacity: Opacity below which a Gaussian is removed.
        prune_width: Standard deviation, as a share of the image width, above which a Gaussian is removed.
        prune_near: Distance from a camera below which background Gaussians in the view of fewer than two cameras are
            removed, normalised units (the cameras' focus is at about 4). 0 keeps them.
        opacity: Weight of the mean opacity in the loss, by which Gaussians fade that no image needs. 0 turns it off.
    """

    strategy: str = "share"
    start: int = 200
    stop: float = 0.5
    every: int = 100
    gradient: float = 2e-4
    share: float = 0.2
    split_pixels: float = 1.0
    max_gaussians: int = 0
    prune_opacity: float = 0.01
    prune_width: float = 0.16
    prune_near: float = 1.0
    opacity: float = 0.003


@dataclass(frozen=True)
class DensifyDefaultSection:
    """Strategy ``default``, with the thresholds of 3DGS, which starts from ``init.opacity`` = 0.1.

    Attributes:
        start: Step after which Gaussians grow.
        stop: Share of the run after which they no longer grow (15000 of 30000 steps).
        every: Steps between two rounds.
        gradient: Mean screen-space gradient from which on a Gaussian grows, per half image width.
        percent_dense: Standard deviation, as a share of the cameras' extent, above which a growing Gaussian is split;
            smaller ones are cloned.
        prune_opacity: Opacity below which a Gaussian is removed.
        prune_radius: Radius in a view, px, above which a Gaussian is removed, after the first reset of the opacities.
        prune_extent: Standard deviation, as a share of the cameras' extent, above which a Gaussian is removed, after
            the first reset of the opacities.
        reset_every: Steps between two resets of the opacities while Gaussians grow. 0 turns resets off.
        reset_opacity: Largest opacity after a reset.
    """

    start: int = 500
    stop: float = 0.5
    every: int = 100
    gradient: float = 2e-4
    percent_dense: float = 0.01
    prune_opacity: float = 0.005
    prune_radius: float = 20.0
    prune_extent: float = 0.1
    reset_every: int = 3000
    reset_opacity: float = 0.01


@dataclass(frozen=True)
class DensifyMcmcSection:
    """Strategy ``mcmc``, with the thresholds of its paper.

    Attributes:
        start: Step after which Gaussians are relocated and added.
        stop: Share of the run after which they no longer are (25000 of 30000 steps).
        every: Steps between two rounds.
        grow: Share of the Gaussians that a round adds, up to ``densify.max_gaussians``.
        dead_opacity: Opacity below which a Gaussian is dead; dead Gaussians are relocated onto live ones.
        noise: Scale of the noise on the centres, per variance and learning rate of the centres. 0 turns it off.
        opacity: Weight of the mean opacity in the loss.
        scale: Weight of the mean standard deviation in the loss.
    """

    start: int = 500
    stop: float = 25 / 30
    every: int = 100
    grow: float = 0.05
    dead_opacity: float = 0.005
    noise: float = 5e5
    opacity: float = 0.01
    scale: float = 0.01


@dataclass(frozen=True)
class DiscoverySection:
    """Discovery of moving objects in data without masks (`train/object_discovery.py`).

    A short run of ``field`` is trained, and its rigidly moving parts become the objects.

    Attributes:
        iterations: Steps of the short run. 0 trains data without masks as one static scene.
        gate: Share of the short run after which Gaussians at rest are frozen.
        still: Displacement over the observed times below which a Gaussian is at rest, normalised units.
        fewest: Smallest number of Gaussians of an object; smaller parts join the background.
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


@dataclass(frozen=True)
class NeedsSection:
    """User's overrides of the decisions in the needs table (`bake/needs.py`).

    "auto" decides from measurements, "on" keeps the feature, "off" leaves it out.

    Attributes:
        tracks: Motion of the objects.
        rotation: Rotation of the objects; without it, they only translate.
        shading: Colours that change as objects turn.
        shadows: Shadow Gaussians.
        view_dependent_colour: Harmonics of the colour up to ``train.sh_degree`` ("on" raises it to at least 1).
        sky_gradient: Harmonics of the sky; without them, the sky has one colour.
        classifier: Identity encodings and their classifier.
        residuals: Residual motion of non-rigid objects.
        regrouping: Assignment of a field's Gaussians to the group that explains their motion best, instead of the group
            of their object.
    """

    tracks: str = "auto"
    rotation: str = "auto"
    shading: str = "auto"
    shadows: str = "auto"
    view_dependent_colour: str = "auto"
    sky_gradient: str = "auto"
    classifier: str = "auto"
    residuals: str = "auto"
    regrouping: str = "auto"
