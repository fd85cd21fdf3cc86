"""Events: what changes a model between steps, such as densification, noise, or textures that grow.

An event is a frozen dataclass registered as a pytree. Its numbers (thresholds, weights) are leaves and reach the step
as traced arguments, so that other values recompile nothing; fields that choose shapes or code are `static()`. An event
either happens inside the step, at fixed shapes (`StepEvent`), or between steps on the host, where shapes may change
(`HostEvent`). Either may gather a statistic of the gradients until it is past.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from a2tg_jax.appearance.base import clear_rows
from a2tg_jax.base.checks import check_floats, check_mask, check_shape
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import shortened
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.numerics import safe_divide, safe_norm
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.origin import BLACK, Color
from a2tg_jax.core.pytree import combine, partition, pytree
from a2tg_jax.core.table import Layout, map_rows, rows_moved
from a2tg_jax.model import Model
from a2tg_jax.rasterize.pixel import Statistic as Statistic
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.room import TileRoom, most_pairs
from a2tg_jax.scene import View

LEAST_LEFT = 2
"""Smallest number of Gaussians that training needs."""


Times = Sequence[int]
"""Iterations of a stage after which an event happens, from 1, ascending: a range or a tuple."""


def times_at(fractions: tuple[float, ...], num_iterations: int, *, with_end: bool = False) -> Times:
    """Return the times at fractions of a stage; in a short stage two of them may be one (host).

    The last fraction of the event's field `at` may be 1, the end of the stage, if `with_end`.

    Raises:
      ValueError: if the fractions are not ascending or out of range.
    """
    is_inside = all(0 < fraction < 1 or (with_end and fraction == 1) for fraction in fractions)
    if not is_inside or list(fractions) != sorted(set(fractions)):
        limits = "above 0, up to 1" if with_end else "between 0 and 1"
        raise ValueError(f"at must be ascending fractions {limits}; got {shortened(fractions)}")
    # Iterations count from 1: at 0 the event would never happen.
    return tuple(dict.fromkeys(max(1, round(fraction * num_iterations)) for fraction in fractions))


def multiples(every: int, first: int, last: int) -> Times:
    """Return the multiples of a number of iterations from `first`, which is at least 1, to `last`, both included."""
    return range(-(-first // every) * every, last + 1, every)


class Seen(NamedTuple):
    """Views of one iteration, for events; V views, N rows."""

    cameras: Camera
    """V cameras, stacked."""
    gradients: Array
    """[V, N, 3] the event's statistic (`view_gradients`), on the screen in units of half an image; 0 where a
    Gaussian was not seen."""
    is_visible: Array
    """[V, N] whether the Gaussian was composited at one pixel at least."""
    colors: Array
    """[V, N, 3] gradients by the colour of each Gaussian in the view."""


class Now(NamedTuple):
    """Information for an event inside the step, all traced."""

    keys: Array
    """[num_keys] random keys."""
    iteration: Array
    """Iteration just done, from 1; in a stage that `continues` the one before, always the last."""
    rate_of_means: Array
    """Learning rate of the means, in world units."""
    num_iterations: Array
    """Length of the stage."""
    scene_scale: Array
    """1.1 × the largest distance of a camera from the cameras' mean."""
    num_left: Array | None = None
    """Number of times at which the event still happens, this one included; None if it happens after every iteration."""


@dataclasses.dataclass(frozen=True)
class Due(NamedFields):
    """Information for an event on the host."""

    index: int = 1
    """Number of this time among the event's times in the stage, from 1."""
    count: int = 1
    """Number of the event's times in the stage."""
    views: Sequence[View] = ()
    """Training views, with the cameras that the scene gives."""
    background: Color = BLACK
    """Background of the views, RGB in [0, 1]; black where training takes random ones."""
    seed: int = 0
    """Random seed of the system, for draws of the event."""
    layouts: set[Layout] = dataclasses.field(default_factory=set)
    """Layouts of textures that steps are compiled for; an event adds the one that it makes."""
    room: TileRoom = dataclasses.field(default_factory=TileRoom)
    """Capacities of tile lists that steps are compiled for."""

    def render_settings(self, model: Model, views: Sequence[View]) -> RenderSettings:
        """Return settings for renders of some views, with the capacity of steps if it suffices (host). ValueError:
        there are no views."""
        if not views:
            raise ValueError("views must hold at least one view; got none")
        settings = RenderSettings()
        cameras = [view.camera for view in views]
        pairs = most_pairs(model.gaussians, cameras, model.appearance, settings, model.num_live)
        # As in the training loop.
        place = model.appearance.template, model.num_rows, *max(view.picture.size for view in views)
        return dataclasses.replace(settings, capacity=self.room.plan(place, pairs, most=math.inf))


