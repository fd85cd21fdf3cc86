"""BBSplat: RGBA billboards from the first iteration, densified by MCMC on the mean alpha of their pictures."""

import dataclasses
from typing import ClassVar, Self

from a2tg_jax.appearance import Billboards
from a2tg_jax.core.checks import check_number
from a2tg_jax.mcmc import FillingMcmc, Mcmc
from a2tg_jax.systems.stage1 import FLOATS_PER_TEXEL, QUICK, SMOKE, TwoStages
from a2tg_jax.training.options import LossConfig
from a2tg_jax.training.stage import LearningRates, Stage

AUTHORS_LOSS = LossConfig(opacity_weight=0.01)
AUTHORS_RATES = LearningRates(sh_degree0=5e-3, sh_rest=2.5e-4)


@dataclasses.dataclass(frozen=True)
class BillboardOptions:
    """The pictures of the billboards."""

    side: int = 16
    """Side of every picture in texels, 2 to 16."""
    rgb: float = 2.5e-3
    """Adam's learning rate of the colours."""
    alpha: float = 1e-3
    """Adam's learning rate of the alpha."""

    def check_options(self) -> None:
        """Raise ValueError, beginning with the name of the field, if a number is out of range."""
        check_number("side", self.side, least=2, most=16)
        check_number("rgb", self.rgb, least=0)
        check_number("alpha", self.alpha, least=0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BBSplat(TwoStages):
    """Flat RGBA pictures, whose alpha takes the place of opacity and Gaussian."""

    stage2_iterations: int = 2_000
    """Further iterations without densification; 0: none."""
    loss: LossConfig = AUTHORS_LOSS
    rates: LearningRates = AUTHORS_RATES
    densify: Mcmc = Mcmc(cap=160_000)
    """MCMC densification. A billboard of 16 × 16 texels has as many bytes as 18.6 plain Gaussians."""
    billboard: BillboardOptions = BillboardOptions()

    name: ClassVar[str] = "bbsplat"
    version: ClassVar[int] = 2

    def stages(self) -> tuple[Stage, ...]:
        pictures, rates = Billboards(side=self.billboard.side), (self.billboard.rgb, self.billboard.alpha)
        cap = self.budget_cap(FLOATS_PER_TEXEL * self.billboard.side**2 - 1)  # Their opacity is not trained.
        growth = self.densify if cap is None else FillingMcmc(cap)
        return self.continued(self.growing_stage((growth,), pictures, rates, name="billboards"))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "quick": cls(
                **QUICK, loss=LossConfig(),
                densify=Mcmc(cap=2_000), billboard=BillboardOptions(rgb=1e-2, alpha=4e-3),
            ),
            "smoke": cls(
                **SMOKE, stage2_iterations=0, loss=LossConfig(), densify=Mcmc(cap=800),
                billboard=BillboardOptions(side=8, rgb=1e-2, alpha=1e-2),
            ),
        }  # fmt: skip
