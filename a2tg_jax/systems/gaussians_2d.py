"""2DGS*: plain 2D Gaussians under adaptive density control, with the gradient statistic of 2DGS."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar, Self

from a2tg_jax.densify.clone_split import CloneSplitPrune
from a2tg_jax.systems.stage1 import (
    DENSITY_OPTIONS,
    DENSITY_RANGES,
    NO_PRUNING,
    PRUNE_OPTIONS,
    PRUNE_RANGES,
    QUICK,
    QUICK_CAP,
    SMOKE,
    SMOKE_CAP,
    DensityConfig,
    PruneConfig,
    continued,
    growing_stage,
)
from a2tg_jax.training.option_groups import LossConfig
from a2tg_jax.training.options import Ranges, System
from a2tg_jax.training.stage import Stage

SURFACES = LossConfig(normal_weight=0.2)
"""Weights for meshes (docs/meshes.md)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gaussians2d(System):
    """Plain 2D Gaussians: clone, split, prune, opacity reset."""

    stage1_iterations: int = 30_000
    """Iterations of the first stage."""
    stage2_iterations: int = 0
    """Further iterations without densification; 0: none."""
    densify: DensityConfig = dataclasses.field(default_factory=DensityConfig)
    prune: PruneConfig = NO_PRUNING

    name: ClassVar[str] = "gaussians-2d"
    ranges: ClassVar[Ranges] = {**DENSITY_RANGES, **PRUNE_RANGES}
    event_options: ClassVar[Mapping[str, str]] = {**DENSITY_OPTIONS, **PRUNE_OPTIONS}

    def stages(self) -> tuple[Stage, ...]:
        pruning = self.prune.events(self.stage1_iterations, CloneSplitPrune().times)
        first = growing_stage(self, self.stage1_iterations, (*self.densify.events(self.budget_cap()), *pruning))
        return continued(self, first, self.stage2_iterations)

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "quick": cls(**QUICK, densify=DensityConfig(cap=QUICK_CAP)),
            "smoke": cls(**SMOKE, densify=DensityConfig(cap=SMOKE_CAP)),
            "surfaces": cls(loss=SURFACES),
        }
