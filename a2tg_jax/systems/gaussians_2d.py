"""2DGS*: plain 2D Gaussians under adaptive density control, with the gradient statistic of 2DGS."""

import dataclasses
from typing import ClassVar, Self

from a2tg_jax.densify.clone_split import CloneSplitPrune, OpacityReset
from a2tg_jax.densify.pruning import Prune
from a2tg_jax.systems.stage1 import (
    NO_PRUNING,
    QUICK,
    QUICK_CAP,
    SMOKE,
    SMOKE_CAP,
    TwoStages,
    grown_by_density,
    pruned,
)
from a2tg_jax.training.options import LossConfig
from a2tg_jax.training.stage import Stage

SURFACES = LossConfig(normal_weight=0.2)
"""Weights for meshes (docs/meshes.md)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gaussians2d(TwoStages):
    """Plain 2D Gaussians: clone, split, prune, opacity reset."""

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
        pruning = pruned(self.prune, self.stage1_iterations, self.densify.times)
        growth = grown_by_density(self.densify, self.budget_cap()), self.opacity_reset
        return self.continued(self.growing_stage((*growth, *pruning)))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "quick": cls(**QUICK, densify=CloneSplitPrune(cap=QUICK_CAP)),
            "smoke": cls(**SMOKE, densify=CloneSplitPrune(cap=SMOKE_CAP)),
            "surfaces": cls(loss=SURFACES),
        }
