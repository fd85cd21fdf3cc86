"""Bytewise: many Gaussians of one colour first, then view dependence and texels for those that need them."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Self

from a2tg_jax.adapt import Upscale
from a2tg_jax.appearance import (
    Appearance,
    Banded,
    BandedRates,
    Plain,
    Shaped,
    ShapedRates,
    TexelRates,
    Textured,
    TextureOptions,
)
from a2tg_jax.core.budget import MEGABYTE, bytes_of, bytes_per_gaussian
from a2tg_jax.densify.exponents import LimitExponents
from a2tg_jax.densify.pruning import Prune
from a2tg_jax.densify.splitting import SplitByGradient
from a2tg_jax.densify.view_dependence import AdaptDegrees
from a2tg_jax.events import Event, from_options, iterations_at
from a2tg_jax.host.text import shortened
from a2tg_jax.mcmc import Noise, densify_times
from a2tg_jax.systems.stage1 import (
    LOOKUP_RANGES,
    MCMC_OPTIONS,
    PRUNE_OPTIONS,
    PRUNE_RANGES,
    QUICK,
    SMOKE,
    PruneConfig,
    growing_stage,
    later_stage,
)
from a2tg_jax.texture import MAX_SIDE
from a2tg_jax.training.options import Ranges, System
from a2tg_jax.training.stage import Stage

QUICK_CAP, SMOKE_CAP = 40_000, 2_000


@dataclasses.dataclass(frozen=True)
class CapConfig:
    """Size of the model without a memory_budget."""

    cap: int = 2_000_000
    """Size of the model, as a number of Gaussians without view dependence and textures."""


@dataclasses.dataclass(frozen=True)
class KernelConfig:
    """Shapes of the kernels."""

    rate: float = 0.01
    """Adam's learning rate of the shapes; 0: all kernels are Gaussians, as other programs draw them, for which a
    view_dependence.share of 0.23 is better."""
    least_exponent: float = 0.6
    """Lower limit of the exponents of kernels, 0 to 1; smaller ones have longer tails, which take longer to draw. 0: no
    limit."""


@dataclasses.dataclass(frozen=True)
class ViewDependenceConfig:
    """Spherical harmonics above the Gaussians' own degree."""

    share: float = 0.1
    """Share of the bytes for view dependence; 0: none."""
    rate: float = 2e-3
    """Adam's learning rate of the coefficients."""
    idle: float = AdaptDegrees.idle
    """Smallest change of a colour by a band; bands below it are removed."""
    at: tuple[float, ...] = AdaptDegrees.at
    """Fractions of the second stage at which degrees change."""


