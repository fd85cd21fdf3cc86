"""Options that every system has: views, initial Gaussians, loss, learning rates, the seed."""

import dataclasses
import math
import typing
from typing import Any, ClassVar, Literal, Self

from a2tg_jax.base.checks import check_fields, check_groups, check_int, check_number
from a2tg_jax.base.config_json import changed_config, check_config, config_to_dict, flatten_config
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import budget_in_bytes, did_you_mean, in_bytes, megabytes_of, shortened
from a2tg_jax.core.budget import BYTES_PER_FLOAT, bytes_per_gaussian
from a2tg_jax.core.origin import BLACK, WHITE, Color
from a2tg_jax.events import Event
from a2tg_jax.rasterize.kernels.platforms import MAX_TILE_SIZE
from a2tg_jax.training.corrections import BilateralGrid, Correction, Exposure, PoseRefinement
from a2tg_jax.training.stage import Background, LearningRates, LossTerm, Stage
from a2tg_jax.training.terms import (
    DepthKind,
    DepthPrior,
    Photometric,
    RobustPhotometric,
    Term,
    distortion,
    l1,
    normals,
    opacity,
    scale,
)


@dataclasses.dataclass(frozen=True)
class LossConfig(NamedFields):
    """Weights of the photometric loss and of the optional terms (0 is off, the paper's setting)."""

    ssim_weight: float = Photometric.ssim_weight
    """w in (1 - w)·L1 + w·(1 - SSIM)."""
    normal_weight: float = 0.0
    """Normal consistency of 2DGS: rendered normals against the normals of the rendered depth."""
    distortion_weight: float = 0.0
    """Depth distortion of 2DGS."""
    opacity_weight: float = 0.0
    """Mean opacity of the live splats, or mean alpha of their pictures (3DGS-MCMC and BBSplat use 0.01)."""
    scale_weight: float = 0.0
    """Mean scale of the live Gaussians (3DGS-MCMC uses 0.01)."""
    robust_share: float = 0.0
    """Largest share of each photograph to leave out where it differs most from the render, such as passers-by; 0: none.
    """
    robust_factor: float = RobustPhotometric.factor
    """Least residual of a patch that robust_share leaves out, as a multiple of the photograph's median."""

    depth_weight: float = 0.0
    """Rendered inverse depth against the scene's depth maps, after a least-squares scale and shift per view."""
    depth_kind: DepthKind = "inverse"
    """Meaning of depth maps: inverse depth up to scale and shift (monocular networks), or depth up to scale."""

    def check_options(self) -> None:
        """Raise ValueError, beginning with the name of the field, if a number is out of range."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "depth_kind"]
        check_fields(self, *names, least=0)
        check_fields(self, "ssim_weight", "robust_share", most=1)

    def terms(self, is_first: bool = True) -> tuple[LossTerm, ...]:
        """Return the loss terms whose weight is not 0.

        Args:
          is_first: whether they are for the first stage, in which robust_share acts only after a while.
        """
        first: LossTerm = Photometric(self.ssim_weight) if self.ssim_weight else Term(l1)
        if self.robust_share:
            start = RobustPhotometric.start if is_first else 0.0
            has_ssim = self.ssim_weight != 0
            first = RobustPhotometric(self.ssim_weight, self.robust_share, self.robust_factor, start, has_ssim)
        optional: tuple[Term | DepthPrior, ...] = (
            Term(normals, self.normal_weight, has_geometry=True),
            Term(distortion, self.distortion_weight, has_geometry=True),
            Term(opacity, self.opacity_weight),
            Term(scale, self.scale_weight),
            DepthPrior(self.depth_weight, self.depth_kind),
        )
        return (first, *(term for term in optional if term.weight))


@dataclasses.dataclass(frozen=True)
class Corrections(NamedFields):
    """Options of `exposure` and `refine_poses`."""

    exposure_kind: Literal["affine", "grid"] = "affine"
    """Exposure of a photograph: an affine map of its colours, or also a bilateral grid of such maps, which follows
    vignettes and local tone mapping."""
    affine: Exposure = Exposure()
    """Learning rate of affine maps, and its fall."""
    grid: BilateralGrid = BilateralGrid()
    """Size, learning rate and smoothness of bilateral grids."""
    pose: PoseRefinement = PoseRefinement(final_factor=0.1)
    """Learning rate of poses, and its fall."""

    def check_options(self) -> None:
        """Raise ValueError, beginning with the path of the field, if a number is out of range."""
        check_groups(self)


FEW_GAUSSIANS = 1_000
"""Number of Gaussians below which a memory budget is likely to be a mistake."""
SENSIBLE_GAUSSIANS = 10_000
"""Number of Gaussians of the memory budget that is then suggested."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class System(NamedFields):
    """A training method as a value: its fields are its options, `stages` composes the training.

    Derive a custom system from this class, add fields and compose its stages; the command line takes it as
    package.module:NAME. Fields are numbers, texts, tuples of them, and dataclasses of such fields, such as events. The
    path of a field is its name everywhere: `densify.cap` in errors and configuration files.
    """

    batch_size: int = 1
    """Views per iteration."""
    initial_gaussians: int | None = None
    """Number of Gaussians to start from; None: one per point, at most the cap."""
    initial_opacity: float = 0.1
    """Opacity of the Gaussians that training starts from; billboards with alpha textures always start half opaque in
    the middle."""
    memory_budget: float | str | None = None
    """Budget of the model's bytes in memory, not in files: 1.5MB, 800kB, 2GB, or a number of MB (10^6 bytes). The
    model stays within it at every iteration and ends within 0.5 % of it. It sets the number of Gaussians and texels,
    instead of densify.cap."""
    background: Background = "black"
    """Background of renders, and of transparent photographs."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics, 0 to 3."""
    seed: int = 0
    """Seed of all random numbers."""
    tile_size: int = 16
    """Side of a tile in pixels. Results do not depend on it."""
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    """Weights of the loss."""
    rates: LearningRates = dataclasses.field(default_factory=LearningRates)
    """Adam's learning rates of the Gaussians."""
    exposure: bool = False
    """Learn an affine map of colours for each training photograph, for captures whose exposure or white balance
    changes."""
    refine_poses: bool = False
    """Learn a small rigid motion of each training camera, for captures whose poses are not exact."""
    corrections: Corrections = dataclasses.field(default_factory=Corrections)
    """Options of exposures and poses."""
    more: tuple[int, ...] = ()
    """Iterations of further stages, in which the last one continues at the learning rates where it ended, without
    growth. A finished run that is resumed may get further ones."""

    name: ClassVar[str] = ""
    """Name on the command line."""
    version: ClassVar[int] = 1
    """Version of the method. Raise it when the same options train another model."""

    def __post_init__(self) -> None:
        """Convert the memory budget to a number of MB, and a list of iterations to a tuple."""
        object.__setattr__(self, "memory_budget", megabytes_of(self.memory_budget))
        if isinstance(self.more, list):  # A list equals no tuple.
            object.__setattr__(self, "more", tuple(self.more))

    @property
    def background_color(self) -> Color:
        """Background of its models, and of what events on the host render, RGB in [0, 1]; black where training takes
        random ones."""
        return WHITE if self.background == "white" else BLACK

    @property
    def initial_sh_degree(self) -> int:
        """Degree of spherical harmonics of the Gaussians that training starts from."""
        return self.sh_degree

    @property
    def initial_bytes(self) -> float:
        """Bytes of a Gaussian that training starts from, with its appearance in the first stage."""
        return bytes_per_gaussian(self.initial_sh_degree, self.stages()[0].floats_shown)

    @property
    def budget_bytes(self) -> int | None:
        """Memory budget in bytes; None without one."""
        return budget_in_bytes(self.memory_budget, "memory_budget")

    @property
    def small_budget(self) -> str:
        """Number of Gaussians that fit into the memory budget, in words, if they are few; else empty."""
        if self.budget_bytes is None:
            return ""
        size = self.initial_bytes
        shared = self.stages()[0].shared_bytes
        left = self.budget_bytes - shared
        if left >= FEW_GAUSSIANS * size:
            return ""
        sensible = in_bytes(SENSIBLE_GAUSSIANS * size + shared).replace(" ", "")
        return (
            f"memory_budget has room for {max(0, int(left // size))} Gaussians of {size:,.0f} bytes, and scenes "
            f"need thousands: {sensible} holds {SENSIBLE_GAUSSIANS:,}"
        )

    def budget_cap(self, floats: float = 0, shared: int = 0) -> int | None:
        """Return the number of Gaussians that the memory budget has room for; None without a budget.

        Args:
          floats: further floats of each finished Gaussian, such as its texels.
          shared: floats that all Gaussians share, such as the weights of a network.

        Raises:
          ValueError: if there are fewer than 2, or fewer than initial Gaussians.
        """
        if self.budget_bytes is None:
            return None
        needed = bytes_per_gaussian(self.initial_sh_degree, floats)
        cap = max(0, int((self.budget_bytes - BYTES_PER_FLOAT * shared) // needed))
        has_room = f"memory_budget of {self.memory_budget} MB has room for {cap:,} Gaussians of {needed:,.0f} bytes"
        if cap < 2:
            raise ValueError(f"{has_room}, and there must be 2: raise memory_budget")
        if self.initial_gaussians is not None and self.initial_gaussians > cap:
            raise ValueError(
                f"{has_room}, fewer than training starts from: raise memory_budget, or lower initial_gaussians, "
                f"which is {self.initial_gaussians:,}"
            )
        return cap

    def corrections_of(self, stage: int = 0) -> tuple[Correction, ...]:
        """Return the corrections of a stage that `exposure` and `refine_poses` turn on.

        Args:
          stage: index of the stage, from 0; later stages keep the rates of the first one's end.
        """
        chosen: list[Exposure | BilateralGrid | PoseRefinement] = []
        if self.refine_poses:
            chosen.append(self.corrections.pose)
        if self.exposure:
            chosen.append(self.corrections.affine)
        if self.exposure and self.corrections.exposure_kind == "grid":
            chosen.append(self.corrections.grid)
        if stage:
            chosen = [
                dataclasses.replace(part, rate=part.rate * part.final_factor, final_factor=1.0) for part in chosen
            ]
        return tuple(chosen)

    def stages(self) -> tuple[Stage, ...]:
        """Return the stages, in the order of training.

        Raises:
          ValueError: if options contradict each other.
        """
        raise NotImplementedError(f"{type(self).__name__} must compose its stages")

    def all_stages(self) -> tuple[Stage, ...]:
        """Return the stages, and the further ones of `more`, in which the last one continues.

        They keep the last stage's events of every iteration, such as noise; the others have happened.
        """
        stages = self.stages()
        if not self.more:
            return stages
        last = stages[-1]
        further = dataclasses.replace(
            last, events=last.lasting_events, raises_sh_degree=False, num_coarse=0, continues=True
        )
        names = ["more", *(f"more-{number}" for number in range(2, len(self.more) + 1))]
        pairs = zip(names, self.more, strict=True)
        return (*stages, *(dataclasses.replace(further, name=name, iterations=length) for name, length in pairs))

    @classmethod
    def preset(cls, name: str, **options: object) -> Self:
        """Return the options of a preset, some of them changed.

            A2tg.preset("quick", stage1_iterations=10, texture={"cap": 8})

        Args:
          name: "paper", "quick", "smoke", or another that the system has.
          **options: other values of options; a group's as a dictionary.

        Raises:
          ValueError: if there is no such preset, or an option is unknown or of another type.
        """
        presets = cls.presets()
        if name not in presets:
            raise ValueError(
                f"{cls.name or cls.__name__} has the presets {', '.join(presets)}; got {shortened(name)!r}"
                f"{did_you_mean(name, presets)}"
            )
        return changed_config(presets[name], options, cls.__name__) if options else presets[name]

    @classmethod
    def presets(cls) -> dict[str, Self]:
        """Return all presets by name; "paper" has the fields' defaults."""
        return {"paper": cls()}

    def check(self) -> None:
        """Check all options before training.

        Raises:
          ValueError: beginning with the path of the option, then the wanted and the given value.
        """
        self.check_options()
        self._check_stages()

    def check_options(self) -> None:
        """Check types and ranges of options; each group with a method `check_options`, such as an event, checks its
        own. Extend this method for further options.

        Raises:
          ValueError: beginning with the path of the option.
        """
        check_config(self)
        for name, value in flatten_config(self).items():
            # Types were checked; infinity and NaN are floats too.
            values = value if isinstance(value, tuple) else (value,)
            if not all(math.isfinite(number) for number in values if isinstance(number, float)):
                wanted = "finite numbers" if isinstance(value, tuple) else "a finite number"
                raise ValueError(f"{name} must be {wanted}; got {shortened(value)}")
        check_groups(self)
        check_fields(self, "batch_size", least=1)
        check_fields(self, "initial_gaussians", least=2)
        check_fields(self, "initial_opacity", above=0, below=1)
        check_fields(self, "sh_degree", least=0, most=3)
        check_int("seed", self.seed, 0, 2**31 - 1)
        check_fields(self, "tile_size", least=1, most=MAX_TILE_SIZE)
        for iterations in self.more:
            check_number("more", iterations, least=1)

    def _check_stages(self) -> None:
        stages = self.stages()
        if not isinstance(stages, tuple | list) or not all(isinstance(stage, Stage) for stage in stages):
            raise ValueError(f"{type(self).__name__}.stages must return a tuple of stages; got {shortened(stages)}")
        if not stages:
            raise ValueError(f"{type(self).__name__} has no stages")
        names = [stage.name for stage in self.all_stages()]
        if len(set(names)) < len(names):
            raise ValueError(f"the stages of {type(self).__name__} must have different names; got {', '.join(names)}")
        for stage in self.all_stages():
            stage.check()
        for before, stage in zip([None, *stages], stages, strict=False):
            if stage.continues and (before is None or _kept_parts(before) != _kept_parts(stage)):
                raise ValueError(
                    f"stage {stage.name!r}: continues needs a stage before, of the same appearance and corrections"
                )
        # Corrections that would do nothing.
        if self.corrections.exposure_kind != "affine" and not self.exposure:
            raise ValueError(
                f"corrections.exposure_kind is {self.corrections.exposure_kind!r}, but nothing is learned of it: "
                "turn exposure on"
            )
        if (self.exposure or self.refine_poses) and not any(stage.corrections for stage in stages):
            name = "exposure" if self.exposure else "refine_poses"
            raise ValueError(
                f"{name} is on, but no stage of {type(self).__name__} learns it: compose its stages with "
                "corrections=self.corrections_of(0), (1), …"
            )

    def path_of(self, event: Event) -> str:
        """Return the path of the option that an event of a stage was made from, such as "densify"; the name of the
        event's class if there is none."""
        for field in dataclasses.fields(self):
            group = getattr(self, field.name)
            if isinstance(group, Event) and isinstance(event, type(group)):
                return field.name
        return type(event).__name__

    def more_growth(self) -> str:
        """Return the names of the options to raise for more Gaussians, for advice."""
        return " or ".join(name for name in ("stage1_iterations", "initial_gaussians") if hasattr(self, name))

    def caps(self) -> tuple[str, ...]:
        """Return the paths of the options that limit the number of Gaussians without a memory budget."""
        events = [event for stage in self.stages() for event in stage.events if event.limited_by]
        paths = dict.fromkeys(f"{self.path_of(event)}.{event.limited_by}" for event in events)
        # The path of an event that is no option is its class's name, which is no option either.
        return tuple(path for path in paths if path in flatten_config(self))

    def limits(self) -> tuple[str, ...]:
        """Return the paths of the options that limit the number of Gaussians, for advice."""
        if self.memory_budget is not None:
            return ("memory_budget",)
        return self.caps() or ("initial_gaussians",)

    def check_initial_number(self, num: int) -> None:
        """Check the options for a number of Gaussians at the start.

        Raises:
          ValueError: naming the option, the wanted and the given value.
        """

    def check_given_number(self, num: int) -> None:
        """Check the options for Gaussians from a file instead of the first stage; the memory budget must have room for
        them, with their appearance at the beginning of each stage.

        Raises:
          ValueError: naming the option.
        """
        self.check_initial_number(num)
        if self.budget_bytes is None:
            return
        for stage in self.stages():
            size = bytes_per_gaussian(self.initial_sh_degree, stage.floats_shown)
            left = self.budget_bytes - stage.shared_bytes
            if num * size > left:
                raise ValueError(
                    f"memory_budget of {self.memory_budget} MB has room for {max(0, int(left // size)):,} "
                    f"Gaussians of {size:,.0f} bytes when the stage {stage.name!r} begins, and {num:,} are given: "
                    "raise it, leave it out, or give fewer"
                )


def _kept_parts(stage: Stage) -> tuple[object, ...]:
    """Return what a stage and one that continues it have in common."""
    return stage.appearance, [correction.name for correction in stage.corrections]


def like(kind: Any, other: object) -> Any:
    """Return a system, or a group of options, with the options of another that have the same name and type.

    Args:
      kind: system or its class, which gives all other options.
      other: the other system.

    Returns:
      The system or group of class `kind`.
    """
    config = kind() if isinstance(kind, type) else kind
    hints = typing.get_type_hints(type(config))
    other_hints = typing.get_type_hints(type(other))
    changes = {}
    for field in dataclasses.fields(config):
        option = getattr(config, field.name)
        other_option = getattr(other, field.name, None)
        if dataclasses.is_dataclass(option) and dataclasses.is_dataclass(other_option):
            changes[field.name] = like(option, other_option)
        # The same name with another type means something else.
        elif hints[field.name] == other_hints.get(field.name):
            changes[field.name] = other_option
    return dataclasses.replace(config, **changes)


def own_options(system: object, other: object) -> dict[str, Any]:
    """Return the options of a system, or of a group, that another one lacks or has with another value, nested as in a
    configuration file."""
    hints = typing.get_type_hints(type(system))
    other_hints = typing.get_type_hints(type(other))
    differing: dict[str, Any] = {}
    for name, value in config_to_dict(system).items():
        option = getattr(system, name)
        other_option = getattr(other, name, None)
        if dataclasses.is_dataclass(option) and dataclasses.is_dataclass(other_option):
            inner = own_options(option, other_option)
            differing |= {name: inner} if inner else {}
        elif hints[name] != other_hints.get(name) or option != other_option:
            differing[name] = value
    return differing
