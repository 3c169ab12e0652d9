"""Sections of the run itself: data, start, learning rates, losses, order of the images."""

from __future__ import annotations

from dataclasses import dataclass

REPRESENTATIONS = ("tracks", "field")
BACKGROUNDS = ("auto", "learned", "white", "black")
PLACEMENTS = ("scene", "random")
RIGID_FORMS = ("absolute", "squared")
CURRICULA = ("best", "first")
DEVICES = r"auto|cpu|cuda(:\d{1,3})?"  # regular expression


@dataclass(frozen=True)
class TrainSection:
    """Representation, length and reporting of the run.

    Attributes:
        iterations: Optimisation steps.
        batch: Views of a step, which moves along the mean of their gradients. A step takes as many times longer. It
            counts the views of all processes of a run.
        seed: Seed of all random draws.
        representation: Motion representation: ``tracks`` (one SE(3) track per object) or ``field`` (deformation field
            and TRD, as in the paper).
        background: Colour behind the scene: ``learned`` (a sky), ``white`` or ``black``. ``auto`` is white if the
            images have alpha, else learned.
        sh_degree: Degree of the spherical harmonics of view-dependent colour, 0 to 3.
        sh_every: Steps between raising the trained degree by one, up to ``sh_degree`` (1000 in 3DGS). 0 trains all
            degrees from the start.
        device: Device of the run: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``: a CUDA device if gsplat can use one,
            otherwise the CPU.
        graphs: On a GPU, launch the steps of tracks and fields as CUDA graphs, if the configuration permits.
        threads: CPU threads of torch. More threads do not make training faster, because the tensors are small.
        checkpoint_every: Steps between checkpoints.
        log_every: Steps between lines of the log.
        probe_every: Steps between measurements of the PSNR on held-out views (split ``val``). 0 turns them off.
        probe_views: Maximum number of held-out views to measure.
        shading: Learn the change of an object's colours as it turns in fixed light.
        shadows: Learn shadow Gaussians, which follow their objects on the supporting plane.
        repair: Register rotations of the tracks again that have slipped into a neighbouring minimum, and align those of
            balls by their texture.
    """

    iterations: int = 6000
    batch: int = 1
    seed: int = 0
    representation: str = "tracks"
    background: str = "auto"
    sh_degree: int = 0
    sh_every: int = 0
    device: str = "auto"
    graphs: bool = True
    threads: int = 1
    checkpoint_every: int = 500
    log_every: int = 50
    probe_every: int = 500
    probe_views: int = 5
    shading: bool = True
    shadows: bool = True
    repair: bool = True


@dataclass(frozen=True)
class DataSection:
    """Reading of the data set.

    Attributes:
        masks: Folder with the masks of the training views, inside the data set or elsewhere. ``none`` ignores masks.
        min_registered: Minimum share of the images that a COLMAP reconstruction must have registered.
        memory: Maximum memory for the pixels of the training images and masks, GB. If they need more, they are read
            again while training. At most half of the available memory is used. It does not affect results.
    """

    masks: str = "object_mask"
    min_registered: float = 0.5
    memory: float = 2.0


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
        shading: Length of the shading vectors of objects with tracks until all times take part; they point outwards, as
            on a lit ball.
        min_mask_pixels: Minimum size of a mask that is used to locate an object, as a share of the image's pixels.
        unexplained: Share of the pixels that move although no mask names them, above which they are left out.
    """

    placement: str = "scene"
    object_points: int = 500
    background_points: int = 5000
    shadow_points: int = 60
    sweep_depths: int = 96
    opacity: float = 0.25
    shading: float = 0.3
    min_mask_pixels: float = 5e-4
    unexplained: float = 0.03


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
        shading: Shading vectors, which change colours as objects turn.
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
        decay_floor_appearance: Minimum factor to which the decay lowers the rates of the appearance.
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
class LossSection:
    """Weights of the losses.

    Attributes:
        ssim: Share of 1 - SSIM in the photometric loss; the rest is L1.
        roughness: Weight of the mean squared second difference of the tracks.
        rigid: Weight of the rigidity loss, the change of each Gaussian's distance to the representative of its object
            (variant ``r5dgs_extra`` only).
        rigid_form: ``absolute`` (mean absolute change) or ``squared`` (mean squared change, Eq. 8 of the paper).
        rigid_start: Share of the run after which the rigidity loss is active.
    """

    ssim: float = 0.2
    roughness: float = 0.02
    rigid: float = 0.5
    rigid_form: str = "absolute"
    rigid_start: float = 0.25


@dataclass(frozen=True)
class RefineSection:
    """Refinement of the cameras (`train/refinement`).

    Attributes:
        pixels: Minimum size of the corrections of poses, and of focal lengths at the border of the image, rms over the
            cameras.
        intervals: Minimum size of the offsets of clocks, intervals between the observed times.
        colors: Minimum size of the corrections of colours, as a share of white.
    """

    pixels: float = 0.2
    intervals: float = 0.05
    colors: float = 0.01


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