@dataclasses.dataclass(frozen=True)
class DetailTextureConfig:
    """Textures of some Gaussians."""

    share: float = 0.02
    """Share of the bytes for textures; 0: none."""
    rate: float = 2.5e-3
    """Adam's learning rate of the texels."""
    cap: int = Upscale.cap
    """Largest texture side in texels, 2 to 16; textures of one texel are not trained."""
    at: tuple[float, ...] = (0.1, 0.2, 0.3)
    """Fractions of the second stage at which textures grow."""
    lookup: TextureOptions = dataclasses.field(default_factory=TextureOptions)
    """Options of the texture lookup."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bytewise(System):
    """Gaussians of degree 0 first, then degrees and textures for those with the largest gradients."""

    stage1_iterations: int = 30_000
    """Iterations of the first stage."""
    stage2_iterations: int = 30_000
    """Iterations of the second stage."""
    base_degree: int = 0
    """Degree of spherical harmonics of all Gaussians; some rise up to sh_degree."""
    densify: CapConfig = dataclasses.field(default_factory=CapConfig)
    prune: PruneConfig = dataclasses.field(default_factory=PruneConfig)
    kernel: KernelConfig = dataclasses.field(default_factory=KernelConfig)
    view_dependence: ViewDependenceConfig = dataclasses.field(default_factory=ViewDependenceConfig)
    texture: DetailTextureConfig = dataclasses.field(default_factory=DetailTextureConfig)

    name: ClassVar[str] = "bytewise"
    version: ClassVar[int] = 2
    earlier_options: ClassVar[Mapping[str, Any]] = {"kernel": {"rate": 0.0, "least_exponent": 0.0}}
    ranges: ClassVar[Ranges] = {**LOOKUP_RANGES, **PRUNE_RANGES}
    event_options: ClassVar[Mapping[str, str]] = {
        **MCMC_OPTIONS,
        **PRUNE_OPTIONS,
        "LimitExponents.least": "kernel.least_exponent",
        "AdaptDegrees.at": "view_dependence.at",
        "AdaptDegrees.idle": "view_dependence.idle",
        "AdaptDegrees.highest": "sh_degree",
        "Upscale.at": "texture.at",
        "Upscale.cap": "texture.cap",
    }

    @property
    def initial_sh_degree(self) -> int:
        return self.base_degree

    def stages(self) -> tuple[Stage, ...]:
        shown, rates = self._appearance()
        plain, plain_rates = self._shaped(Plain(self.texture.lookup.max_alpha), 0.0)
        first = growing_stage(self, self.stage1_iterations, self._growth(), plain, plain_rates)
        return first, later_stage(self, "details", shown, self._details(), self.stage2_iterations, rates)

    def _growth(self) -> tuple[Event, ...]:
        """Return the events that fill all bytes, prune during growth, and finally make room for details."""
        grow = SplitByGradient(self._num_gaussians())
        last = (Prune(keep=self._num_kept()),) if self._share else ()
        return Noise(), grow, *self.prune.events(self.stage1_iterations, densify_times), *last, *self._limits()

    def _limits(self) -> tuple[Event, ...]:
        """Return the event that limits the exponents of kernels, if they are trained and have a limit."""
        kernel = self.kernel
        return (LimitExponents(kernel.least_exponent),) if kernel.rate and kernel.least_exponent else ()

    @property
    def _share(self) -> float:
        """Share of the bytes for degrees and texels."""
        return self.view_dependence.share + self.texture.share

    def _num_gaussians(self) -> int:
        """Return the number of Gaussians that fill all bytes."""
        num = self.budget_cap(self._floats_of_kernel)
        return self.densify.cap if num is None else num

    def _num_kept(self) -> int:
        """Return the number of Gaussians that fit beside degrees and texels."""
        return math.floor(self._num_bytes() * (1 - self._share) / self._own_bytes)

    def _num_bytes(self) -> int:
        """Return the bytes of the finished model."""
        return self.densify.cap * self._own_bytes if self.budget_bytes is None else self.budget_bytes

    def _megabytes_before_texels(self) -> float:
        """Return the megabytes of Gaussians and degrees."""
        return self._num_bytes() / MEGABYTE * (1 - self.texture.share)

    @property
    def _limit(self) -> str:
        """Name of the option that sets the bytes of the finished model."""
        return "densify.cap" if self.memory_budget is None else "memory_budget"

    @property
    def _own_bytes(self) -> int:
        """Bytes of a Gaussian without degrees and texels."""
        return int(bytes_per_gaussian(self.base_degree, self._floats_of_kernel))

    @property
    def _floats_of_kernel(self) -> int:
        """Floats of a Gaussian for the shape of its kernel."""
        return 1 if self.kernel.rate else 0

    def _appearance(self) -> tuple[Appearance, BandedRates]:
        """Textures that are empty at first, if there are any, and rates of all that is shown."""
        lookup = self.texture.lookup
        inner: Any = Textured((0, 0), lookup) if self.texture.share else Plain(lookup.max_alpha)
        of_texels = TexelRates(self.texture.rate, 0.0) if self.texture.share else 0.0
        shaped, of_inner = self._shaped(inner, of_texels)
        return Banded(shaped), BandedRates(self.view_dependence.rate, of_inner)

    def _shaped(self, inner: Appearance, rates: Any) -> tuple[Appearance, Any]:
        """Return an appearance and its rates with shapes of the kernels, if they are trained."""
        return (Shaped(inner), ShapedRates(self.kernel.rate, rates)) if self.kernel.rate else (inner, rates)

    def _details(self) -> tuple[Event, ...]:
        """Return the events of degrees, up to their share of the bytes, then of texels for the rest."""
        megabytes = self._num_bytes() / MEGABYTE
        view, texture = self.view_dependence, self.texture
        events: list[Event] = []
        if view.share:
            most = self._megabytes_before_texels()
            events.append(from_options(AdaptDegrees, view, budget_mb=most, highest=self.sh_degree))
        if texture.share:
            events.append(from_options(Upscale, texture, select="budget", budget_mb=megabytes))
        return (*events, *self._limits())

    @classmethod
    def presets(cls) -> dict[str, Self]:
        return {
            "paper": cls(),
            "quick": cls(**QUICK, densify=CapConfig(QUICK_CAP)),
            "smoke": cls(**SMOKE, stage2_iterations=120, densify=CapConfig(SMOKE_CAP)),
        }

    def check(self) -> None:
        self._check_numbers()
        view, texture = self.view_dependence, self.texture
        ranges = {
            "base_degree": (self.base_degree, 0, self.sh_degree),
            "kernel.rate": (self.kernel.rate, 0, math.inf),
            "kernel.least_exponent": (self.kernel.least_exponent, 0, 1),
            "view_dependence.share": (view.share, 0, 1),
            "view_dependence.rate": (view.rate, 0, math.inf),
            "view_dependence.idle": (view.idle, 0, math.inf),
            "texture.share": (texture.share, 0, 1),
            "texture.rate": (texture.rate, 0, math.inf),
            "texture.cap": (texture.cap, 2 if texture.share else 1, MAX_SIDE),
        }
        for name, (value, least, most) in ranges.items():
            if not least <= value <= most:
                raise ValueError(f"{name} must lie in {least}..{most}; got {value}")
        if view.share + texture.share >= 1:
            raise ValueError(
                "view_dependence.share and texture.share must leave bytes for Gaussians, adding up to less than 1; "
                f"got {view.share} and {texture.share}"
            )
        if view.share and self.base_degree == self.sh_degree:
            raise ValueError(
                f"view_dependence.share must be 0 where all Gaussians have the highest degree, {self.sh_degree}, "
                f"already: set it so, or lower base_degree; got {view.share}"
            )
        self._check_times()
        if self._num_gaussians() < 2 or self._num_kept() < 2:
            size = self.densify.cap if self.memory_budget is None else self.memory_budget
            raise ValueError(f"{self._limit} must leave room for 2 Gaussians beside degrees and textures; got {size}")
        super().check()

    def check_given_number(self, num: int) -> None:
        """Refuse more given Gaussians than degrees and textures leave bytes for."""
        super().check_given_number(num)
        if not self._share:
            return
        megabytes = self._megabytes_before_texels() if self.view_dependence.share else self._num_bytes() / MEGABYTE
        most = bytes_of(megabytes) // self._own_bytes
        if num > most:
            raise ValueError(
                f"{self._limit} has room for {most:,} Gaussians when the stage 'details' begins, and {num:,} are "
                "given: raise it, or give fewer"
            )

    def _check_times(self) -> None:
        """Refuse times outside a stage, times after the last growth, and degrees that change after textures took the
        bytes."""
        view, texture = self.view_dependence, self.texture
        asked = {"view_dependence.at": (view.share, view.at), "texture.at": (texture.share, texture.at)}
        times = {name: iterations_at(at, self.stage2_iterations, name) for name, (share, at) in asked.items() if share}
        for name, found in times.items():
            if not found:
                raise ValueError(f"{name} must say when its share of the bytes is spent; it is empty")
        if len(times) == 2 and times["view_dependence.at"][-1] > times["texture.at"][0]:
            raise ValueError(
                "view_dependence.at must be over when textures begin to take the rest of the bytes, at "
                f"texture.at {shortened(texture.at)}; got {shortened(view.at)}"
            )
