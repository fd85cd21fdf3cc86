"""Adam and its schedules, in jaxopt's style: pure functions that take and return (params, state).

jaxopt has no Adam. No other module imports jaxopt.
"""

import functools
import math
import warnings
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from a2tg_jax.base.checks import check_array, check_floats, check_kind, check_number, check_numeric, check_shape
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import shortened
from a2tg_jax.core.pytree import pytree


@pytree
class AdamState(NamedFields):
    """State of Adam; `mu` and `nu` have the structure, shapes and dtypes of the parameters."""

    mu: Any
    """Decayed mean of the gradients."""
    nu: Any
    """Decayed mean of the squared gradients."""
    count: Array
    """int32 number of updates so far."""


def adam_init(params: object) -> AdamState:
    """Return Adam's state before the first step: zero moments.

    Args:
      params: pytree of float arrays.

    Returns:
      The number of steps, 0, and the moments `mu` and `nu`, each a pytree like `params`.

    Raises:
      ValueError: if a leaf holds no floats, naming it.
    """
    _check_floats(params)
    mu = jax.tree.map(jnp.zeros_like, params)
    # Not the arrays of `mu` again: a buffer can be donated only once.
    nu = jax.tree.map(jnp.zeros_like, params)
    return AdamState(mu, nu, count=jnp.zeros((), jnp.int32))


def adam_update(
    params: object,
    grads: object,
    state: AdamState,
    rates: object,
    *,
    b1: float = 0.9,
    b2: float = 0.999,
    eps: float = 1e-15,  # as in 3DGS: gradients of one Gaussian may be far below 1e-8
) -> Any:
    """Make one bias-corrected update of Adam (Kingma & Ba, 2015); ε is added after the correction, as in PyTorch.

    Args:
      params: pytree of float arrays.
      grads: the same pytree of gradients.
      state: state from `adam_init` or the previous update.
      rates: learning rates, a pytree prefix of `params`: one for all, or one per field. A rate is a scalar or an
        array that broadcasts against its leaf at equal rank ([1, K, 1] sets one per spherical harmonic).
      b1: decay of the first moment, in [0, 1).
      b2: decay of the second moment, in [0, 1).
      eps: ε ≥ 0.

    Returns:
      jaxopt's named tuple OptStep(params, state): the updated parameters, and the state for the next update.

    Raises:
      ValueError: if parameters are not floats, gradients, moments or rates do not fit them, naming the leaf, or a
        number is out of range.

    Examples:
      >>> floats, rest = a2tg.partition(model)
      >>> gradient = jax.tree.map(jnp.ones_like, floats)
      >>> floats, moments = a2tg.adam_update(floats, gradient, a2tg.adam_init(floats), 1e-2)
      >>> a2tg.combine(floats, rest).num
      200
    """
    check_kind("state", state, AdamState, "use adam_init(params)")
    for name, decay in (("b1", b1), ("b2", b2)):
        check_number(name, decay, least=0, below=1)
    check_number("eps", eps, least=0)
    _check_floats(params)
    expected = str(jax.tree.structure(params))
    for name, tree in (("grads", grads), ("state.mu", state.mu), ("state.nu", state.nu)):
        structure = str(jax.tree.structure(tree))
        if structure != expected:
            raise ValueError(f"{name} must have the structure of params, {expected}; got {structure}")
        leaves = jax.tree_util.tree_leaves_with_path(tree)
        for (path, leaf), param in zip(leaves, jax.tree.leaves(params), strict=True):
            check_shape(f"{name}{jax.tree_util.keystr(path)}", leaf, jnp.shape(param))
    count = state.count + 1
    mu = jax.tree.map(lambda m, g: b1 * m + (1 - b1) * g, state.mu, grads)
    nu = jax.tree.map(lambda v, g: b2 * v + (1 - b2) * g * g, state.nu, grads)

    # Once for each dtype, in the order of the leaves, so that the same program is compiled each time. `result_type`,
    # because without x64 JAX computes float64 of NumPy in float32.
    dtypes = dict.fromkeys(map(jnp.result_type, jax.tree.leaves(params)))
    corrections = {dtype: [_bias_correction(decay, count, dtype) for decay in (b1, b2)] for dtype in dtypes}

    def step(rate: Array, param: Array, m: Array, v: Array) -> Array:
        # Rates have JAX's default dtype, which under x64 would promote float32 parameters.
        dtype = jnp.result_type(param)
        rate = jnp.asarray(rate, dtype)
        first, second = corrections[dtype]
        root = jnp.sqrt(v) / jnp.sqrt(second)
        change: Array = rate / first * (m / (root + eps))
        return param - change

    params = jax.tree.map(step, _rate_of_each(rates, params), params, mu, nu)
    return _opt_step()(params=params, state=AdamState(mu, nu, count))


@functools.cache
def _opt_step() -> Any:
    """Return jaxopt's `OptStep`. jaxopt is imported once, at the first step: it brings SciPy's optimisers, a quarter of
    the time of importing this package."""
    with warnings.catch_warnings():
        # jaxopt warns at import that it is no longer maintained, about which users of this package can do nothing.
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        from jaxopt import OptStep  # type: ignore[import-untyped]
    return OptStep


def exponential_decay(start: float, final_factor: float, iteration: Array | int, total: int) -> Array:
    """Return start · final_factor^(iteration / total): from `start` at iteration 0, log-linear, then constant.

    Args:
      start: rate at iteration 0, in units of the parameter per step.
      final_factor: rate at `total` divided by that at 0, positive.
      iteration: current iteration, or an array of iterations; may be traced.
      total: iterations of the stage, at least 1.

    Returns:
      Rates of the default float dtype, of the shape of `iteration`.

    Raises:
      ValueError: if an argument is no number, or one out of range.
    """
    check_numeric("start", start)
    check_number("final_factor", final_factor, above=0)
    check_numeric("iteration", iteration)
    check_number("total", total, least=1)
    progress = jnp.clip(jnp.asarray(iteration, jnp.result_type(float)) / total, 0.0, 1.0)
    return start * jnp.exp(math.log(final_factor) * progress)


def _rate_of_each(rates: object, params: object) -> object:
    """Return a rate for each leaf of the parameters. Raise ValueError, naming the leaf, if a rate does not fit."""
    try:
        rates = jax.tree.broadcast(rates, params)
    except ValueError as error:
        structure = shortened(str(jax.tree.structure(rates)))
        raise ValueError(f"rates must be one for all, or have the fields of params; got {structure}") from error
    for (path, param), rate in zip(jax.tree_util.tree_leaves_with_path(params), jax.tree.leaves(rates), strict=True):
        shape = jnp.shape(rate)
        fits = len(shape) == param.ndim
        fits = fits and all(side in (1, whole) for side, whole in zip(shape, param.shape, strict=True))
        if shape and not fits:
            name = f"rates{jax.tree_util.keystr(path)}"
            raise ValueError(f"{name} must broadcast to {[*param.shape]} at equal rank; got {[*shape]}")
    return rates


def _check_floats(params: object) -> None:
    """Raise ValueError, naming the leaf, unless all leaves of the parameters are arrays of floats."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        name = f"params{jax.tree_util.keystr(path)}"
        check_array(name, leaf)
        check_floats(name, leaf, leaf.shape)


def _bias_correction(decay: float, count: Array, dtype: DTypeLike) -> Array:
    """Return 1 - decay^count; the plain formula loses four digits in float32 at the first steps."""
    # A decay of 0 needs no correction, and has no logarithm.
    return -jnp.expm1(count.astype(dtype) * math.log(decay)) if decay else jnp.ones((), dtype)
