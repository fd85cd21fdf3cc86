"""The methods that A²TG is compared with.

2DGS* (plain 2D Gaussians under adaptive density control, with the gradient statistic of 2DGS), 2DGS*-MCMC (under MCMC
densification; a second stage without events allows comparisons at equal iterations), Textured Gaussians* (every texture
k×k from the start of the second stage, no events), SuperGaussians (four movable kernels vary colour and opacity over
each splat) and BBSplat (RGBA billboards from the first iteration, densified by MCMC on their mean alpha).
"""

import dataclasses
from typing import ClassVar, Self

from a2tg_jax.appearance import Appearance, Billboards, MovableKernels, Texture, TextureOptions
from a2tg_jax.appearance.movable_kernels import FLOATS_PER_KERNEL, NUM_KERNELS
from a2tg_jax.base.checks import check_fields
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.densify.clone_split import CloneSplitPrune, OpacityReset
from a2tg_jax.densify.pruning import Prune
from a2tg_jax.mcmc import FillingMcmc, Mcmc, densify_times
from a2tg_jax.systems.two_stages import (
    FLOATS_PER_TEXEL,
    NO_PRUNING,
    QUICK_CAP,
    QUICK_RATES,
    QUICK_TEXELS,
    SMOKE_CAP,
    TwoStages,
    grown_by_density,
    grown_by_mcmc,
    pruned,
)
from a2tg_jax.training.options import LossConfig
from a2tg_jax.training.stage import LearningRates, Stage


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gaussians2d(TwoStages):
    """Plain 2D Gaussians: clone, split, prune, opacity reset.

    2DGS (Huang et al., 2024), with the adaptive density control of 3DGS (Kerbl et al., 2023).
    """

    stage2_iterations: int = 0
    """Further iterations without densification; 0: none."""
    densify: CloneSplitPrune = CloneSplitPrune()
    """Adaptive density control (3DGS, 2DGS)."""
    opacity_reset: OpacityReset = OpacityReset()
    """Resets of the opacities."""
    prune: Prune = NO_PRUNING
    """Pruning of the Gaussians that show least; others grow in their place. Fractions up to 0.8 of the first stage;
    those after the last growth, at 0.5, are left out."""

    name: ClassVar[str] = "gaussians-2d"

    def stages(self) -> tuple[Stage, ...]:
        pruning = pruned(self.prune, self.stage1_iterations, self.densify.times(self.stage1_iterations))
        growth = grown_by_density(self.densify, self.budget_cap()), self.opacity_reset
        return self.continued(self.growing_stage((*growth, *pruning)))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        short = cls.short_presets(
            {"densify": CloneSplitPrune(cap=QUICK_CAP)}, {"densify": CloneSplitPrune(cap=SMOKE_CAP)}
        )
        return short | {"surfaces": cls(loss=LossConfig(normal_weight=0.2))}  # docs/meshes.md


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gaussians2dMcmc(TwoStages):
    """Plain 2D Gaussians, densified by MCMC.

    2DGS (Huang et al., 2024), with the densification of 3DGS-MCMC (Kheradmand et al., 2024).

    Examples:
      >>> system = a2tg.Gaussians2dMcmc.preset("smoke", sh_degree=0, densify={"cap": 500})
      >>> [stage.iterations for stage in system.stages()]
      [200]
    """

    stage2_iterations: int = 0
    """Further iterations without densification; 0: none."""
    densify: Mcmc = Mcmc()
    """MCMC densification (3DGS-MCMC)."""
    prune: Prune = NO_PRUNING
    """Pruning of the Gaussians that show least, up to 0.8 of the first stage; others grow in their place."""

    name: ClassVar[str] = "gaussians-2d-mcmc"

    def stages(self) -> tuple[Stage, ...]:
        growth = grown_by_mcmc(self.densify, self.budget_cap())
        pruning = pruned(self.prune, self.stage1_iterations, densify_times(self.stage1_iterations))
        return self.continued(self.growing_stage((*growth, *pruning)))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return cls.short_presets({"densify": Mcmc(cap=QUICK_CAP)}, {"densify": Mcmc(cap=SMOKE_CAP)})


@dataclasses.dataclass(frozen=True, kw_only=True)
class TexturedGaussians(TwoStages):
    """MCMC densification, then a second stage with textures of one size.

    Textured Gaussians, as A²TG compares with it.
    """

    densify: Mcmc = Mcmc()
    """MCMC densification (3DGS-MCMC)."""
    texture_side: int = 4
    """Side k of every texture of k×k texels, 1 to 16."""
    texel_rate: float = 2.5e-3
    """Adam's learning rate of the texels."""
    lookup: TextureOptions = TextureOptions()
    """Options of the texture lookup."""

    name: ClassVar[str] = "textured-gaussians"

    def stages(self) -> tuple[Stage, ...]:
        side = self.texture_side
        growth = grown_by_mcmc(self.densify, self.budget_cap(FLOATS_PER_TEXEL * side * side))
        first = self.growing_stage(growth, Appearance(max_alpha=self.lookup.max_alpha))
        textured = Appearance(texture=Texture(None, (side, side), self.lookup))
        return first, self.later_stage("textures", textured, (), self.texel_rate)

    @classmethod
    def presets(cls) -> dict[str, Self]:
        quick = {"densify": Mcmc(cap=QUICK_CAP), "texel_rate": QUICK_TEXELS}
        return cls.short_presets(quick, {"stage2_iterations": 120, "densify": Mcmc(cap=SMOKE_CAP)})

    def check_options(self) -> None:
        super().check_options()
        check_fields(self, "texture_side", least=1, most=16)
        check_fields(self, "texel_rate", least=0)


