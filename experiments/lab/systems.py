"""Systems between plain Gaussians and `bytewise`, which show what each of its parts brings."""

import dataclasses
from typing import ClassVar

import a2tg_jax as a2tg
from a2tg_jax.densify.splitting import SplitByGradient
from a2tg_jax.mcmc import FillingMcmc, densify_times
from a2tg_jax.systems.baselines import Gaussians2dMcmc
from a2tg_jax.systems.bytewise import Bytewise
from a2tg_jax.systems.two_stages import LimitExponents, grown_by_mcmc, kernels_of, pruned
from a2tg_jax.training.stage import Stage


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShapedMcmc(Gaussians2dMcmc):
    """Plain 2D Gaussians by MCMC, each with a kernel of its own shape as in `bytewise`."""

    kernel_rate: float = 0.01
    exponents: LimitExponents = LimitExponents()

    name: ClassVar[str] = "shaped-mcmc"

    def stages(self) -> tuple[Stage, ...]:
        kernels = kernels_of(self.kernel_rate, self.exponents)
        growth = grown_by_mcmc(self.densify, self.budget_cap(1))
        events = *growth, *pruned(self.prune, self.stage1_iterations, densify_times), *kernels.limits
        first = self.growing_stage(events, a2tg.Appearance(exponents=kernels.part), kernels.rates)
        if not self.stage2_iterations:
            return (first,)
        return first, self.later_stage("continued", first.appearance, kernels.limits, kernels.rates)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BytewiseByMcmc(Bytewise):
    """`bytewise` with MCMC's growth instead of splitting by gradient."""

    name: ClassVar[str] = "bytewise-by-mcmc"

    def stages(self) -> tuple[Stage, ...]:
        first, second = super().stages()
        growth = FillingMcmc(self._num_gaussians())
        events = [growth if isinstance(event, SplitByGradient) else event for event in first.events]
        return dataclasses.replace(first, events=tuple(events)), second
