"""Code by platform: which compositor runs on it, and functions whose code depends on it.

JAX knows the platform of a computation when it lowers it, from the devices of its arguments: the CPU, an NVIDIA GPU, or
another one. `jax.lax.platform_dependent` traces the code of all platforms, `by_platform` only the code of this one.
"""

import functools
import importlib.util
import os
from collections.abc import Callable, Hashable
from typing import Any, NoReturn, TypeVar

import jax
from jax import Array
from jax.core import ShapedArray

# It registers configuration that belongs to every trace's key: if its first import were during the first trace, such as
# by `jaxprs`, JAX would trace and compile all of it a second time.
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from a2tg_jax.base.user_warnings import warn
from a2tg_jax.rasterize.kernels.cuda import nvrtc
from a2tg_jax.rasterize.splats import Compositor, CompositorChoice

T = TypeVar("T")
DETERMINISM_FLAGS = ("--xla_gpu_deterministic_ops", "--xla_gpu_exclude_nondeterministic_ops")
MAX_TILE_SIZE = 64
"""Largest side of a tile in pixels; native loops keep a tile on the stack."""

PLATFORMS: dict[Compositor, str] = {"native": "cpu", "cuda": "cuda"}
"""Platforms of the compositors that do not run everywhere, as JAX names them when it compiles."""
REMEDIES: dict[Compositor, str] = {
    "native": "JAX on the CPU and llvmlite: pip install llvmlite",
    "cuda": "JAX on an NVIDIA GPU and NVRTC: pip install 'a2tg-jax[cuda13]'",
}
"""Requirements of the same compositors."""


def check_compositor(compositor: CompositorChoice) -> None:
    """Raise ValueError if a package that a compositor needs is not installed."""
    if compositor != "auto":
        choose(compositor, PLATFORMS.get(compositor, ""))


def choose(compositor: CompositorChoice, platform: str) -> Compositor:
    """Return the given compositor, or for "auto" the fastest one for the platform that JAX compiles for.

    Raises:
      ValueError: if the compositor does not run on that platform, or a package that it needs is not installed.
    """
    if compositor == "auto":
        if is_available("native", platform):
            return "native"
        return "cuda" if platform == PLATFORMS["cuda"] and not wants_determinism() and has_cuda() else "xla"
    if compositor in PLATFORMS and not is_available(compositor, platform):
        raise ValueError(f"compositor={compositor!r} needs {REMEDIES[compositor]}, or 'auto'")
    return compositor


def is_available(compositor: Compositor, platform: str) -> bool:
    """Return whether a compositor of `PLATFORMS` runs on a platform, and the packages that it needs are installed."""
    if platform != PLATFORMS[compositor]:
        return False
    return has_native() if compositor == "native" else nvrtc.find() is not None


def wants_determinism() -> bool:
    """Return whether XLA_FLAGS request reproducible results on GPUs, which the CUDA kernels' atomic sums are not."""
    words = (word.partition("=") for word in os.environ.get("XLA_FLAGS", "").split())
    # Of a flag that occurs several times, the last one holds.
    is_on = {flag: value.lower() in ("", "true", "1") for flag, _, value in words}
    return any(is_on.get(flag, False) for flag in DETERMINISM_FLAGS)


def instead_of(compositor: CompositorChoice, appearance: type, reason: str) -> None:
    """Warn, once per class, that XLA composites an appearance that kernels cannot run; ValueError if they must."""
    if compositor != "auto":
        raise ValueError(f"compositor={compositor!r} cannot run {appearance.__name__}: {reason}. Say 'xla', or 'auto'")
    _warn_of_fallback(appearance, reason)


@functools.cache
def _warn_of_fallback(appearance: type, reason: str) -> None:
    warn(f"{appearance.__name__} is composited by XLA, which is slower: {reason}")


@functools.cache
def has_native() -> bool:
    """Return whether native loops can be called: llvmlite is installed, and jaxlib's interface is known."""
    try:
        if importlib.util.find_spec("llvmlite") is None:
            return False
    except ValueError:  # sys.modules["llvmlite"] is None, as programs do to rule it out.
        return False
    from a2tg_jax.rasterize.kernels.native import ffi

    reason = ffi.refusal()
    if reason is not None:
        warn(f"compositing by XLA, which is slower: {reason}; install a jax that was tried")
    return reason is None


@functools.cache
def has_cuda() -> bool:
    """Return whether CUDA kernels can be used: NVRTC is installed, and they agree with XLA on this machine's GPU."""
    from a2tg_jax.rasterize.kernels.cuda import check

    reason = check.failure() if nvrtc.find() else f"CUDA kernels need {REMEDIES['cuda']}"
    if reason is not None:
        warn(f"compositing by XLA, which is slower: {reason}")
    return reason is None


