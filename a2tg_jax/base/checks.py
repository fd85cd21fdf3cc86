"""Checks of kinds, numbers, shapes and dtypes, with errors that name the argument; short texts for arrays.

Checks of arrays read only `shape` and `dtype`, so that tracers pass and nothing is computed. `check_number` reads the
value of a scalar array that is no tracer.
"""

import contextlib
import dataclasses
import math
import numbers
from collections.abc import Iterable, Iterator
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from a2tg_jax.base.text import shortened

LARGEST_NUMBER = 1e12
"""Largest magnitude of numbers in geometry. In float32, their products with focal lengths, the squares of these, and
the gradients, which overflow from 1e20 on, stay finite."""
FLOATS = ("float32", "float64")
"""Names of the dtypes that models may have."""
Wanted = tuple[int | str, ...]
"""Sizes of the axes of an array: numbers, or letters for any size, such as ("N", 16, 3)."""


@contextlib.contextmanager
def fields_of(path: str) -> Iterator[None]:
    """Put a path and a dot before an error of the block, which begins with the name of a field."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}.{error}") from error


def check_kind(name: str, value: object, kind: type | tuple[type, ...], hint: str = "") -> None:
    """Raise ValueError, with an optional hint, unless a value is an instance of a class, or of one of several."""
    if isinstance(value, kind):
        return
    if not hint and isinstance(value, type) and issubclass(value, kind):
        hint = f"use {value.__name__}(…)"
    nouns = []
    for accepted in kind if isinstance(kind, tuple) else (kind,):
        noun = accepted.__name__
        article = "an" if noun[0] in "AEIOUaeiou" else "a"
        # Plurals, such as Gaussians, have no article.
        nouns.append(noun if noun.endswith("s") else f"{article} {noun}")
    raise ValueError(f"{name} must be {' or '.join(nouns)}; got {kind_of(value)}{hint and f': {hint}'}")


def check_untraced(call: str) -> None:
    """Raise ValueError if a function that reads values is called by one that JAX traces."""
    # Under jit, arrays of constants are tracers too.
    if isinstance(jnp.zeros(()), jax.core.Tracer):
        raise ValueError(
            f"{call} reads values and compiles its own steps, so it cannot be traced: call it outside jax.jit, scan "
            "and other transformations"
        )


def check_literal(name: str, value: object, literal: object) -> None:
    """Raise ValueError unless a value is one of a `Literal`."""
    if value not in get_args(literal):
        raise ValueError(f"{name} must be one of {', '.join(get_args(literal))}; got {value!r}")


def check_int(name: str, value: Any, least: int, most: int | None = None, otherwise: str = "") -> None:
    """Raise ValueError unless a value is an int, of Python or numpy, in a range; the error adds what else may be."""
    is_int = isinstance(value, int | np.integer) and not isinstance(value, bool)  # bool is an int
    if not is_int or value < least or (most is not None and value > most):
        limits = f"at least {least}" if most is None else f"{least} to {most}"
        raise ValueError(f"{name} must be an int, {limits}{otherwise}; got {value!r}")


def check_number(
    name: str,
    value: Any,
    *,
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
    below: float | None = None,
) -> None:
    """Raise ValueError unless a value is one real number within limits; NaN is within none.

    A scalar array is a number. Values of tracers are not read.

    Args:
      name: the value's name in the error.
      value: any value.
      least: limit that the value may equal.
      above: limit that the value may not equal.
      most: upper limit that the value may equal.
      below: upper limit that the value may not equal.

    Raises:
      ValueError: naming the value, the limits and what it is.
    """
    limits = {"at least": least, "above": above, "at most": most, "below": below}
    wanted = " and ".join(f"{word} {limit:g}" for word, limit in limits.items() if limit is not None)
    if not _is_numeric(value) or np.shape(value) != ():
        got = described(value) if hasattr(value, "dtype") else repr(value)
        raise ValueError(f"{name} must be {f'a number {wanted}'.rstrip()}; got {got}")
    if isinstance(value, jax.core.Tracer):
        return
    number = float(value)
    is_low_enough = (most is None or number <= most) and (below is None or number < below)
    is_high_enough = (least is None or number >= least) and (above is None or number > above)
    if not (is_low_enough and is_high_enough and number == number):  # NaN is unequal to itself
        raise ValueError(f"{name} must be {wanted or 'a number'}; got {value!r}")


def check_fields(instance: Any, *names: str, **limits: float) -> None:
    """Check numbers of a dataclass by the names of their fields, or all fields, as `check_number` does; None passes,
    which other checks refuse where it may not be (`check_config`)."""
    for name in names or [field.name for field in dataclasses.fields(instance)]:
        value = getattr(instance, name)
        if value is not None:
            check_number(name, value, **limits)


def check_groups(config: Any) -> None:
    """Call the method `check_options` of each field of a dataclass that has one; errors begin with the field's name."""
    for field in dataclasses.fields(config):
        check = getattr(getattr(config, field.name), "check_options", None)
        if check is not None:
            with fields_of(field.name):
                check()


