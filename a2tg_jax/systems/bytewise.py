"""Bytes where they pay: many Gaussians of one colour, then view dependence and texels for those that ask for them."""

import dataclasses
import math
from typing import Any, ClassVar, Self

from a2tg_jax.adapt import Upscale
from a2tg_jax.appearance import Banded, BandedRates, Plain, TexelRates, Textured, TextureOptions
from a2tg_jax.budget import MEGABYTE, bytes_per_gaussian
from a2tg_jax.events import Event
from a2tg_jax.gaussians import floats_per_gaussian
from a2tg_jax.mcmc import Noise
from a2tg_jax.splitting import SplitByGradient
from a2tg_jax.systems.stage1 import QUICK, QUICK_TEXELS, SMOKE, growing_stage, later_stage
from a2tg_jax.training.options import System
from a2tg_jax.training.stage import Stage
from a2tg_jax.view_dependence import AdaptDegrees

QUICK_CAP, SMOKE_CAP = 40_000, 2_000


@dataclasses.dataclass(frozen=True)
class CapConfig:
    """How large the model becomes where there is no memory_budget."""

    cap: int = 2_000_000
    """Its bytes are those of so many Gaussians without view dependence and textures."""


@dataclasses.dataclass(frozen=True)
class ViewDependenceConfig:
    """Spherical harmonics above the Gaussians' own degree."""

    share: float = 0.1
    """Of the memory budget; 0: none."""
    rate: float = 2e-3
    """Adam's learning rate of the coefficients."""
    idle: float = 0.0
    """Bands that change a colour by less than this are given up for others."""
    at: tuple[float, ...] = (0.05, 0.1)
    """Fractions of the second stage at which degrees change."""


@dataclasses.dataclass(frozen=True)
class DetailTextureConfig:
    """Textures of the Gaussians that get one."""

    share: float = 0.05
    """Of the memory budget; 0: none."""
    rate: float = 2.5e-3
    """Adam's learning rate of the texels."""
    cap: int = 4
    """Largest texture side in texels (at most 16)."""
    at: tuple[float, ...] = (0.1, 0.2, 0.3)
    """Fractions of the second stage at which textures grow."""
    lookup: TextureOptions = dataclasses.field(default_factory=TextureOptions)
    """How textures are read."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bytewise(System):
    """Gaussians of degree 0 first, then degrees and textures for those whose gradients ask for them."""

    stage1_iterations: int = 30_000
    stage2_iterations: int = 30_000
    sh_degree: int = 0
    """Degree of spherical harmonics that all Gaussians have, 0 to 3; those that need it get more."""
    densify: CapConfig = dataclasses.field(default_factory=CapConfig)
    view_dependence: ViewDependenceConfig = dataclasses.field(default_factory=ViewDependenceConfig)
    texture: DetailTextureConfig = dataclasses.field(default_factory=DetailTextureConfig)

    name: ClassVar[str] = "bytewise"

    def stages(self) -> tuple[Stage, ...]:
        shown, rates = self._appearance()
        growth = (Noise(), SplitByGradient(self._num_gaussians()))
        first = growing_stage(self, self.stage1_iterations, growth, Plain(self.texture.lookup.max_alpha))
        return first, later_stage(self, "details", shown, self._details(), self.stage2_iterations, rates)

    def _num_gaussians(self) -> int:
        """As many as there is room for beside degrees and texels."""
        share = self.view_dependence.share + self.texture.share
        num = self.budget_cap(floats_per_gaussian(self.sh_degree) * share / (1 - share))
        return math.floor(self.densify.cap * (1 - share)) if num is None else num

    def _num_bytes(self) -> int:
        """Of all that there is in the end."""
        own = int(bytes_per_gaussian(self.sh_degree))
        return self.densify.cap * own if self.budget_bytes is None else self.budget_bytes

    def _appearance(self) -> tuple[Banded, BandedRates]:
        """Textures that are empty at first, if there are any, and rates of all that is shown."""
        lookup = self.texture.lookup
        inner: Any = Textured((0, 0), lookup) if self.texture.share else Plain(lookup.max_alpha)
        of_texels = TexelRates(self.texture.rate, 0.0) if self.texture.share else 0.0
        return Banded(inner), BandedRates(self.view_dependence.rate, of_texels)

    def _details(self) -> tuple[Event, ...]:
        """Degrees first, up to their share, then texels for all that is left."""
        megabytes = self._num_bytes() / MEGABYTE
        view, texture = self.view_dependence, self.texture
        events: list[Event] = []
        if view.share:
            events.append(AdaptDegrees(megabytes * (1 - texture.share), at=view.at, idle=view.idle))
        if texture.share:
            events.append(Upscale("budget", budget_mb=megabytes, cap=texture.cap, at=texture.at))
        return tuple(events)

    @classmethod
    def presets(cls) -> dict[str, Self]:
        quick = DetailTextureConfig(rate=QUICK_TEXELS)
        return {
            "paper": cls(),
            "quick": cls(**QUICK, densify=CapConfig(QUICK_CAP), texture=quick),
            "smoke": cls(**SMOKE, stage2_iterations=120, densify=CapConfig(SMOKE_CAP), texture=quick),
        }

    def check(self) -> None:
        if self._num_gaussians() < 2:
            raise ValueError(f"densify.cap must leave room for 2 Gaussians; got {self.densify.cap}")
        for name, share in (
            ("view_dependence.share", self.view_dependence.share),
            ("texture.share", self.texture.share),
        ):
            if not 0 <= share < 1:
                raise ValueError(f"{name} must lie in [0, 1); got {share}")
        if self.view_dependence.share + self.texture.share >= 1:
            raise ValueError(
                "view_dependence.share and texture.share must leave bytes for Gaussians: their sum is 1 or more"
            )
        if self.texture.share and self.view_dependence.at[-1:] > self.texture.at[:1]:
            raise ValueError(
                "view_dependence.at must be over when textures begin to take the rest of the bytes, at "
                f"texture.at {self.texture.at}; got {self.view_dependence.at}"
            )
        super().check()