def by_platform(
    code_of: Callable[..., Callable[..., Any]],
    static: tuple[Hashable, ...],
    results: object,
    *arrays: object,
    advice: str = "it has no derivative",
) -> Any:
    """Call `code_of(platform, *static)(*arrays)`, for the platform that JAX compiles for.

    Args:
      code_of: module-level function of a platform ("cpu", "cuda" or "other") and of static arguments.
      static: static arguments.
      results: pytree of `jax.ShapeDtypeStruct`, the same on all platforms.
      arrays: pytrees of arrays.
      advice: message of the ValueError that is raised if JAX differentiates the call.

    Returns:
      The results, varying over the devices of a `shard_map` as the arrays do.
    """
    flat, structure = jax.tree.flatten(arrays)
    shapes, structure_of_results = jax.tree.flatten(results)
    flat_results = by_platform_p.bind(
        *flat, code_of=code_of, static=static, structure=structure, shapes=tuple(shapes), axes=(), advice=advice
    )
    return vary_with(flat, jax.tree.unflatten(structure_of_results, flat_results))


# Inside shard_map: results of foreign functions, which JAX assumes to be the same on all devices


def _axes(tree: object) -> frozenset[str]:
    """Return the axes of a mesh along which an array of a pytree varies."""
    types = [getattr(jax.typeof(leaf), "manual_axis_type", None) for leaf in jax.tree.leaves(tree)]
    return frozenset().union(*(type_.varying for type_ in types if type_ is not None))


def vary_with(inputs: object, results: T) -> T:
    """Mark the results as varying along every axis of the mesh along which an input varies."""
    axes = _axes(inputs)

    def vary(result: Array) -> Array:
        missing = tuple(sorted(axes - _axes(result)))
        return jax.lax.pcast(result, missing, to="varying") if missing else result

    return jax.tree.map(vary, results)


def cotangent_of(primal: object, cotangent: T) -> T:
    """Sum a cotangent over the devices that share its primal value, leaf by leaf."""

    def total(value: object, cotangent: object) -> Any:
        # A value that devices share was broadcast to them; the transpose of that is a sum.
        shared = tuple(sorted(_axes(cotangent) - _axes(value)))
        return jax.lax.psum(cotangent, shared) if shared else cotangent

    return jax.tree.map(total, primal, cotangent)


def _lower(platform: str, context: Any, *operands: object, **parameters: Any) -> Any:
    # Without the axes of a `shard_map`, for XLA's loops do not say along which of them their carries vary.
    avals = [ShapedArray(aval.shape, aval.dtype) for aval in context.avals_in]
    run = functools.partial(_run, platform, **parameters)
    return mlir.lower_fun(run, multiple_results=True)(context.replace(avals_in=avals), *operands)


def _run(
    platform: str, *flat: Array, code_of: Any, static: Any, structure: object, shapes: object, axes: Any, advice: str
) -> list[Array]:
    def function(*flat: Array) -> list[Array]:
        return jax.tree.leaves(code_of(platform, *static)(*jax.tree.unflatten(structure, flat)))

    # `vmap` adds its axes to the parameters, one set for each; it is applied here, to the code of this platform.
    for of_arrays in axes:
        function = jax.vmap(function, of_arrays)
    return function(*flat)


def _batched(
    arrays: Any, of_arrays: Any, *, shapes: Any, axes: Any, **parameters: object
) -> tuple[list[Array], list[int]]:
    mapped = zip(arrays, of_arrays, strict=True)
    size = next(array.shape[axis] for array, axis in mapped if axis is not None)
    shapes = tuple(jax.ShapeDtypeStruct((size, *shape.shape), shape.dtype) for shape in shapes)
    results = by_platform_p.bind(*arrays, shapes=shapes, axes=(*axes, tuple(of_arrays)), **parameters)
    return results, [0] * len(results)


def _refuse(*_: object, advice: str, **parameters: object) -> NoReturn:
    raise ValueError(advice)


@functools.lru_cache(maxsize=256)
def _compiled(parameters: frozenset[tuple[str, Hashable]]) -> jax.stages.Wrapped:
    return jax.jit(functools.partial(by_platform_p.bind, **dict(parameters)))


def _now(*arrays: Array, **parameters: object) -> list[Array]:
    # Eagerly too, the platform is known only when JAX compiles; under `jax.disable_jit` as well.
    with jax.disable_jit(False):
        results: list[Array] = _compiled(frozenset(parameters.items()))(*arrays)
    return results


by_platform_p = Primitive("a2tg_by_platform")
by_platform_p.multiple_results = True
by_platform_p.def_impl(_now)
by_platform_p.def_abstract_eval(lambda *_, shapes, **__: [ShapedArray(shape.shape, shape.dtype) for shape in shapes])
batching.primitive_batchers[by_platform_p] = _batched
ad.primitive_jvps[by_platform_p] = _refuse
mlir.register_lowering(by_platform_p, functools.partial(_lower, "other"))
for _platform in ("cpu", "cuda"):
    mlir.register_lowering(by_platform_p, functools.partial(_lower, _platform), platform=_platform)
