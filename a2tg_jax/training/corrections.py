"""Corrections: the exposure and the pose of each training photograph, learned together with the model.

A correction has one row of numbers for each training view. Inside the step it changes the camera of the render or the
rendered colours. The rows are part of the training state, not of the model. Like an event, a correction is a frozen
dataclass that is a pytree of its numbers. V views.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.base.checks import check_fields
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.cameras import Camera, moved_viewmat
from a2tg_jax.core.numerics import where_rows
from a2tg_jax.core.optim import AdamState, adam_init, adam_update
from a2tg_jax.core.origin import Origin
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.training.returned import check_kept, check_scalar


class Correction(NamedFields):
    """Base class of corrections; it changes nothing."""

    name: ClassVar[str]
    """Name, unique in its stage; files use it for the rows."""

    def check_options(self) -> None:
        """Check the ranges of the fields (host). A stage calls it.

        Raises:
          ValueError: beginning with the name of the field.
        """

    @property
    def neutral(self) -> np.ndarray:
        """The row that changes nothing."""
        raise NotImplementedError(f"{type(self).__name__} must define neutral, the row that changes nothing")

    def learning_rate(self, progress: Array) -> Array:
        """Return Adam's learning rate at a share of the stage between 0 and 1; traced."""
        raise NotImplementedError(f"{type(self).__name__} must define learning_rate(progress)")

    def camera(self, row: Array, camera: Camera) -> Camera:
        """Return the camera that the view is drawn from; traced."""
        return camera

    def color(self, row: Array, color: Array) -> Array:
        """Return the colours [H, W, 3] of the photograph for a render [H, W, 3]; traced."""
        return color

    def penalty(self, row: Array) -> Array | None:
        """Return what is added to the view's loss for its row, such as a smoothness; None: nothing. Traced."""
        return None

    def project(self, rows: Array) -> Array:
        """Return the rows of all views [V, ...], projected onto their allowed values after a step; traced."""
        return rows


class FadingCorrection(Correction):
    """Base class of corrections with a learning rate `rate` that falls by `final_factor` over a stage."""

    rate: float
    final_factor: float
    averages_neutral: ClassVar[bool] = False
    """Whether the rows are kept neutral on average over the views."""

    def check_options(self) -> None:
        check_fields(self, "rate", least=0)
        check_fields(self, "final_factor", above=0)  # The decay is exponential.

    def learning_rate(self, progress: Array) -> Array:
        return self.rate * self.final_factor**progress

    def project(self, rows: Array) -> Array:
        if not self.averages_neutral:
            return rows
        return rows - jnp.mean(rows, axis=0, keepdims=True) + jnp.asarray(self.neutral, rows.dtype)[None]


@pytree
class Exposure(FadingCorrection):
    """An affine map of colours per view, [3, 4], c ↦ A·c + b; on average over the views it changes nothing.

    A change shared by all views would only shift the model, and leave test views without an exposure.
    """

    rate: float = 1e-2
    """Adam's learning rate of the affine maps of colours."""
    final_factor: float = 0.1
    """Factor of the rate at the end of a stage; a system's later stages keep the rate of the first one's end."""

    name = "exposure"
    averages_neutral = True

    @property
    def neutral(self) -> np.ndarray:
        return np.eye(3, 4)

    def color(self, row: Array, color: Array) -> Array:
        return exposed(row, color)


@pytree
class PoseRefinement(FadingCorrection):
    """A small rigid motion per view, a twist [6] in the camera's frame (rotation vector, then translation).

    After BARF (Lin et al., 2021).
    """

    rate: float = 1e-3
    """Adam's learning rate of the camera motions, in radians and in units of the normalised world, in which cameras are
    about 1 from what they see."""
    final_factor: float = 0.01
    """Factor of the rate at the end of a stage; a system's later stages keep the rate of the first one's end."""

    name = "pose"

    @property
    def neutral(self) -> np.ndarray:
        return np.zeros(6)

    def camera(self, row: Array, camera: Camera) -> Camera:
        return dataclasses.replace(camera, viewmat=moved_viewmat(row, camera.viewmat))


@pytree
class CorrectionState:
    """State of one correction."""

    rows: Array
    """[V, ...], in the order of the training views."""
    moments: AdamState
    """Adam's moments per view; `count` [V] counts how often each was seen."""


def exposed(exposure: Array, color: Array) -> Array:
    """Return A·c + b for colours [H, W, 3] and an exposure [3, 4] = [A | b]."""
    # HIGHEST: GPUs may otherwise round the factors to TF32.
    mixed = jnp.einsum("ij,hwj->hwi", exposure[:, :3], color, precision=jax.lax.Precision.HIGHEST)
    return mixed + exposure[:, 3][None, None]


