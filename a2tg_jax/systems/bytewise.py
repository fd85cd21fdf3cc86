"""Bytewise: many Gaussians of one colour first, then view dependence and texels for those that need them."""

import dataclasses
import math
from typing import ClassVar, Self

from a2tg_jax.adapt import Upscale
from a2tg_jax.appearance import Appearance, Bands, TexelRates, Texture, TextureOptions
from a2tg_jax.base.checks import check_fields, check_number
from a2tg_jax.base.text import MEGABYTE, bytes_of, shortened
from a2tg_jax.core.budget import bytes_per_gaussian
from a2tg_jax.densify.placing import PlaceByError
from a2tg_jax.densify.pruning import Prune
from a2tg_jax.densify.splitting import SplitByGradient
from a2tg_jax.densify.view_dependence import AdaptDegrees
from a2tg_jax.events import Event
from a2tg_jax.mcmc import Noise, densify_times
from a2tg_jax.systems.two_stages import PRUNING, LimitExponents, TwoStages, kernels_of, pruned
from a2tg_jax.training.stage import Stage

QUICK_CAP = 40_000
QUICK_COARSE_SHARE = 0.4
SMOKE_CAP = 2_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bytewise(TwoStages):
    """Gaussians of degree 0 first, then higher degrees, and textures if wanted, for those with the largest gradients.

    This library's own method, without a paper; its `Exponents` are after GES (Hamdi et al., 2024).

    Examples:
      >>> system = a2tg.Bytewise.preset("quick", memory_budget="300kB")
      >>> system.memory_budget, len(system.stages())
      (0.3, 2)
    """

    base_degree: int = 0
    """Degree of spherical harmonics of all Gaussians; some rise up to sh_degree."""
    densify: SplitByGradient = SplitByGradient(cap=2_000_000)
    """Densification. Without a memory_budget, the cap is the size of the model, as a number of Gaussians without view
    dependence and textures."""
    prune: Prune = PRUNING
    """Pruning of the Gaussians that show least, up to 0.8 of the first stage; others grow in their place. The end of
    the stage prunes in any case."""
    place: PlaceByError = PlaceByError()
    """New Gaussians in the first stage where pictures are wrong, up to the number that densify may reach. By default,
    each time follows a pruning, which makes room."""
    fading_weight: float = 0.01  # measured in experiments/NOTEBOOK.md, "A weight on opacities"
    """Weight of the mean opacity in the loss of the first stage, so that Gaussians that show little fade and move; 0:
    none. It adds to loss.opacity_weight."""
    kernel_rate: float = 0.01  # 0.02 and 0.005 are worse (experiments/NOTEBOOK.md, "Shapes of kernels")
    """Adam's learning rate of the kernels' shapes; 0: all kernels are Gaussians, as other programs draw them, for which
    a view_dependence_share of 0.23 is better."""
    exponents: LimitExponents = LimitExponents()
    """Lower limit of the exponents of kernels; 0: no limit."""
    view_dependence_share: float = 0.1  # the best with shapes of kernels
    """Share of the bytes for view dependence; 0: none."""
    view_dependence_rate: float = 2e-3
    """Adam's learning rate of the coefficients above base_degree."""
    view_dependence: AdaptDegrees = AdaptDegrees()
    """Spherical harmonics above base_degree, in the second stage."""
    texture_share: float = 0.0  # 0.02 gains nothing at 0.3 MB (experiments/NOTEBOOK.md)
    """Share of the bytes for textures, such as 0.02; 0: none."""
    texel_rate: float = 2.5e-3
    """Adam's learning rate of the texels; textures of one texel are not trained."""
    details: Upscale = Upscale(at=(0.1, 0.2, 0.3))
    """Textures of some Gaussians, in the second stage."""
    lookup: TextureOptions = TextureOptions()
    """Options of the texture lookup."""

    name: ClassVar[str] = "bytewise"
    version: ClassVar[int] = 8

    @property
    def initial_sh_degree(self) -> int:
        return self.base_degree

    def stages(self) -> tuple[Stage, ...]:
        kernels = kernels_of(self.kernel_rate, self.exponents)
        plain = Appearance(exponents=kernels.part, max_alpha=self.lookup.max_alpha)
        # Growth fills all bytes; the end of the first stage makes room for details.
        grow = dataclasses.replace(self.densify, cap=self._num_gaussians())
        pruning = pruned(self.prune, self.stage1_iterations, densify_times(self.stage1_iterations))
        placing = (dataclasses.replace(self.place, cap=grow.cap),) if self.place.share else ()
        last = (Prune(keep=self._num_kept()),) if self._share else ()
        growth = (Noise(), grow, *pruning, *placing, *last, *kernels.limits)
        first = self.growing_stage(growth, plain, kernels.rates or None)
        fading = dataclasses.replace(self.loss, opacity_weight=self.loss.opacity_weight + self.fading_weight)
        first = dataclasses.replace(first, losses=fading.terms())
        # Degrees rise up to their share of the bytes; textures, empty at first, take the rest.
        events: list[Event] = []
        rates = kernels.rates | {"bands": self.view_dependence_rate}
        detailed = dataclasses.replace(plain, bands=Bands())
        if self.view_dependence_share:
            budget = self._megabytes_before_texels()
            highest = min(self.sh_degree, self.view_dependence.highest)
            events.append(dataclasses.replace(self.view_dependence, budget_mb=budget, highest=highest))
        if self.texture_share:
            budget = self._num_bytes() / MEGABYTE
            events.append(dataclasses.replace(self.details, select="budget", budget_mb=budget))
            rates |= {"texture": TexelRates(self.texel_rate, 0.0)}
            # Without texels at first: one texel would add to the Gaussian's colour and opacity only.
            detailed = dataclasses.replace(detailed, texture=Texture(None, (0, 0), self.lookup), max_alpha=None)
        return first, self.later_stage("details", detailed, (*events, *kernels.limits), rates)

    @property
    def _share(self) -> float:
        """Share of the bytes for degrees and texels."""
        return self.view_dependence_share + self.texture_share

    def _num_gaussians(self) -> int:
        """Return the number of Gaussians that fill all bytes."""
        num = self.budget_cap(bool(self.kernel_rate))  # One float of a Gaussian for the shape of its kernel.
        return self.densify.cap if num is None else num

    def _num_kept(self) -> int:
        """Return the number of Gaussians that fit with degrees and texels."""
        return math.floor(self._num_bytes() * (1 - self._share) / self._bytes_each)

    def _num_bytes(self) -> int:
        """Return the bytes of the finished model."""
        return self.densify.cap * self._bytes_each if self.budget_bytes is None else self.budget_bytes

    def _megabytes_before_texels(self) -> float:
        """Return the megabytes of Gaussians and degrees."""
        return self._num_bytes() / MEGABYTE * (1 - self.texture_share)

    @property
    def _limit(self) -> str:
        """Path of the option that sets the bytes of the finished model."""
        return "densify.cap" if self.memory_budget is None else "memory_budget"

    @property
    def _bytes_each(self) -> int:
        """Bytes of a Gaussian without degrees and texels."""
        return int(bytes_per_gaussian(self.base_degree, bool(self.kernel_rate)))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        smoke = {"stage2_iterations": 120, "densify": SplitByGradient(SMOKE_CAP)}
        quick = {"densify": SplitByGradient(QUICK_CAP), "coarse_share": QUICK_COARSE_SHARE}
        return cls.short_presets(quick, smoke)

    def check_options(self) -> None:
        super().check_options()
        check_fields(self, "base_degree", least=0, most=self.sh_degree)
        check_fields(self, "view_dependence_share", "texture_share", least=0, most=1)
        check_fields(self, "fading_weight", "kernel_rate", "view_dependence_rate", "texel_rate", least=0)
        self._check_decided()
        self._check_shares()
        self._check_times()

    def _check_decided(self) -> None:
        """Raise ValueError if an option is set that the size of the model and the shares decide."""
        decided = {
            "details": ("select", "fraction", "threshold", "budget_mb"),
            "view_dependence": ("budget_mb",),
            "place": ("cap",),
        }
        for path, names in decided.items():
            event = getattr(self, path)
            for name in names:
                usual = getattr(type(event), name)
                number = getattr(event, name)
                if number != usual:
                    raise ValueError(
                        f"{path}.{name} must stay {usual!r}, as {self._limit} and the shares decide; got {number!r}"
                    )

    def _check_shares(self) -> None:
        """Raise ValueError unless the shares leave bytes for Gaussians, and something can take them."""
        if self.texture_share:
            check_number("details.cap", self.details.cap, least=2)
        elif self.details != type(self).details:
            raise ValueError("details has no effect while texture_share is 0: set that too, to 0.02 for example")
        if self._share >= 1:
            raise ValueError(
                "view_dependence_share and texture_share must leave bytes for Gaussians, adding up to less than 1; "
                f"got {self.view_dependence_share} and {self.texture_share}"
            )
        if self.view_dependence_share and self.base_degree == self.sh_degree:
            raise ValueError(
                f"view_dependence_share must be 0 where all Gaussians have the highest degree, {self.sh_degree}, "
                f"already: set it so, or lower base_degree; got {self.view_dependence_share}"
            )
        if self._num_gaussians() < 2 or self._num_kept() < 2:
            size = self.densify.cap if self.memory_budget is None else self.memory_budget
            raise ValueError(f"{self._limit} must leave room for 2 Gaussians with degrees and textures; got {size}")

    def _check_times(self) -> None:
        """Raise ValueError unless each share is spent in the second stage, on degrees before textures."""
        times = {}
        if self.view_dependence_share:
            times["view_dependence"] = self.view_dependence.times(self.stage2_iterations)
        if self.texture_share:
            times["details"] = self.details.times(self.stage2_iterations)
        for path, of_event in times.items():
            if not of_event:
                raise ValueError(f"{path}.at must hold fractions at which its share of the bytes is spent; it is empty")
        if len(times) == 2 and times["view_dependence"][-1] > times["details"][0]:
            raise ValueError(
                "view_dependence.at must be over when textures begin to take the rest of the bytes, at "
                f"details.at {shortened(self.details.at)}; got {shortened(self.view_dependence.at)}"
            )

    def check_given_number(self, num: int) -> None:
        """Check that the given Gaussians leave bytes for degrees and textures."""
        super().check_given_number(num)
        if not self._share:
            return
        megabytes = self._megabytes_before_texels() if self.view_dependence_share else self._num_bytes() / MEGABYTE
        most = bytes_of(megabytes) // self._bytes_each
        if num > most:
            raise ValueError(
                f"{self._limit} has room for {most:,} Gaussians when the stage 'details' begins, and {num:,} are "
                "given: raise it, or give fewer"
            )