class EventInfo(NamedTuple):
    """Outcome of an event inside the step, traced."""

    is_possible: Any = True
    """False: training cannot continue (`StepEvent.impossible` says why), and the step is not taken."""
    num_refused: Any = 0
    """Number of Gaussians that found no room."""


class Change(NamedTuple):
    """Result of an event."""

    model: Model
    """The model after the event."""
    moments: AdamState
    """Adam's moments of the model's floats."""
    state: Any
    """State of the event, as `init` makes and `observe` updates it."""
    info: EventInfo = EventInfo()
    """Whether training can continue, and how many Gaussians found no room."""
    rows: np.ndarray | None = None
    """[N] integers if an event on the host has moved rows, so that row i is the former row rows[i]; None: it has not.
    Model, moments and state are in the new order; training moves the statistics of other events along."""
    unused: str | None = None
    """Sentence that a field of an event on the host, with whose name it begins, made no difference this time, or None.
    You are warned if the field made none in the whole stage."""


class Event(NamedFields):
    """Base class of both kinds of event.

    Where several devices train together, an event on the host, `init` and `gather` get whole arrays on one device.
    """

    limited_by: ClassVar[str] = ""
    """Field that bounds the number of Gaussians, such as "cap": training starts from at most that many, and messages
    name it."""

    def times(self, num_iterations: int) -> Times:
        """Return the iterations of a stage of `num_iterations` after which the event happens, ascending: a range or a
        tuple, such as `range(100, num_iterations // 2, 100)` (host)."""
        raise NotImplementedError(f"{type(self).__name__} must define times(num_iterations)")

    def check_options(self) -> None:
        """Check the ranges of the fields (host). A stage calls it, and a system whose option the event is.

        Raises:
          ValueError: beginning with the name of the field, such as "cap must be at least 2; got 1".
        """

    @property
    def statistic(self) -> Statistic | None:
        """Statistic of the gradients that `observe` needs; None: none."""
        return None

    @property
    def observes(self) -> bool:
        """Whether `observe` is called. `Seen.gradients` and `is_visible` are zeros if no event of the stage gathers a
        statistic."""
        return self.statistic is not None

    def init(self, model: Model) -> Any:
        """Return the state that `observe` starts from, a pytree of arrays; by default `GradientStatistics` if the event
        has a statistic, otherwise ().

        It is not moved when another event moves rows inside the step: keep numbers per row only in stages without such
        events. When rows move on the host, `gather` moves it.
        """
        if self.statistic is None:
            return ()
        return GradientStatistics.init(model.num_rows, model.gaussians.means.dtype)

    def gather(self, state: Any, rows: np.ndarray) -> Any:
        """Return the state whose row i is the former row rows[i] (host). Rows of removed Gaussians then begin as `init`
        makes them, unless you override this method.

        Raises:
          ValueError: by default, if an array that is no field of `shared` does not have a row for each Gaussian.
        """

        def moved(leaf: Array) -> Array:
            if leaf.ndim and leaf.shape[0] != len(rows):
                raise ValueError(
                    f"{type(self).__name__} has gathered an array {[*leaf.shape]}, without a row for each of the "
                    f"{len(rows):,} Gaussians, and rows have moved: override gather, or declare the field "
                    "a2tg_jax.shared()"
                )
            return rows_moved(leaf, rows) if leaf.ndim else leaf

        return map_rows(moved, lambda table: table.gather(rows), state)

    def observe(self, state: Any, model: Model, seen: Seen) -> Any:
        """Return the state after the views of an iteration; traced, and called while the event is still ahead."""
        return state.observe_views(seen.gradients, seen.is_visible) if isinstance(state, GradientStatistics) else state

    @property
    def most_gaussians(self) -> int | None:
        """Largest number of Gaussians that training may start from; by default the field `limited_by`, or None for any
        number."""
        return getattr(self, self.limited_by) if self.limited_by else None

    def num_rows(self, num: int, num_iterations: int) -> int:
        """Return the number of Gaussians that the event can reach from `num`, and of allocated rows (host)."""
        return num

    def num_after(self, num: int, num_iterations: int) -> int:
        """Return the largest number of Gaussians at the end of the stage, of `num`, for forecasts (host)."""
        return num

    def most_bytes(self, num_bytes: float, num: int, num_iterations: int) -> float:
        """Return the approximate bytes of a model of `num` Gaussians after the event, for forecasts (host)."""
        return num_bytes


