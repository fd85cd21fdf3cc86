"""A stage: an appearance, events, loss terms, learning rates and a length. A system is a sequence of stages."""

import bisect
import functools
import inspect
import math
import numbers
import re
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance, allocate_appearance, count_floats
from a2tg_jax.appearance.base import check_appearance
from a2tg_jax.base.checks import check_fields, check_kind, check_number, fields_of, kind_of
from a2tg_jax.base.config_json import check_config
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import shortened
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.gaussians import Gaussians, no_rows
from a2tg_jax.core.pytree import beside, check_pytree, pytree, static
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.events import Event, HostEvent, StepEvent, Times
from a2tg_jax.model import Model
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.scene import View
from a2tg_jax.training.corrections import Correction
from a2tg_jax.training.losses import SSIM_WINDOW
from a2tg_jax.training.returned import calling
from a2tg_jax.training.terms import Target


@pytree
class LearningRates(NamedFields):
    """Adam's learning rates of the Gaussians."""

    means: float = 1.6e-4
    """Learning rate of the means, times scene_scale; decays exponentially over each stage."""
    means_final_factor: float = 0.01
    """Factor of the means' learning rate at the end of a stage."""
    log_scales: float = 5e-3
    """Learning rate of the logarithms of the scales."""
    quats: float = 1e-3
    """Learning rate of the rotations."""
    logit_opacities: float = 5e-2
    """Learning rate of the logits of the opacities."""
    sh_degree0: float = 2.5e-3
    """Learning rate of the colours, the spherical harmonics of degree 0."""
    sh_rest: float = 1.25e-4
    """Learning rate of the other spherical harmonics."""

    def check_options(self) -> None:
        """Raise ValueError, beginning with the name of the field, if a rate is out of range."""
        check_fields(self, least=0)
        check_fields(self, "means_final_factor", above=0)  # The decay is exponential.

    def of_gaussians(self, means: Array, sh_degree: int = 3) -> Gaussians:
        """Return one rate per field of the Gaussians, which broadcasts against it.

        Args:
          means: present rate of the means, a scalar.
          sh_degree: degree of spherical harmonics of the Gaussians, 0 to 3.
        """
        # [1, K, 1] broadcasts against [N, K, 3].
        sh = jnp.full((1, NUM_BASES[sh_degree], 1), self.sh_rest).at[:, 0].set(self.sh_degree0)
        fields: Any = (means, self.quats, self.log_scales, self.logit_opacities, sh)
        return Gaussians(*fields)


T = TypeVar("T")
COOLED = 0.1
"""Factor of learning rates at the end of a stage that cools down."""
Background = Literal["black", "white", "random"]
"""Background of the views while a stage is trained."""


class LossTerm(Protocol):
    """A part of the loss, a pytree of its numbers.

    One that reads the render's depth, normal or distortion has `has_geometry = True`; one that reads the depth maps of
    the photographs has `has_depths = True`. The history records it by its `name`, or its class's. A term of several
    summands may have a method `parts` with the same arguments, which returns them by name.
    """

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        """Its value, the weight included."""
        ...


