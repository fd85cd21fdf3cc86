"""Systems between plain Gaussians and `bytewise`, which show what each of its parts brings."""

import dataclasses
from typing import ClassVar

import a2tg_jax as a2tg
from a2tg_jax.densify.placing import PlaceByError
from a2tg_jax.densify.splitting import SplitByGradient
from a2tg_jax.mcmc import FillingMcmc, densify_times
from a2tg_jax.systems.baselines import Gaussians2d, Gaussians2dMcmc
from a2tg_jax.systems.bytewise import Bytewise
from a2tg_jax.systems.two_stages import LimitExponents, grown_by_mcmc, kernels_of, pruned
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.terms import Term, opacity


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShapedMcmc(Gaussians2dMcmc):
    """Plain 2D Gaussians by MCMC, each with a kernel of its own shape as in `bytewise`."""

    kernel_rate: float = 0.01
    exponents: LimitExponents = LimitExponents()

    name: ClassVar[str] = "shaped-mcmc"

    def stages(self) -> tuple[Stage, ...]:
        kernels = kernels_of(self.kernel_rate, self.exponents)
        growth = grown_by_mcmc(self.densify, self.budget_cap(1))
        pruning = pruned(self.prune, self.stage1_iterations, densify_times(self.stage1_iterations))
        first = self.growing_stage(
            (*growth, *pruning, *kernels.limits), a2tg.Appearance(exponents=kernels.part), kernels.rates
        )
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Placed:
    """The weight on opacities and the new Gaussians of `bytewise`, for a plain system.

    New Gaussians come after all other events of the first stage, up to the number that densification may reach.
    """

    fading_weight: float = Bytewise.fading_weight
    place: PlaceByError = PlaceByError()

    def stages(self) -> tuple[Stage, ...]:
        first, *others = super().stages()
        cap = max(event.most_gaussians or 0 for event in first.events)
        events = (*first.events, dataclasses.replace(self.place, cap=cap))
        losses = (*first.losses, Term(opacity, self.fading_weight))
        return dataclasses.replace(first, events=events, losses=losses), *others


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlacedMcmc(Placed, Gaussians2dMcmc):
    """Plain 2D Gaussians by MCMC, placed."""

    name: ClassVar[str] = "placed-mcmc"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlacedDensity(Placed, Gaussians2d):
    """Plain 2D Gaussians by clone and split, placed."""

    name: ClassVar[str] = "placed-density"