def initial_corrections(
    corrections: Sequence[Correction], names: Sequence[str], origin: Origin | None, dtype: Any
) -> tuple[CorrectionState, ...]:
    """Return the states before a stage, given the names of the V training views: rows of the origin of the model that
    the stage starts from, where it has them, and neutral ones."""
    states = []
    for correction in corrections:
        neutral = correction.neutral
        row_of = {}
        if origin is not None and correction.name in origin.corrections:
            row_of = dict(zip(origin.names, origin.corrections[correction.name], strict=True))
        # By name, because the earlier training may have had other views.
        initial = [row_of.get(name, neutral) for name in names]
        for row in initial:
            if row.shape != neutral.shape:
                shapes = f"{list(neutral.shape)}, as {type(correction).__name__} has them; got {list(row.shape)}"
                raise ValueError(f"corrections called {correction.name!r} of the model to start from must be {shapes}")
        rows = jnp.asarray(np.stack(initial), dtype)
        # Counted per view, so that the bias correction fits each view's own steps.
        moments = dataclasses.replace(adam_init(rows), count=jnp.zeros(len(rows), jnp.int32))
        states.append(CorrectionState(rows, moments))
    return tuple(states)


def check_corrections(states: Sequence[CorrectionState], num_views: int) -> None:
    """Raise ValueError unless there is a row for each training view."""
    for state in states:
        if len(state.rows) != num_views:
            raise ValueError(
                f"the checkpoint has corrections of {len(state.rows)} training views, but the scene has {num_views}: "
                "resume with the scene that it was made from"
            )


def corrected_camera(corrections: Sequence[Correction], rows: Sequence[Array], camera: Camera) -> Camera:
    """Return the camera of a view, given its row of each correction.

    Raises:
      ValueError: naming the correction, if it returns something else than a camera of the same size.
    """
    for correction, row in zip(corrections, rows, strict=True):
        corrected = correction.camera(row, camera)
        check_kept(f"{type(correction).__name__}.camera", corrected, camera)
        camera = corrected
    return camera


def corrected_color(corrections: Sequence[Correction], rows: Sequence[Array], color: Array) -> Array:
    """Return the colours of a view, given its row of each correction.

    Raises:
      ValueError: naming the correction, if it returns something else than colours of the same shape.
    """
    for correction, row in zip(corrections, rows, strict=True):
        corrected = correction.color(row, color)
        check_kept(f"{type(correction).__name__}.color", corrected, color)
        color = corrected
    return color


def penalties(corrections: Sequence[Correction], rows: Sequence[Array]) -> list[Array]:
    """Return what the corrections add to the loss of a view, given its row of each.

    Raises:
      ValueError: naming the correction, if it returns something else than a number.
    """
    summands = []
    for correction, row in zip(corrections, rows, strict=True):
        penalty = correction.penalty(row)
        if penalty is not None:
            check_scalar(f"{type(correction).__name__}.penalty", penalty)
            summands.append(penalty)
    return summands


def updated(
    correction: Correction, state: CorrectionState, views: Array, grads: Array, progress: Array
) -> CorrectionState:
    """Return the state after a step of Adam on the rows of the views [B] of a batch, in which a view may occur twice.
    The gradients [B, ...] are of each view's loss in its row."""
    # A view that occurs twice gets the sum of its gradients.
    sums = jnp.zeros_like(state.rows).at[views].add(grads)
    is_seen = jnp.zeros(len(state.rows), bool).at[views].set(True)
    rate = correction.learning_rate(progress)
    check_scalar(f"{type(correction).__name__}.learning_rate", rate)
    step = jax.vmap(lambda row, grad, moments: adam_update(row, grad, moments, rate))(state.rows, sums, state.moments)

    # Adam would also move the rows of other views, by their moments.
    rows, moments = jax.tree.map(
        functools.partial(where_rows, is_seen), (step.params, step.state), (state.rows, state.moments)
    )
    projected = correction.project(rows)
    check_kept(f"{type(correction).__name__}.project", projected, rows)
    return CorrectionState(projected, moments)


