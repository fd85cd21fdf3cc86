"""SuperGaussians: four movable kernels vary colour and opacity over each splat; adaptive density control."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Self

from a2tg_jax.appearance import MovableKernels
from a2tg_jax.appearance.movable_kernels import MovableKernelParams
from a2tg_jax.systems.stage1 import (
    ANY_RATE,
    DENSITY_OPTIONS,
    DENSITY_RANGES,
    QUICK,
    QUICK_CAP,
    QUICK_RATES,
    SMOKE,
    SMOKE_CAP,
    DensityConfig,
    continued,
    growing_stage,
)
from a2tg_jax.training.options import Ranges, System
from a2tg_jax.training.rates import LearningRates
from a2tg_jax.training.stage import Stage

AUTHORS_LOG_SCALES = 3e-3


@dataclasses.dataclass(frozen=True)
class KernelConfig:
    """Adam's learning rates of the kernels."""

    colors: float = 1.25e-3
    """Learning rate of the colours."""
    logit_opacities: float = 3e-2
    """Learning rate of the logits of the opacities."""
    centers: float = 1.25e-3
    """Learning rate of the centres."""
    sharpness: float = 1.25e-3
    """Learning rate of the sharpness."""

    def rates(self) -> MovableKernelParams:
        """Return one rate for each field of the kernels."""
        rates: dict[str, Any] = dataclasses.asdict(self)
        return MovableKernelParams(**rates)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuperGaussians(System):
    """Splats with four movable kernels each: clone, split, prune, opacity reset."""

    stage1_iterations: int = 30_000
    """Iterations of the first stage."""
    stage2_iterations: int = 0
    """Further iterations without densification; 0: none."""
    rates: LearningRates = dataclasses.field(default_factory=lambda: LearningRates(log_scales=AUTHORS_LOG_SCALES))
    densify: DensityConfig = dataclasses.field(default_factory=DensityConfig)
    kernels: KernelConfig = dataclasses.field(default_factory=KernelConfig)

    name: ClassVar[str] = "supergaussians"
    ranges: ClassVar[Ranges] = {
        **DENSITY_RANGES,
        **dict.fromkeys(
            ("kernels.colors", "kernels.logit_opacities", "kernels.centers", "kernels.sharpness"), ANY_RATE
        ),
    }
    event_options: ClassVar[Mapping[str, str]] = DENSITY_OPTIONS

    def stages(self) -> tuple[Stage, ...]:
        kernels, rates = MovableKernels(), self.kernels.rates()
        events = self.densify.events(self.budget_cap(kernels.num_floats((), 1)))
        first = growing_stage(self, self.stage1_iterations, events, kernels, rates, name="kernels")
        return continued(self, first, self.stage2_iterations)

    @classmethod
    def presets(cls) -> dict[str, Self]:
        quick = dataclasses.replace(QUICK_RATES, log_scales=AUTHORS_LOG_SCALES)
        return {
            "paper": cls(),
            "quick": cls(**(QUICK | {"rates": quick}), densify=DensityConfig(cap=QUICK_CAP)),
            "smoke": cls(**(SMOKE | {"rates": quick}), densify=DensityConfig(cap=SMOKE_CAP)),
        }
