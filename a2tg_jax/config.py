"""Every number of a training run, one small dataclass per component, and the two presets."""

import dataclasses
from typing import Literal


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights of the photometric loss and of the optional terms (0 is off, the paper's setting)."""

    ssim_weight: float = 0.2
    """w in (1 - w)·L1 + w·(1 - SSIM)."""
    normal_weight: float = 0.0
    """Normal consistency of 2DGS: rendered normals against the normals of the rendered depth."""
    distortion_weight: float = 0.0
    """Depth distortion of 2DGS."""
    opacity_weight: float = 0.0
    """Mean opacity of the live Gaussians (3DGS-MCMC uses 0.01)."""
    scale_weight: float = 0.0
    """Mean scale of the live Gaussians (3DGS-MCMC uses 0.01)."""


@dataclasses.dataclass(frozen=True)
class LearningRates:
    """Adam's learning rate per field."""

    means: float = 1.6e-4
    """Times scene_scale; decays exponentially over each stage."""
    means_final_factor: float = 0.01
    """The means' rate at the end of a stage over that at its start."""
    log_scales: float = 5e-3
    quats: float = 1e-3
    logit_opacities: float = 5e-2
    sh_degree0: float = 2.5e-3
    sh_rest: float = 1.25e-4
    texels: float = 2.5e-3


@dataclasses.dataclass(frozen=True)
class DensifyConfig:
    """MCMC densification in stage 1."""

    cap: int = 500_000
    """Largest number of Gaussians."""
    is_enabled: bool = True
    """Relocate and grow in stage 1."""
    noise_in_stage2: bool = False
    """Keep the exploration noise on in stage 2."""


@dataclasses.dataclass(frozen=True)
class TextureConfig:
    """Adaptive anisotropic textures in stage 2."""

    is_enabled: bool = True
    """Off: stage 2 trains on without textures (the baseline of equal length)."""
    select: Literal["fraction", "threshold", "budget"] = "fraction"
    """How the Gaussians to upscale are chosen."""
    fraction: float = 0.25
    """Share of the Gaussians upscaled at each event."""
    threshold: float = 2e-5
    """Smallest average gradient that is upscaled (k_G)."""
    budget_mb: float | None = None
    """Reported memory never exceeds this many MB (10^6 bytes); needed by select="budget"."""
    anisotropic: bool = True
    """Double one axis only on thin Gaussians; off: always both."""
    k_a: float = 4.0
    """Aspect ratio above which a Gaussian counts as elongated."""
    k_s: float = 0.01
    """Shorter scale, in units of the normalised world, below which an elongated Gaussian counts as thin."""
    cap: int = 4
    """Largest texture side in texels (at most 16)."""
    upscale_at: tuple[float, ...] | None = None
    """Fractions of stage 2 at which textures grow; None: the paper's 1/60 and 1/30, under 30,000 iterations 0.15 and
    0.30."""
    official: bool = False
    """The authors' own texture conventions instead of the paper's (RenderSettings.official)."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """One training run: stage 1 (Gaussians) and stage 2 (textures)."""

    stage1_iterations: int = 30_000
    stage2_iterations: int = 30_000
    batch_size: int = 1
    """Views per iteration."""
    initial_gaussians: int | None = None
    """Gaussians to start from; None: all the points, at most the cap."""
    background: Literal["black", "white", "random"] = "black"
    sh_degree: int = 3
    seed: int = 0
    tile_size: int = 8
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    rates: LearningRates = dataclasses.field(default_factory=LearningRates)
    densify: DensifyConfig = dataclasses.field(default_factory=DensifyConfig)
    texture: TextureConfig = dataclasses.field(default_factory=TextureConfig)

    @staticmethod
    def paper() -> "TrainConfig":
        """The paper's numbers: 30,000 + 30,000 iterations, 500,000 Gaussians."""
        return TrainConfig()

    @staticmethod
    def quick() -> "TrainConfig":
        """Useful on two cores in minutes: 2,000 + 1,000 iterations, 10,000 Gaussians."""
        return TrainConfig(stage1_iterations=2_000, stage2_iterations=1_000, densify=DensifyConfig(cap=10_000))
