"""The limits of the compositors that bring their own gradient, as errors that name the compositor to use.

Native loops, CUDA kernels and the loops of XLA are differentiated once, in reverse mode. JAX's own errors in other
modes name neither the renderer nor a remedy. (Under `vmap` of tangents, as in `jax.jacfwd`, JAX's error comes first.)
"""

import functools
from typing import Any, NoReturn

import jax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

ADVICE = (
    "compositor={compositor!r} is differentiated once, in reverse mode (jax.grad, jax.vjp, jax.jacrev). "
    "For forward mode (jax.jvp, jax.jacfwd, jax.linearize) and second derivatives, use "
    "RenderSettings(compositor='autodiff')"
)


def _refuse(compositor: str) -> NoReturn:
    raise ValueError(ADVICE.format(compositor=compositor))


# The identity, in the linear map of tangents. Reverse mode transposes it away; only forward mode runs it.
tangent_p = Primitive("a2tg_reverse_only")
tangent_p.def_impl(lambda tangent, *, compositor: _refuse(compositor))
tangent_p.def_abstract_eval(lambda tangent, *, compositor: tangent)
ad.deflinear2(tangent_p, lambda cotangent, _, *, compositor: [cotangent])
batching.defvectorized(tangent_p)
mlir.register_lowering(tangent_p, lambda _, tangent, *, compositor: _refuse(compositor))


def reverse_only(compositor: str, tree: Any) -> Any:
    """Return a pytree of floats unchanged; derivatives in forward mode raise ValueError.

    Args:
      compositor: name of the compositor, for the error.
      tree: inputs of the compositor.
    """
    return jax.tree.map(functools.partial(_identity, compositor), tree)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _identity(compositor: str, x: Any) -> Any:
    return x


@_identity.defjvp
def _identity_jvp(compositor: str, primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    return primals[0], tangent_p.bind(tangents[0], compositor=compositor)
