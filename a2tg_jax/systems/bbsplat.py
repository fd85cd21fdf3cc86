"""BBSplat: RGBA billboards from the first iteration, densified by MCMC on the mean alpha of their pictures."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar, Self

from a2tg_jax.appearance import Billboards
from a2tg_jax.mcmc import FillingMcmc, Mcmc
from a2tg_jax.systems.stage1 import ANY_RATE, FLOATS_PER_TEXEL, MCMC_OPTIONS, QUICK, SMOKE, continued, growing_stage
from a2tg_jax.training.option_groups import LossConfig
from a2tg_jax.training.options import Ranges, System
from a2tg_jax.training.rates import LearningRates
from a2tg_jax.training.stage import Stage

AUTHORS_OPACITY_WEIGHT = 0.01
AUTHORS_RATES = LearningRates(sh_degree0=5e-3, sh_rest=2.5e-4)


@dataclasses.dataclass(frozen=True)
class BillboardConfig:
    """The pictures, and how many of them."""

    side: int = 16
    """Side of every picture in texels, 2 to 16."""
    rgb: float = 2.5e-3
    """Adam's learning rate of the colours."""
    alpha: float = 1e-3
    """Adam's learning rate of the alpha."""


@dataclasses.dataclass(frozen=True)
class BillboardMcmcConfig:
    """MCMC densification of billboards."""

    cap: int = 160_000
    """Largest number of billboards; a memory_budget takes its place. A billboard of 16 × 16 texels has as many bytes as
    18.6 plain Gaussians."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BBSplat(System):
    """Flat RGBA pictures, whose alpha takes the place of opacity and Gaussian."""

    stage1_iterations: int = 30_000
    """Iterations of the first stage."""
    stage2_iterations: int = 2_000
    """Further iterations without densification; 0: none."""
    loss: LossConfig = dataclasses.field(default_factory=lambda: LossConfig(opacity_weight=AUTHORS_OPACITY_WEIGHT))
    rates: LearningRates = dataclasses.field(default_factory=lambda: AUTHORS_RATES)
    densify: BillboardMcmcConfig = dataclasses.field(default_factory=BillboardMcmcConfig)
    billboard: BillboardConfig = dataclasses.field(default_factory=BillboardConfig)

    name: ClassVar[str] = "bbsplat"
    version: ClassVar[int] = 2
    ranges: ClassVar[Ranges] = {
        "billboard.side": (2, 16),
        "billboard.rgb": ANY_RATE,
        "billboard.alpha": ANY_RATE,
    }
    event_options: ClassVar[Mapping[str, str]] = MCMC_OPTIONS

    def stages(self) -> tuple[Stage, ...]:
        if self.densify.cap < 2:
            raise ValueError(f"densify.cap must be at least 2 billboards; got {self.densify.cap}")
        pictures, rates = Billboards(self.billboard.side), (self.billboard.rgb, self.billboard.alpha)
        cap = self.budget_cap(FLOATS_PER_TEXEL * self.billboard.side**2 - 1)  # Their opacity is not trained.
        events = (Mcmc(self.densify.cap) if cap is None else FillingMcmc(cap),)
        first = growing_stage(self, self.stage1_iterations, events, pictures, rates, name="billboards")
        return continued(self, first, self.stage2_iterations)

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "quick": cls(
                **QUICK, loss=LossConfig(),
                densify=BillboardMcmcConfig(cap=2_000), billboard=BillboardConfig(rgb=1e-2, alpha=4e-3),
            ),
            "smoke": cls(
                **SMOKE, stage2_iterations=0, loss=LossConfig(), densify=BillboardMcmcConfig(cap=800),
                billboard=BillboardConfig(side=8, rgb=1e-2, alpha=1e-2),
            ),
        }  # fmt: skip
