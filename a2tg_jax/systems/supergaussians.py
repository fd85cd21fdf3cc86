"""SuperGaussians: four movable kernels vary colour and opacity over each splat; adaptive density control."""

import dataclasses
from typing import ClassVar, Self

from a2tg_jax.appearance import MovableKernels
from a2tg_jax.appearance.movable_kernels import FLOATS_PER_KERNEL, NUM_KERNELS
from a2tg_jax.core.checks import check_number
from a2tg_jax.densify.clone_split import CloneSplitPrune, OpacityReset
from a2tg_jax.systems.stage1 import QUICK, QUICK_CAP, QUICK_RATES, SMOKE, SMOKE_CAP, TwoStages, grown_by_density
from a2tg_jax.training.stage import LearningRates, Stage

AUTHORS_LOG_SCALES = 3e-3


@dataclasses.dataclass(frozen=True)
class KernelRates:
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
        for field in dataclasses.fields(self):
            check_number(field.name, getattr(self, field.name), least=0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuperGaussians(TwoStages):
    """Splats with four movable kernels each: clone, split, prune, opacity reset."""

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
        quick = dataclasses.replace(QUICK_RATES, log_scales=AUTHORS_LOG_SCALES)
        return {
            "paper": cls(),
            "quick": cls(**(QUICK | {"rates": quick}), densify=CloneSplitPrune(cap=QUICK_CAP)),
            "smoke": cls(**(SMOKE | {"rates": quick}), densify=CloneSplitPrune(cap=SMOKE_CAP)),
        }
