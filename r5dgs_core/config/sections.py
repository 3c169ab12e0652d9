"""The sections of a run's configuration: what each key means and its default.

Lengths are relative: training runs in normalised coordinates in which the cameras stand about four units from what they
look at (`normalization.py`), and iterations are for ``train.iterations`` = 6000 unless said.
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
    """What is trained and for how long.

    Attributes:
        iterations: Optimisation steps; one view each.
        seed: Seed of all random draws.
        representation: ``tracks`` (one SE(3) track per object) or ``field`` (deformation field and TRD, the paper's).
        background: ``learned`` sky, ``white`` or ``black``; ``auto`` is white where images carry alpha, else learned.
        sh_degree: Degree of the view-dependent colour, 0 to 3.
        sh_every: Steps after which one more degree of it is trained (1000 in 3DGS); 0 trains all from the start.
        threads: Threads of torch; the small arrays of this trainer gain nothing from more than one.
        checkpoint_every: Steps between checkpoints.
        log_every: Steps between log lines.
        probe_every: Steps between looks at held-out views (split ``val``); 0 never looks.
        probe_views: Held-out views that are looked at.
        shading: Learn how colours change as objects turn in fixed light.
        shadows: Learn shadow Gaussians that follow their caster on the plane that supports the objects.
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
    """What is read of the data set.

    Attributes:
        masks: Folder of the training views' masks, within the data set or anywhere; ``none`` passes them over.
        min_registered: Smallest share of the images that a COLMAP reconstruction must have registered.
    """

    masks: str = "object_mask"
    min_registered: float = 0.5


@dataclass(frozen=True)
class InitSection:
    """How Gaussians are placed before training.

    Attributes:
        placement: ``scene``: objects in the hulls of their masks, background by a plane sweep; ``random``: everything
            at random where cameras look, as the paper's data comes.
        object_points: Gaussians of each object.
        background_points: Gaussians of the background.
        shadow_points: Gaussians of each shadow.
        sweep_depths: Depths tried per ray when the background is placed.
        opacity: Initial opacity of bodies and background.
        min_mask_pixels: Smaller masks do not vote on an object's place, as a share of the image.
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
        means: Centres.
        log_scales: Logarithms of the standard deviations.
        sh: Constant colour, as harmonics.
        sh_rest: Colour that depends on the view.
        opacity_logits: Opacities before the sigmoid.
        quats: Orientations.
        shading: How colours change as objects turn.
        light: Direction of the light that they turn in.
        translations: Displacements of the tracks.
        rotvecs: Rotations of the tracks, rad.
        slope: How shadows follow their casters.
        field: Weights of the deformation field.
        trd: Weights of the TRD network.
        residual: Residual motion of bodies that bend or breathe.
        background: Harmonics of the sky.
        decay: Factor by which rates have fallen at the end of the run.
        decay_networks: The same for the networks of ``field``.
        decay_floor_appearance: Appearance falls no lower than this factor.
        decay_from: Share of the run before the rates begin to fall.
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
    """The representation ``field``: a deformation field for the observed time, the TRD for what follows.

    Attributes:
        variant: ``5dgs`` (every Gaussian by its own dynamics), ``r5dgs`` (the same training, played rigidly) or
            ``r5dgs_extra`` (trained with the rigidity and majority losses too).
        size: Networks: ``complex`` (8 x 256 and 10 x 256, the paper's), ``light`` (6 x 128 and 8 x 128) or ``small``
            (4 x 128 and 5 x 64, for processors).
        horizon: Scene time up to which the deformation field reaches; later observed frames supervise the
            extrapolation. 0 leaves out the last fifteenth of the observed span, as 0.70 of 0.75.
        step: Time that the TRD bridges in a training step: plain where times lie in [0, 1], else as a share of the
            observed span; 0 takes two observed intervals.
        warm_up: Steps without deformation, so that the first time is the canonical state.
        trd_share: Share of the steps within the horizon that go through the TRD; 1 is TRACE's scheme.
        movers: Gaussians that the networks move: ``all``; ``labelled``: those that the masks put on an object or in its
            shadow; or ``measured``: all until those that rest are set still exactly. ``labelled`` is ``measured`` where
            there are no masks.
        gate: Share of the field's run after which ``measured`` looks for what rests; not before every time takes part.
        still: What leaves its place by less over the observed times rests; normalised units.
        calm: Weight of the mean distance from the canonical state until then, so that what no image moves rests.
        place_steps: Steps that fit the field to the triangulated places of the objects before the first image.
        tracks_share: Share of the run that is one of ``tracks``, from which the field then starts; 0 for none.
        distill_steps: Steps that fit field and TRD to the motion of those tracks.
        trd_steps: Steps that fit the TRD to the motion of the field, without images, at every ``trd_every``.
        trd_every: Steps between two such fits, as a share of the run; 0 for none.
        twist: Weight of the cross-Gaussian twist loss in these fits: one twist must carry its neighbours too.
        stiffness: Weight of the squared distance of moved Gaussians from the best rigid motion of their group.
        chunk: Gaussians that pass the networks at once; bounds memory.
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
        rigid: Weight of the change of distance to the representative of the object (variant ``r5dgs_extra``).
        rigid_start: Share of the run after which it counts.
    """

    ssim: float = 0.2
    roughness: float = 0.02
    rigid: float = 0.5
    rigid_start: float = 0.25


@dataclass(frozen=True)
class CurriculumSection:
    """When observed times enter training, as steps.

    Attributes:
        start: Time that training begins with: ``best``, at which most objects are well seen, or ``first``.
        first: Steps on that time alone.
        grow: Steps over which the other times enter, from there outwards.
        stages: Steps in which they enter; 0 for one knot after the other.
        newest: Share of draws on the newest times while they enter.
    """

    start: str = "best"
    first: int = 200
    grow: int = 400
    stages: int = 0
    newest: float = 0.4

    def steps(self, iterations: int) -> tuple[int, int]:
        """Steps on the first time alone, and step at which all times have entered, in a run of some length."""
        scale = min(1.0, iterations / 2000)
        return int(self.first * scale), int((self.first + self.grow) * scale)


@dataclass(frozen=True)
class DensifySection:
    """When Gaussians are split, cloned and removed; but for cap and strategy, the thresholds of ``share``.

    Attributes:
        strategy: ``share`` (the largest gradients grow, a share of all in a round), ``default`` (that of 3DGS) or
            ``mcmc`` (3DGS as Markov Chain Monte Carlo).
        start: First step.
        stop: Last step, as a share of the run.
        every: Steps between two rounds.
        gradient: Mean screen gradient above which a Gaussian grows, per half image width (the measure of 3DGS).
        share: Largest share of Gaussians that grow in a round.
        split_pixels: Larger ones (standard deviation in pixels) are split, smaller ones cloned.
        max_gaussians: Cap; 0 chooses it from the image size (3/4 of an image's pixels, at most 60000).
        prune_opacity: Fainter ones are removed.
        prune_width: Wider ones are removed; standard deviation as a share of the image width.
        prune_near: Background that is nearer to a camera and that no second camera sees is removed; normalised units
            (the cameras' focus is at about 4); 0 keeps it.
        opacity: Weight of the mean opacity in the loss, so that what no image needs fades; 0 for none.
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
    """Thresholds of the strategy ``default``, those of 3DGS; its runs begin with ``init.opacity`` 0.1.

    Attributes:
        start: Step after which Gaussians grow.
        stop: Share of the run after which they do not (15000 of 30000 steps).
        every: Steps between two rounds.
        gradient: Mean screen gradient from which on a Gaussian grows, per half image width.
        percent_dense: Larger ones (standard deviation as a share of the cameras' extent) are split, others cloned.
        prune_opacity: Fainter ones are removed.
        prune_radius: Ones with a larger radius in some view, px, are removed after the first reset.
        prune_extent: So are those with a larger standard deviation, as a share of the cameras' extent.
        reset_every: Steps between two resets of the opacities, while Gaussians grow; 0 for none.
        reset_opacity: No opacity is larger after a reset.
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
    """Thresholds of the strategy ``mcmc``, those of its paper.

    Attributes:
        start: Step after which Gaussians are moved and added.
        stop: Share of the run after which they are not (25000 of 30000 steps).
        every: Steps between two rounds.
        grow: Share that is added in a round, up to ``densify.max_gaussians``.
        dead_opacity: Fainter ones are moved onto live ones.
        noise: Noise on the centres, per variance and learning rate of the centres; 0 for none.
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
    """What moves where there are no masks (`discovery.py`): a short run of a field, and its rigidly moving parts.

    Attributes:
        iterations: Steps of that run; 0 trains data without masks as one static scene.
        gate: Share of it after which what rests is set still.
        still: What leaves its place by less rests; normalised units.
        fewest: Parts of fewer Gaussians are left to the background.
    """

    iterations: int = 1200
    gate: float = 0.5
    still: float = 0.03
    fewest: int = 20


@dataclass(frozen=True)
class ResidualSection:
    """Residual motion of bodies that bend or breathe (`residual.py`).

    Attributes:
        start: Share of the run after which all bodies are tried; not before every time takes part.
        trial_steps: Steps of the trial, in runs of 2000 steps or more.
        threshold: Bodies on which the error grows by more without them keep their residuals, dB.
        nodes: Places on a body that carry its residuals.
        size: Weight of the mean squared residual, per length of the body.
        roughness: Weight of its mean squared second difference over the knots.
    """

    start: float = 0.4
    trial_steps: int = 300
    threshold: float = 0.4
    nodes: int = 40
    size: float = 1e-3
    roughness: float = 0.01


@dataclass(frozen=True)
class IdentitySection:
    """Identity encodings (Gaussian Grouping).

    Attributes:
        training: ``after`` the run on frozen geometry, ``joint`` with it from the first step (the paper), ``detached``
            with it, without gradient to the geometry; ``off`` leaves encodings and classifier out.
        iterations: Steps of ``after``; 0 is ``off``.
        rate: Learning rate of the encodings.
        classifier_rate: Learning rate of the classifier.
        weight: Weight of the pixel cross-entropy (divided by ln C) beside the photometric loss.
        every: Steps between two pixel losses of ``detached``.
        spatial: Weight of the divergence between neighbours' classes (L_3d); 0 for none.
        majority: Weight of the distance from the neighbours' mean class (L_major); 0 for none.
        regularise_every: Steps between two evaluations of these two (tau_reg).
        neighbours: Neighbours that are compared.
        include_self: Whether L_3d counts a Gaussian among its own neighbours, as Gaussian Grouping does; "auto" does
            in a ``field``.
        samples: Gaussians that are compared with theirs each time.
        hygiene: Whether labels that the masks leave undecided follow neighbours and motion (`label_hygiene.py`).
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
    """Your word on what a scene needs, by the names of the table of `needs.decide`: "auto" measures, "on", "off".

    Attributes:
        tracks: Motion of the objects.
        rotation: Rotation of the objects; without it they only slide.
        shading: Colours that change as objects turn.
        shadows: Shadow Gaussians.
        view_dependent_colour: Harmonics of the colour, to ``train.sh_degree`` (at least 1 where this is on).
        sky_gradient: Harmonics of the sky; without them it has one colour.
        classifier: Identity encodings and their classifier.
        residuals: Motion of objects that bend or breathe.
        regrouping: Gaussians of a field that go with the group that explains their motion, not that of their object.
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