@pytree
class Stage(NamedFields):
    """A part of training with one appearance, one loss and one schedule. A pytree: its numbers are traced."""

    name: str = beside()
    """A short word, unique in its system. Steps do not depend on it, so that stages that differ in nothing else share
    one program."""
    appearance: Appearance = static()
    """Template of what the splats show: an appearance without arrays, such as `Appearance(texture=Texture())`."""
    events: tuple[Event, ...]
    """Events such as densification, noise and texture growth, in order of application."""
    losses: tuple[LossTerm, ...]
    """Loss terms; their sum is minimised."""
    rates: LearningRates
    """Learning rates of the Gaussians."""
    iterations: int
    """Number of steps; each sees `batch_size` views."""
    appearance_rate: Any = None
    """Learning rate of the appearance's arrays: a number for all, or a mapping by field (`Appearance.rates`); 0: they
    stay unchanged. None: the appearance has no arrays."""
    corrections: tuple[Correction, ...] = ()
    """Corrections of each training view, such as exposures and poses."""
    raises_sh_degree: bool = static(default=False)
    """Whether the stage begins with degree 0 and adds one after every thirtieth of its length."""
    cools_down: bool = static(default=False)
    """Whether all learning rates also fall linearly over the stage, to a tenth at its end."""
    continues: bool = static(default=False)
    """Whether this stage continues the one before: it begins with its last state, Adam's moments included, and all
    schedules, such as learning rates, stay at their end."""
    num_coarse: int = beside(default=0)
    """Number of first iterations with photographs of half the width and height (`Photographs.halved`)."""

    @property
    def statistic(self) -> Statistic | None:
        """Gradient statistic that the events need, or None."""
        return next((event.statistic for event in self.events if event.statistic is not None), None)

    @property
    def has_geometry(self) -> bool:
        """Whether a loss term reads depth, normal or distortion of the render."""
        return any(getattr(term, "has_geometry", False) for term in self.losses)

    @property
    def has_ssim(self) -> bool:
        """Whether a loss term compares by SSIM, which needs pictures as large as its window (host)."""
        return any(getattr(term, "has_ssim", False) for term in self.losses)

    @property
    def has_depths(self) -> bool:
        """Whether a loss term reads the depth maps of the photographs (`Target.depth`)."""
        return any(getattr(term, "has_depths", False) for term in self.losses)

    def check_views(self, views: Sequence[View]) -> None:
        """Raise ValueError if the losses read depth maps and no view has one, or if a view is too small for SSIM."""
        for view in views if self.has_ssim else ():
            if min(view.picture.size) < SSIM_WINDOW:
                height, width = view.picture.size
                raise ValueError(
                    f"view {view.name} has {width} by {height} pixels, but the loss has SSIM, which needs "
                    f"{SSIM_WINDOW} by {SSIM_WINDOW}: take larger photographs, or set loss.ssim_weight to 0"
                )
        if self.has_depths and all(view.depth is None for view in views):
            raise ValueError(
                "loss.depth_weight, or a custom term, needs depth maps, but no training view has one: put them as "
                "NAME.npy or NAME.png into the folder depths next to images, or leave it out"
            )

    @functools.cached_property
    def _appearance_of_two(self) -> Appearance:
        """Appearance of two Gaussians when the stage begins (host)."""
        return allocate_appearance(self.appearance, jax.random.key(0), no_rows(2, 1))

    @property
    def floats_shown(self) -> float:
        """Floats of appearance that a Gaussian has when the stage begins (host)."""
        return (count_floats(self._appearance_of_two, 2) - count_floats(self._appearance_of_two, 0)) / 2

    @property
    def shared_bytes(self) -> int:
        """Bytes of what the Gaussians share (host)."""
        return BYTES_PER_FLOAT * count_floats(self._appearance_of_two, 0)

    @functools.cached_property
    def times(self) -> tuple[Times, ...]:
        """Iterations after which each event happens (host)."""
        # Events may compute them by JAX, and a checkpoint is read while shapes are traced.
        with jax.ensure_compile_time_eval():
            return tuple(event.times(self.iterations) for event in self.events)

    def check(self) -> None:
        """Check all fields.

        Raises:
          ValueError: naming the option, the wanted and the given value.
        """
        self._check_kinds()
        if not re.fullmatch(r"[A-Za-z0-9_-]+", self.name):
            raise ValueError(
                f"a stage's name must be letters, digits, - and _, because it names files; got {self.name!r}"
            )
        where = f"stage {self.name!r}:"
        if not isinstance(self.iterations, int | np.integer):
            raise ValueError(f"{where} iterations must be an integer; got {self.iterations!r}")
        if not 1 <= self.iterations < 2**31:  # counted as int32 in the step
            raise ValueError(
                f"a stage must have at least 1 iteration, and fewer than 2^31; {self.name!r} has {self.iterations}"
            )
        kinds = sorted({event.statistic for event in self.events if event.statistic is not None})
        if len(kinds) > 1:
            raise ValueError(f"the events of one stage must use one statistic; the events of {self.name!r} use {kinds}")
        parts: list[tuple[str, Any]] = [("rates", self.rates)]
        parts += [(type(part).__name__, part) for part in (*self.events, *self.corrections)]
        for name, part in parts:
            with fields_of(f"{where} {name}"):
                check_config(part)
                part.check_options()
        for event in self.events:
            name = f"{where} {type(event).__name__}"
            with calling(event, "times", self.name):
                times = event.times(self.iterations)
            is_ascending = isinstance(times, range) and times.step > 0
            if isinstance(times, tuple | list) and all(isinstance(time, int | np.integer) for time in times):
                is_ascending = list(times) == sorted(set(times))
            if not is_ascending:
                raise ValueError(
                    f"{name}.times must return ascending integers, as a range or a tuple; got {shortened(times)}"
                )
        names = [correction.name for correction in self.corrections]
        if len(set(names)) < len(names):
            raise ValueError(f"the corrections of {self.name!r} must have different names; got {', '.join(names)}")

    def _check_kinds(self) -> None:
        """Check the types of all fields."""
        check_kind("name of a stage", self.name, str)
        where = f"stage {self.name!r}:"
        check_kind(f"{where} appearance", self.appearance, Appearance)
        check_kind(f"{where} rates", self.rates, LearningRates)
        kinds: dict[str, tuple[type, ...]] = {
            "events": (StepEvent, HostEvent), "losses": (), "corrections": (Correction,),
        }  # fmt: skip
        for name, kind in kinds.items():
            parts: Any = getattr(self, name)
            check_kind(f"{where} {name}", parts, (tuple, list), "wrap a single one: (…,)")
            for index, part in enumerate(parts):
                label = f"{where} {name}[{index}]"
                is_function = inspect.isroutine(part)
                if kind:
                    check_kind(label, part, kind)
                elif isinstance(part, type) or is_function or not callable(part):
                    hint = f": use Term({part.__name__})" if is_function else ""
                    raise ValueError(f"{label} must be a loss term, such as Term(function); got {kind_of(part)}{hint}")
                check_pytree(label, part)
                for leaf in jax.tree.leaves(part):
                    if not isinstance(leaf, numbers.Number | np.ndarray | np.generic | jax.Array):
                        raise ValueError(
                            f"{label} must hold numbers; got {leaf!r}: make fields of {type(part).__name__} that hold "
                            "other static()"
                        )
        check_pytree(f"{where} appearance", self.appearance)
        # Two rows are enough to learn whether there are arrays, and whether they have rows.
        check_appearance(self._appearance_of_two, no_rows(2, 1))
        for rate in jax.tree.leaves(self.appearance_rate):
            check_number(f"{where} appearance_rate", rate, least=0.0)
        if self.appearance_rate is None and jax.tree.leaves(self._appearance_of_two):
            raise ValueError(
                f"{where} appearance_rate must be the learning rate of the arrays of {self.appearance.description}, "
                "such as 1e-2, or 0 if they are to stay unchanged; got none"
            )
        if not self.losses:
            raise ValueError(f"{where} losses must have a term, such as Term(function)")

    def cooled(self, rates: T, progress: Array) -> T:
        """Return learning rates, a pytree, at a share of the stage; traced."""
        if not self.cools_down:
            return rates
        factor = 1 - (1 - COOLED) * progress
        return jax.tree.map(lambda rate: rate * factor.astype(jnp.result_type(rate, float)), rates)

    @property
    def lasting_events(self) -> tuple[Event, ...]:
        """Events that happen after every iteration, such as noise (host)."""
        return tuple(event for event, times in zip(self.events, self.times, strict=True) if self._are_all(times))

    def _are_all(self, times: Times) -> bool:
        """Return whether times, which ascend, are all iterations."""
        return len(times) == self.iterations and times[0] == 1 and times[-1] == self.iterations

    def clock(self, iteration: int, largest_loss: float = math.inf, stride: int = 1) -> "Clock":
        """Return the schedule of an iteration, whose step is not taken if its loss exceeds the largest. The step counts
        as `stride` iterations, of which this is the last (host)."""
        num_left: list[int | None] = []
        for event, times in zip(self.events, self.times, strict=True):
            # An event of every iteration needs no condition in the step.
            if not isinstance(event, StepEvent) or self._are_all(times):
                num_left.append(None)
                continue
            num_past = bisect.bisect_right(times, iteration)
            is_due = num_past > bisect.bisect_right(times, iteration - stride)
            num_left.append(len(times) - num_past + 1 if is_due else 0)
        return Clock(
            stride=stride,
            num_iterations=self.iterations,
            done=self.iterations if self.continues else 0,
            per_iteration=1.0 / self.iterations,
            log_decay=math.log(self.rates.means_final_factor),
            sh_interval=max(1, round(self.iterations / 30)),  # 1,000 of 30,000 iterations in 3DGS
            num_left=tuple(num_left),
            largest_loss=largest_loss,
        )


class Clock(NamedTuple):
    """The schedule of a stage at an iteration as numbers, traced in the step."""

    stride: int
    """Number of iterations that the step counts as."""
    num_iterations: int
    done: int
    """Iterations of the schedules that are over when the stage begins: none, or all of them."""
    per_iteration: float
    """1 / num_iterations."""
    log_decay: float
    """Logarithm of the means' final factor."""
    sh_interval: int
    """Iterations between two degrees."""
    num_left: tuple[int | None, ...]
    """Number of times at which each event still happens, if it is due after this iteration, otherwise 0; None if it
    happens after every iteration, or on the host."""
    largest_loss: float = math.inf
    """Largest loss; the step is not taken beyond it."""

    def scheduled(self, iteration: Array) -> Array:
        """Return the iteration of the schedules at an iteration of the stage; traced."""
        return jnp.minimum(iteration + self.done, self.num_iterations)

    def progress(self, iteration: Array) -> Array:
        """Return the share of the schedules that is over after a number of finished iterations; traced."""
        return jnp.clip(jnp.asarray(iteration + self.done, jnp.result_type(float)) * self.per_iteration, 0.0, 1.0)
