"""2DGS*-MCMC: plain 2D Gaussians under MCMC densification. A second stage without events allows comparisons at equal
iterations."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar, Self

from a2tg_jax.mcmc import densify_times
from a2tg_jax.systems.stage1 import (
    MCMC_OPTIONS,
    NO_PRUNING,
    PRUNE_OPTIONS,
    PRUNE_RANGES,
    QUICK,
    QUICK_CAP,
    SMOKE,
    SMOKE_CAP,
    McmcConfig,
    PruneConfig,
    continued,
    growing_stage,
)
from a2tg_jax.training.options import Ranges, System
from a2tg_jax.training.stage import Stage


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gaussians2dMcmc(System):
    """Plain 2D Gaussians, densified by MCMC."""

    stage1_iterations: int = 30_000
    """Iterations of the first stage."""
    stage2_iterations: int = 0
    """Further iterations without densification; 0: none."""
    densify: McmcConfig = dataclasses.field(default_factory=McmcConfig)
    prune: PruneConfig = NO_PRUNING

    name: ClassVar[str] = "gaussians-2d-mcmc"
    ranges: ClassVar[Ranges] = PRUNE_RANGES
    event_options: ClassVar[Mapping[str, str]] = {**MCMC_OPTIONS, **PRUNE_OPTIONS}

    def stages(self) -> tuple[Stage, ...]:
        pruning = self.prune.events(self.stage1_iterations, densify_times)
        first = growing_stage(self, self.stage1_iterations, (*self.densify.events(self.budget_cap()), *pruning))
        return continued(self, first, self.stage2_iterations)

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "quick": cls(**QUICK, densify=McmcConfig(cap=QUICK_CAP)),
            "smoke": cls(**SMOKE, densify=McmcConfig(cap=SMOKE_CAP)),
        }