def corrected_origin(origin: Origin, corrections: Sequence[Correction], states: Sequence[CorrectionState]) -> Origin:
    """Return a scene's origin, training views first, with the learned corrections and the corrected training cameras
    (host)."""
    if not corrections:
        return origin
    rows = {}
    for correction, state in zip(corrections, states, strict=True):
        learned_rows = np.asarray(state.rows)
        # Nothing is learned for test views.
        num_test = len(origin.names) - len(learned_rows)
        of_test_views = np.broadcast_to(correction.neutral, (num_test, *learned_rows.shape[1:]))
        rows[correction.name] = np.concatenate([learned_rows, of_test_views.astype(learned_rows.dtype)])
    viewmats = origin.viewmats.copy()
    cameras = origin.cameras
    for index in np.flatnonzero(~origin.is_test):
        of_view = [jnp.asarray(rows[correction.name][index]) for correction in corrections]
        viewmats[index] = corrected_camera(corrections, of_view, cameras[index]).viewmat
    return dataclasses.replace(origin, viewmats=viewmats, corrections=rows)


LUMINANCE = (0.299, 0.587, 0.114)
"""Weights of red, green and blue (BT.601)."""
LARGEST_GRID = 64
"""Largest number of nodes of a grid along each of its axes."""


@pytree
class BilateralGrid(FadingCorrection):
    """An affine map of colours per view, position and luminance, [L, Gy, Gx, 3, 4].

    It follows what an affine map cannot: vignettes, local tone mapping, curves of a camera's processing (Chen et al.,
    2007; Wang et al., 2024, Bilateral Guided Radiance Field Processing). A pixel's map is interpolated trilinearly at
    its place in the image and the luminance of the render.

    On average over the views, each node is the identity: cameras look at one subject, so a change that all views share,
    even one that varies over the picture, would shift the model.
    """

    size: tuple[int, int, int] = static(default=(4, 4, 4))
    """Numbers (Gx, Gy, L) of nodes along x, along y, and of luminances, each up to 64."""
    rate: float = 5e-3
    """Adam's learning rate of the grids."""
    final_factor: float = 0.1
    """Factor of the rate at the end of a stage; a system's later stages keep the rate of the first one's end."""
    smoothness: float = 10.0
    """Weight of the total variation of the grids in the loss."""

    name = "bilateral_grid"
    averages_neutral = True

    def check_options(self) -> None:
        super().check_options()
        if not all(1 <= number <= LARGEST_GRID for number in self.size):
            raise ValueError(f"size must be numbers in 1..{LARGEST_GRID}; got {self.size}")
        check_fields(self, "smoothness", least=0)

    @property
    def neutral(self) -> np.ndarray:
        columns, rows, levels = self.size
        return np.tile(np.eye(3, 4), (levels, rows, columns, 1, 1))

    def color(self, row: Array, color: Array) -> Array:
        return sliced(row, color)

    def penalty(self, row: Array) -> Array:
        return self.smoothness * total_variation(row)


def sliced(grid: Array, color: Array) -> Array:
    """Return the colours [H, W, 3] after each pixel's own affine map from the grid [L, Gy, Gx, 3, 4].

    The first and last nodes are at the edges of the image, and at the luminances 0 and 1.
    """
    levels, rows, columns = grid.shape[:3]
    height, width = color.shape[:2]

    def hats(num: int, side: int) -> Array:
        # Weights [side, num] of nodes for linear interpolation at pixel centres.
        places = (jnp.arange(side, dtype=grid.dtype) + 0.5) / side * (num - 1)
        return jnp.maximum(1 - jnp.abs(places[:, None] - jnp.arange(num, dtype=grid.dtype)[None]), 0)

    along_y = hats(rows, height)
    along_x = hats(columns, width)
    # Renders may leave [0, 1], where the outer levels continue.
    luminance = jnp.clip(color @ jnp.asarray(LUMINANCE, color.dtype), 0, 1) * (levels - 1)

    # Else the backward pass would keep the maps [H, W, 3, 4] of all L levels.
    @jax.checkpoint
    def add(total: Array, level: tuple[Array, Array]) -> tuple[Array, None]:
        nodes, number = level
        maps = jnp.einsum("hr,wc,rcij->hwij", along_y, along_x, nodes, precision=jax.lax.Precision.HIGHEST)
        mapped = jnp.sum(maps[..., :3] * color[..., None, :], axis=-1) + maps[..., 3]
        weight = jnp.maximum(1 - jnp.abs(luminance - number), 0)
        return total + weight[..., None] * mapped, None

    return jax.lax.scan(add, jnp.zeros_like(color), (grid, jnp.arange(levels, dtype=color.dtype)))[0]


def total_variation(grid: Array) -> Array:
    """Return the mean squared difference of neighbouring nodes [L, Gy, Gx, ...], summed over the three axes."""
    steps = [jnp.diff(grid, axis=axis) for axis in range(3) if grid.shape[axis] > 1]
    return sum((jnp.mean(step * step) for step in steps), jnp.zeros((), grid.dtype))