class StepEvent(Event):
    """Event inside the step, at fixed shapes."""

    num_keys: ClassVar[int] = 1
    """Random keys that `apply` uses."""
    impossible: ClassVar[str] = ""
    """Reason why training cannot continue if `EventInfo.is_possible` is False, in terms of the event's fields."""

    def times(self, num_iterations: int) -> Times:
        """Return the iterations after which the event happens; by default all (host)."""
        return range(1, num_iterations + 1)

    def apply(self, now: Now, model: Model, moments: AdamState, state: Any) -> Change:
        """Return the model after the event; traced."""
        raise NotImplementedError(f"{type(self).__name__} must define apply(now, model, moments, state)")


class HostEvent(Event):
    """Event between steps on the host, where values may be read and shapes may change."""

    def num_programs(self, num_iterations: int) -> int:
        """Return roughly how many programs are compiled because of it, for forecasts (host).

        The default is one each time before the end of the stage. Override it if shapes stay (`keep_rows`).
        """
        # After the last iteration there is no step to compile.
        return sum(1 <= iteration < num_iterations for iteration in self.times(num_iterations))

    def with_room(
        self, model: Model, moments: AdamState, num_bytes: float, num_iterations: int
    ) -> tuple[Model, AdamState]:
        """Return model and moments with padding that the event will fill, so that its changes keep all shapes and no
        step is compiled again (host). The default adds none.

        It is called when the stage begins or resumes; the model has about `num_bytes` when the event first happens.
        """
        return model, moments

    def apply(self, due: Due, model: Model, moments: AdamState, state: Any) -> Change:
        """Return the model after the event (host)."""
        raise NotImplementedError(f"{type(self).__name__} must define apply(due, model, moments, state)")


class FractionsEvent(HostEvent):
    """Base class of events on the host at fractions of a stage, which keep the number of rows."""

    at: tuple[float, ...]
    with_end: ClassVar[bool] = False
    """Whether the last fraction may be 1, the end of the stage."""

    def check_options(self) -> None:
        self.times(1)  # checks `at`

    def times(self, num_iterations: int) -> Times:
        return times_at(self.at, num_iterations, with_end=self.with_end)

    def num_programs(self, num_iterations: int) -> int:
        return 2  # Tile lists grow with the Gaussians.


def keep_rows(model: Model, moments: AdamState, state: object, is_kept: Array | np.ndarray) -> Change:
    """Return the change by an event on the host that removes Gaussians, so that no step is compiled again (host).

    All shapes stay: the rows of the Gaussians that are kept come first, in their order, and `Model.num_live` falls.

    Args:
      model: as given to `HostEvent.apply`.
      moments: as given to `HostEvent.apply`.
      state: state of the event.
      is_kept: mask of the Gaussians that stay, [num] bool for those that exist (`Model.num`), or [N] for all rows, such
        as `model.gaussians.opacities > 0.01`.

    Returns:
      The change, for `HostEvent.apply` to return.

    Raises:
      ValueError: if it is no such mask or keeps fewer than 2, or if textures or view dependence have blocks of several
        sizes.
    """
    num = model.num
    rows = np.arange(model.num_rows, dtype=np.int32)
    is_kept = np.asarray(is_kept)
    check_mask("is_kept", is_kept, (len(rows) if is_kept.shape == rows.shape else num,))
    is_kept = is_kept[:num]
    num_kept = int(is_kept.sum())
    if num_kept < LEAST_LEFT:
        raise ValueError(f"is_kept must keep at least {LEAST_LEFT} Gaussians; got {num_kept} of {num:,}")
    # Removed rows move to the end, where `num_live` excludes them, so that no shape changes.
    rows[:num] = np.concatenate([np.flatnonzero(is_kept), np.flatnonzero(~is_kept)])
    moments = gather_moments(moments, rows)
    num_live = jax.device_put(np.asarray(num_kept, np.int32))
    model = dataclasses.replace(gather_rows(model, rows), num_live=num_live)
    return Change(model, moments, state, rows=rows)


