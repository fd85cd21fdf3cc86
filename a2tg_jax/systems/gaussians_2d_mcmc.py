"""2DGS*-MCMC: plain 2D Gaussians under MCMC densification. A second stage without events allows comparisons at equal
iterations."""

import dataclasses
from typing import ClassVar, Self

from a2tg_jax.densify.pruning import Prune
from a2tg_jax.mcmc import Mcmc, densify_times
from a2tg_jax.systems.stage1 import NO_PRUNING, QUICK, QUICK_CAP, SMOKE, SMOKE_CAP, TwoStages, grown_by_mcmc, pruned
from a2tg_jax.training.stage import Stage


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gaussians2dMcmc(TwoStages):
    """Plain 2D Gaussians, densified by MCMC."""

    stage2_iterations: int = 0
    """Further iterations without densification; 0: none."""
    densify: Mcmc = Mcmc()
    """MCMC densification (3DGS-MCMC)."""
    prune: Prune = NO_PRUNING
    """Pruning of the Gaussians that show least, up to 0.8 of the first stage; others grow in their place."""

    name: ClassVar[str] = "gaussians-2d-mcmc"

    def stages(self) -> tuple[Stage, ...]:
        growth = grown_by_mcmc(self.densify, self.budget_cap())
        return self.continued(self.growing_stage((*growth, *pruned(self.prune, self.stage1_iterations, densify_times))))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "quick": cls(**QUICK, densify=Mcmc(cap=QUICK_CAP)),
            "smoke": cls(**SMOKE, densify=Mcmc(cap=SMOKE_CAP)),
        }