def check_numeric(name: str, value: object) -> None:
    """Raise ValueError unless a value is a number or an array of numbers of any shape; none is read."""
    if not _is_numeric(value):
        raise ValueError(f"{name} must be a number, or an array of numbers; got {described(value)}")


def _is_numeric(value: object) -> bool:
    """Return whether a value is a real number, or an array or a tracer of numbers."""
    if hasattr(value, "dtype"):
        return bool(jnp.issubdtype(value.dtype, jnp.number))
    return isinstance(value, numbers.Real) and not isinstance(value, bool)  # bool is a Real


def check_array(name: str, x: object, hint: str = "") -> None:
    """Raise ValueError, with an optional hint, unless a value is an array or a tracer."""
    if not (hasattr(x, "shape") and hasattr(x, "dtype")):
        hint = hint or ("use jnp.asarray" if isinstance(x, list | tuple) else "")
        raise ValueError(f"{name} must be an array; got {kind_of(x)}{hint and f': {hint}'}")


def plain_array(name: str, value: object, dtype: DTypeLike | None = None) -> Any:
    """Return nested lists of numbers, masked arrays without masked entries, and arrays of foreign byte order or of
    other libraries as arrays that JAX takes; other values unchanged. Lists become arrays of `dtype`; None: JAX's
    default float. ValueError: an entry is masked, or the rows of a list differ in length."""
    check_unmasked(name, value)
    if isinstance(value, np.ma.MaskedArray):
        value = np.ma.getdata(value)
    first = value
    while isinstance(first, list | tuple) and first:
        first = first[0]
    # Only lists of numbers: JAX also puts other things in the place of arrays.
    if type(value) in (list, tuple) and isinstance(first, numbers.Number) and not isinstance(first, bool):
        try:
            value = np.asarray(value, jnp.result_type(float) if dtype is None else dtype)
        except ValueError:
            raise ValueError(f"{name} must be an array; got a list whose rows differ in length") from None
    if hasattr(value, "__array__") and not isinstance(value, np.ndarray | np.generic | jax.Array):
        value = np.asarray(value)  # an array of another library
    if isinstance(value, np.ndarray) and not value.dtype.isnative:
        value = value.astype(value.dtype.newbyteorder("="))
    return value


def check_unmasked(name: str, value: object) -> None:
    """Raise ValueError if a value is a masked array with masked entries, which would be read as unmasked."""
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise ValueError(f"{name} has masked entries: replace them, as in array.filled(0), or drop their rows")


def make_plain(instance: object, name: str, *fields: str) -> None:
    """Replace fields of a frozen dataclass by `plain_array` of them; lists get the dtype of the first array."""
    values = {field: getattr(instance, field) for field in fields}
    dtype = next((value.dtype for value in values.values() if hasattr(value, "dtype")), None)
    for field, value in values.items():
        if type(value) is tuple:  # Trees of shapes have tuples where arrays were.
            continue
        changed = plain_array(f"{name}.{field}", value, dtype)
        if changed is not value:
            object.__setattr__(instance, field, changed)


def kind_of(value: object) -> str:
    """Return what a value is, for errors."""
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__


def check_shape(name: str, x: Any, wanted: Wanted) -> None:
    """Raise ValueError unless x has the wanted shape; axes of the same letter have the same size.

    x is an array, a tracer, or nested sequences of numbers.
    """
    shape = np.shape(x)
    sizes: dict[str, int] = {}
    fits = len(shape) == len(wanted)
    for size, side in zip(shape, wanted, strict=False):
        # A letter stands for the size of its first axis.
        expected = sizes.setdefault(side, size) if isinstance(side, str) else side
        fits = fits and size == expected
    if not fits:
        is_array = hasattr(x, "shape") or isinstance(x, numbers.Number | list | tuple)
        raise ValueError(f"{name} must be {_written(wanted)}; got {_written(shape) if is_array else kind_of(x)}")