AUTHORS_LOG_SCALES = 3e-3
"""Learning rate of the logarithms of the scales in the authors' program of SuperGaussians."""


@dataclasses.dataclass(frozen=True)
class KernelRates(NamedFields):
    """Adam's learning rates of the kernels."""

    colors: float = 1.25e-3
    """Learning rate of the colours."""
    logit_opacities: float = 3e-2
    """Learning rate of the logits of the opacities."""
    centers: float = 1.25e-3
    """Learning rate of the centres."""
    sharpness: float = 1.25e-3
    """Learning rate of the sharpness."""

    def check_options(self) -> None:
        """Raise ValueError, beginning with the name of the field, if a rate is negative."""
        check_fields(self, least=0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuperGaussians(TwoStages):
    """Splats with four movable kernels each: clone, split, prune, opacity reset.

    SuperGaussians (Xu et al., 2024).
    """

    stage2_iterations: int = 0
    """Further iterations without densification; 0: none."""
    rates: LearningRates = LearningRates(log_scales=AUTHORS_LOG_SCALES)
    densify: CloneSplitPrune = CloneSplitPrune()
    """Adaptive density control (3DGS, 2DGS)."""
    opacity_reset: OpacityReset = OpacityReset()
    """Resets of the opacities."""
    kernels: KernelRates = KernelRates()
    """Adam's learning rates of the kernels."""

    name: ClassVar[str] = "supergaussians"

    def stages(self) -> tuple[Stage, ...]:
        cap = self.budget_cap(NUM_KERNELS * FLOATS_PER_KERNEL - 1)  # The Gaussian's own opacity is not trained.
        growth = grown_by_density(self.densify, cap), self.opacity_reset
        rates = dataclasses.asdict(self.kernels)
        return self.continued(self.growing_stage(growth, MovableKernels(), rates, name="kernels"))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        rates = {"rates": dataclasses.replace(QUICK_RATES, log_scales=AUTHORS_LOG_SCALES)}
        return cls.short_presets(*(rates | {"densify": CloneSplitPrune(cap=cap)} for cap in (QUICK_CAP, SMOKE_CAP)))


@dataclasses.dataclass(frozen=True)
class BillboardOptions(NamedFields):
    """The pictures of the billboards."""

    side: int = 16
    """Side of every picture in texels, 2 to 16."""
    rgb: float = 2.5e-3
    """Adam's learning rate of the colours."""
    alpha: float = 1e-3
    """Adam's learning rate of the alpha."""

    def check_options(self) -> None:
        """Raise ValueError, beginning with the name of the field, if a number is out of range."""
        check_fields(self, "side", least=2, most=16)
        check_fields(self, "rgb", "alpha", least=0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BBSplat(TwoStages):
    """Flat RGBA pictures, whose alpha replaces opacity and Gaussian.

    BBSplat (Svitov et al., 2024).
    """

    stage2_iterations: int = 2_000
    """Further iterations without densification; 0: none."""
    loss: LossConfig = LossConfig(opacity_weight=0.01)
    rates: LearningRates = LearningRates(sh_degree0=5e-3, sh_rest=2.5e-4)
    densify: Mcmc = Mcmc(cap=160_000)
    """MCMC densification. A billboard of 16 × 16 texels has as many bytes as 18.6 plain Gaussians."""
    billboard: BillboardOptions = BillboardOptions()
    """Size and learning rates of the pictures."""

    name: ClassVar[str] = "bbsplat"
    version: ClassVar[int] = 2

    def stages(self) -> tuple[Stage, ...]:
        pictures = Billboards(side=self.billboard.side)
        rates = (self.billboard.rgb, self.billboard.alpha)
        cap = self.budget_cap(FLOATS_PER_TEXEL * self.billboard.side**2 - 1)  # Their opacity is not trained.
        growth = self.densify if cap is None else FillingMcmc(cap)
        return self.continued(self.growing_stage((growth,), pictures, rates, name="billboards"))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        quick = BillboardOptions(rgb=1e-2, alpha=4e-3)
        smoke = BillboardOptions(side=8, rgb=1e-2, alpha=1e-2)
        return cls.short_presets(
            {"loss": LossConfig(), "densify": Mcmc(cap=2_000), "billboard": quick},
            {"loss": LossConfig(), "densify": Mcmc(cap=800), "billboard": smoke, "stage2_iterations": 0},
        )