def gather_rows(model: Model, rows: Array | np.ndarray) -> Model:
    """Return the model whose row i is the former row rows[i], of all N."""
    gaussians, appearance = map_rows(
        lambda array: rows_moved(array, rows), lambda table: table.gather(rows), (model.gaussians, model.appearance)
    )
    return dataclasses.replace(model, gaussians=gaussians, appearance=appearance)


def gather_moments(moments: AdamState, rows: Array | np.ndarray) -> AdamState:
    """Return the moments whose row i is the former row rows[i], of all N."""
    return dataclasses.replace(moments, mu=gather_rows(moments.mu, rows), nu=gather_rows(moments.nu, rows))


def clear_moments(model: Model, moments: AdamState, is_cleared: Array) -> AdamState:
    """Return the moments with the marked rows [N] at zero."""
    _, rest = partition(model)

    def cleared(moment: Model) -> Model:
        # Tables find rows by their places, which are integers and so not in moments.
        whole = combine(moment, rest)
        gaussians, appearance = clear_rows((whole.gaussians, whole.appearance), is_cleared)
        floats, _ = partition(dataclasses.replace(whole, gaussians=gaussians, appearance=appearance))
        return floats

    return dataclasses.replace(moments, mu=cleared(moments.mu), nu=cleared(moments.nu))


# The average gradient of each Gaussian over the views that saw it, by which events choose where to add detail. A²TG
# averages ‖Σ_pixels |∂L/∂mean|‖ to choose what gets texels; adaptive density control averages the norm of the gradient
# of the projected mean to choose what is cloned or split.


def read_probe(at_probe: Array, statistic: str, width: int, height: int) -> tuple[Array, Array]:
    """Return the statistic of each Gaussian [..., N, 3], on the screen in units of half an image, and whether it was
    composited at one or more pixels [..., N].

    Args:
      at_probe: [..., N, 4] gradients at the probe of one view or several (`compositor.composite`).
      statistic: "position", in the world, or another one, on the screen.
      width, height: size of the views in pixels.
    """
    gradients = at_probe[..., :3]
    if statistic != "position":
        # Chain rule: ∂L/∂(x / (W/2)) = W/2·∂L/∂x.
        half = jnp.asarray([width / 2, height / 2, 1.0], at_probe.dtype)
        gradients = gradients * half.reshape((1,) * (at_probe.ndim - 1) + (3,))
    return gradients, at_probe[..., 3] > 0


@pytree
class GradientStatistics(NamedFields):
    """Sums from which each Gaussian's average gradient norm over views is computed."""

    total: Array
    """[N] sum of the norms since the last event."""
    views: Array
    """[N] int32 number of views in which the Gaussian was composited at one or more pixels."""

    @staticmethod
    def init(num: int, dtype: DTypeLike = jnp.float32) -> "GradientStatistics":
        """Return empty sums for `num` Gaussians."""
        return GradientStatistics(jnp.zeros((num,), dtype), jnp.zeros((num,), jnp.int32))

    def observe(self, norms: Array, is_visible: Array) -> "GradientStatistics":
        """Add one view: `norms` [N] where `is_visible` [N]."""
        check_floats("norms", norms, self.total.shape)
        check_shape("is_visible", is_visible, self.total.shape)
        total = self.total + jnp.where(is_visible, norms, 0.0)
        return GradientStatistics(total, self.views + is_visible.astype(jnp.int32))

    def observe_views(self, gradients: Array, is_visible: Array) -> "GradientStatistics":
        """Add V views in order: the norms of `gradients` [V, N, 3] where `is_visible` [V, N]."""
        state = self
        for gradient, is_seen in zip(gradients, is_visible, strict=True):
            state = state.observe(safe_norm(gradient), is_seen)
        return state

    def average(self) -> Array:
        """Return the average norm [N] over the views that saw the Gaussian; 0 if none did."""
        return safe_divide(self.total, self.views.astype(self.total.dtype))