def check_floats(name: str, x: object, wanted: Wanted) -> None:
    """Raise ValueError unless x has the wanted shape, as in `check_shape`, and holds floats."""
    check_shape(name, x, wanted)
    if not jnp.issubdtype(dtype_of(x), jnp.floating):
        raise ValueError(f"{name} must be floats; got {dtype_of(x)}")


def check_mask(name: str, x: object, wanted: Wanted) -> None:
    """Raise ValueError unless x has the wanted shape, as in `check_shape`, and holds bools."""
    check_shape(name, x, wanted)
    if dtype_of(x) != np.bool_:
        raise ValueError(f"{name} must be bools; got {dtype_of(x)}")


def dtype_of(x: object) -> Any:
    """Return the dtype of an array, a tracer, or nested sequences of numbers."""
    return x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype


def described(value: object) -> str:
    """Describe a value in a few characters: arrays by dtype and shape, as in float32[7, 3]."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}{_written(value.shape)}"
    if type(value) is tuple:
        return f"({', '.join(described(item) for item in value)}{',' if len(value) == 1 else ''})"
    return repr(value)


def short_repr(value: Any) -> str:
    """Return the `repr` of a dataclass or a named tuple that holds arrays, without optional fields of a dataclass that
    are None."""
    fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
    left_out = {field.name for field in fields if field.default is None}
    texts = []
    for name in getattr(value, "_fields", [field.name for field in fields]):
        item = getattr(value, name)
        if item is not None or name not in left_out:
            texts.append(f"{name}={described(item)}")
    return f"{type(value).__name__}({', '.join(texts)})"


def _written(shape: tuple[int | str, ...]) -> str:
    return f"[{', '.join(str(side) for side in shape)}]"


def check_finite(name: str, tree: object, *, is_signed: bool = True) -> None:
    """Raise ValueError, naming the leaf, if a float of a pytree is NaN or infinite or, unsigned, NaN or negative."""
    for leaf, values in _float_rows(name, tree):
        # `values >= 0` is False for NaN.
        is_good: np.ndarray = np.all(np.isfinite(values) if is_signed else values >= 0, axis=1)
        if not is_good.all():
            wanted = "finite" if is_signed else "at least 0"
            unwanted = "NaN or infinite" if is_signed else "negative or NaN"
            bad = np.flatnonzero(~is_good)
            raise ValueError(
                f"{leaf} must be {wanted}; {len(bad):,} of {len(is_good):,} rows have {unwanted} numbers, the first is "
                f"row {bad[0]:,} (from 0)"
            )


def check_bounded(name: str, tree: object) -> None:
    """Raise ValueError, naming the leaf and the number, if a float is not finite or too large."""
    check_finite(name, tree)
    for leaf, values in _float_rows(name, tree):
        is_large = np.abs(values) > LARGEST_NUMBER
        if is_large.any():
            row, column = np.argwhere(is_large)[0]
            raise ValueError(
                f"{leaf} must be within ±{LARGEST_NUMBER:g}; got {values[row, column]:g} in row {row:,} (from 0)"
            )


def _float_rows(name: str, tree: object) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the numbers [N, C] of each leaf of floats; a scalar is one row."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        values = np.atleast_1d(np.asarray(leaf))
        if np.issubdtype(values.dtype, np.floating):
            yield f"{name}{jax.tree_util.keystr(path)}", values.reshape(len(values), math.prod(values.shape[1:]))


def check_count(name: str, value: Any, most: int) -> None:
    """Raise ValueError unless a value is one integer in 0..most. Values of tracers are not read."""
    is_integer = np.shape(value) == () and jnp.issubdtype(dtype_of(value), jnp.integer)
    if not is_integer or not (isinstance(value, jax.core.Tracer) or 0 <= int(value) <= most):
        raise ValueError(f"{name} must be a whole number in 0..{most}; got {shortened(str(value))}")


def check_like(name: str, tree: object, wanted: object) -> None:
    """Raise ValueError, naming the leaf, unless two pytrees of the same structure have equal shapes and dtypes."""
    pairs: Iterable[Any] = zip(jax.tree_util.tree_leaves_with_path(tree), jax.tree.leaves(wanted), strict=True)
    for (path, leaf), like in pairs:
        label = f"{name}{jax.tree_util.keystr(path)}"
        check_shape(label, leaf, tuple(like.shape))
        if dtype_of(leaf) != like.dtype:
            raise ValueError(f"{label} must be {like.dtype}; got {dtype_of(leaf)}")
