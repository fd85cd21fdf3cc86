"""Evaluation of jaxprs of scalars, an equation at a time: the part that all kinds of kernels share.

A value stands for a number in the code that is being made. A small array is a numpy array of values, one per entry;
every entry becomes code of its own.
"""

import abc
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, Protocol, TypeAlias, TypeVar, cast

import numpy as np
from jax.extend import core
from jax.typing import ArrayLike, DTypeLike

MOST_ENTRIES = 256
"""Largest number of entries of an array, and of steps of a scan over arrays, for which code is unrolled."""
Equation = core.JaxprEqn
Params = dict[str, Any]
"""Parameters of an equation."""
V = TypeVar("V")
"""What stands for a number in the code that is being made."""
Value: TypeAlias = V | np.ndarray
"""A number, or a small array of them."""
Values: TypeAlias = list[Value[V]]
Step: TypeAlias = Callable[[Values[V]], Values[V]]
CALLS = (
    *("jit", "pjit", "closed_call", "core_call", "call", "remat", "remat2", "checkpoint"),
    *("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"),
)
"""Primitives that run their jaxpr once, by their names in all versions of JAX from 0.10 on."""
REDUCTIONS = {
    **{"reduce_and": "and", "reduce_max": "max", "reduce_min": "min"},
    **{"reduce_or": "or", "reduce_prod": "mul", "reduce_sum": "add"},
}
"""Element-wise primitives by the name of the reduction."""


class Untranslatable(ValueError):
    """Error of a function that cannot become a kernel; the message names the obstacle."""

    primitive: str | None = None
    """Name of the primitive that has no translation, if it is one."""

    @staticmethod
    def of(primitive: str, target: str) -> "Untranslatable":
        """Return the error of a primitive without a translation to a kind of kernels."""
        error = Untranslatable(f"{target} have no translation for the primitive '{primitive}'")
        error.primitive = primitive
        return error


class ArrayAval(Protocol):
    """Abstract value of an array."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


class Evaluator(abc.ABC, Generic[V]):
    """Base class of what makes code of jaxprs; a subclass knows numbers, element-wise primitives and loops."""

    target: str
    """Kind of kernels, as error messages name them."""

    @abc.abstractmethod
    def literal(self, number: ArrayLike, dtype: DTypeLike) -> V:
        """Return the value of a number."""

    @abc.abstractmethod
    def check_dtype(self, dtype: DTypeLike) -> None:
        """Raise Untranslatable unless there are values of this dtype."""

    @abc.abstractmethod
    def primitive(self, name: str) -> Callable[[list[V], Equation], V] | None:
        """Return the function from values to the value of an element-wise primitive, if there is one."""

    @abc.abstractmethod
    def branches(
        self, index: Value[V], branches: Sequence[core.ClosedJaxpr], operands: Values[V], equation: Equation
    ) -> Values[V]:
        """Emit `cond` or `switch`."""

    @abc.abstractmethod
    def loop(self, carry: Values[V], test: Callable[[Values[V]], Value[V]], step: Step[V]) -> Values[V]:
        """Emit a loop that replaces `carry` by `step` of it as long as `test` of it holds."""

    @abc.abstractmethod
    def counted(self, length: int, carry: Values[V], step: Step[V]) -> Values[V]:
        """Emit a loop of a fixed number of steps."""

    def run(self, jaxpr: core.ClosedJaxpr | core.Jaxpr, arguments: Sequence[Value[V]]) -> Values[V]:
        """Emit a jaxpr, closed or without constants, and return its values."""
        consts = getattr(jaxpr, "consts", ())
        jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
        values: dict[core.Var, Value[V]] = {}

        def read(atom: core.Var | core.Literal) -> Value[V]:
            return self._constant(atom.val, aval_of(atom)) if isinstance(atom, core.Literal) else values[atom]

        for variable, value in zip(jaxpr.constvars, consts, strict=True):
            values[variable] = self._constant(value, aval_of(variable))
        values.update(zip(jaxpr.invars, arguments, strict=True))
        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _constant(self, value: ArrayLike, aval: ArrayAval) -> Value[V]:
        self.check_dtype(aval.dtype)
        numbers = np.asarray(value).reshape(-1)
        return array_of([self.literal(number, aval.dtype) for number in numbers], aval.shape)

    def _equation(self, equation: Equation, operands: Values[V]) -> Values[V]:
        name, params = equation.primitive.name, equation.params
        for index in range(len(equation.outvars)):
            self.check_dtype(result_of(equation, index).dtype)
        if name in CALLS:
            return self.run(params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"], operands)
        if name in SHAPES:
            result = SHAPES[name](operands, params)
            return [array_of(entries(result), result_of(equation).shape)]
        if name in REDUCTIONS:
            return [self._reduction(REDUCTIONS[name], cast(np.ndarray, operands[0]), equation)]
        if name == "optimization_barrier":
            return operands
        if name == "cond":
            return self.branches(operands[0], params["branches"], operands[1:], equation)
        if name == "while":
            return self._while(operands, params)
        if name == "scan":
            return self._scan(operands, equation)
        return [map_entries(lambda numbers: self.element(name, numbers, equation), operands)]

    def element(self, name: str, operands: list[V], equation: Equation) -> V:
        """Emit an element-wise primitive on scalars."""
        emit = self.primitive(name)
        if emit is None:
            raise Untranslatable.of(name, self.target)
        return emit(operands, equation)

    def _reduction(self, name: str, array: np.ndarray, equation: Equation) -> Value[V]:
        """Reduce axes of an array by an element-wise primitive."""
        axes, result = equation.params["axes"], result_of(equation)
        kept = np.moveaxis(array, axes, range(len(axes)))
        rows = kept.reshape(math.prod(kept.shape[: len(axes)]), -1)
        # Sums begin with 0 as in XLA, which matters if all addends are −0.
        first = [self.literal(0, result.dtype)] if name == "add" else []
        combine = lambda x, y: self.element(name, [x, y], equation)  # noqa: E731
        return array_of([functools.reduce(combine, [*first, *column]) for column in rows.T], result.shape)

    def _while(self, operands: Values[V], params: Params) -> Values[V]:
        num_cond, num_body = params["cond_nconsts"], params["body_nconsts"]
        cond_consts, body_consts = operands[:num_cond], operands[num_cond : num_cond + num_body]
        return self.loop(
            operands[num_cond + num_body :],
            lambda carry: self.run(params["cond_jaxpr"], [*cond_consts, *carry])[0],
            lambda carry: self.run(params["body_jaxpr"], [*body_consts, *carry]),
        )

    def _scan(self, operands: Values[V], equation: Equation) -> Values[V]:
        """Emit a loop, unrolled if it reads or writes arrays."""
        params, length = equation.params, equation.params["length"]
        num_consts, num_carry = _scan_sizes(params)
        consts, carry = operands[:num_consts], operands[num_consts : num_consts + num_carry]
        arrays = cast(list[np.ndarray], operands[num_consts + num_carry :])
        num_written = len(equation.outvars) - num_carry
        if not arrays and not num_written:
            return self.counted(length, carry, lambda carry: self.run(params["jaxpr"], [*consts, *carry]))
        if length > MOST_ENTRIES:
            raise Untranslatable(
                f"{self.target} unroll a scan over arrays for {MOST_ENTRIES} steps at most; got {length}"
            )
        written: list[Any] = [None] * length
        for step in reversed(range(length)) if params["reverse"] else range(length):
            results = self.run(params["jaxpr"], [*consts, *carry, *(array[step] for array in arrays)])
            carry, written[step] = results[:num_carry], results[num_carry:]
        stacked = []
        for k in range(num_written):
            flat = [entry for row in written for entry in entries(row[k])]
            stacked.append(array_of(flat, result_of(equation, num_carry + k).shape))
        return [*carry, *stacked]


def aval_of(atom: core.Var | core.Literal) -> ArrayAval:
    """Return the abstract value of an array."""
    return cast(ArrayAval, atom.aval)


def result_of(equation: Equation, index: int = 0) -> ArrayAval:
    """Return the abstract value of a result."""
    return aval_of(equation.outvars[index])


def entries(value: Value[V]) -> list[V]:
    """Return all entries of an array, or a scalar as the only one."""
    return list(value.flat) if isinstance(value, np.ndarray) else [value]


def rebuilt_like(value: Value[V], new: Iterator[V]) -> Value[V]:
    """Make a scalar or an array of the same shape from the next values."""
    if not isinstance(value, np.ndarray):
        return next(new)
    return array_of([next(new) for _ in range(value.size)], value.shape)


def array_of(values: Sequence[V], shape: Sequence[int]) -> Value[V]:
    """Make an array of a shape from its entries; a scalar if the shape is ()."""
    if math.prod(shape) > MOST_ENTRIES:
        raise Untranslatable(f"kernels take functions of scalars; an array has shape {tuple(shape)}")
    array = np.empty(len(values), object)
    array[:] = values
    return array.reshape(shape) if shape else values[0]


def map_entries(emit: Callable[[list[V]], V], operands: Sequence[Value[V]]) -> Value[V]:
    """Emit an element-wise operation on scalars, or entry by entry on arrays; axes of length 1 broadcast."""
    scalars = [operand for operand in operands if not isinstance(operand, np.ndarray)]
    if len(scalars) == len(operands):
        return emit(scalars)
    shape = np.broadcast_shapes(*(operand.shape for operand in operands if isinstance(operand, np.ndarray)))
    rows = [list(np.broadcast_to(cast(np.ndarray, operand), shape).flat) for operand in operands]
    return array_of([emit(list(numbers)) for numbers in zip(*rows, strict=True)], shape)


def _scan_sizes(params: Params) -> tuple[int, int]:
    """Return the numbers of constants and of carried values of a scan."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()  # JAX 0.12
    return len(list(consts)), len(list(carry))


def _broadcast(operands: Values[V], params: Params) -> Value[V]:
    (operand,), shape = operands, params["shape"]
    if not isinstance(operand, np.ndarray):
        return array_of([operand] * math.prod(shape), shape)
    inner = [1] * len(shape)
    for size, dimension in zip(operand.shape, params["broadcast_dimensions"], strict=True):
        inner[dimension] = size
    return np.broadcast_to(operand.reshape(inner), shape)


def _slice(operands: Values[V], params: Params) -> Value[V]:
    starts, limits = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or (1,) * len(starts)
    part: np.ndarray = cast(np.ndarray, operands[0])[tuple(map(slice, starts, limits, strides))]
    return part


def _stack(operands: Values[V], params: Params) -> Value[V]:
    shape = operands[0].shape if isinstance(operands[0], np.ndarray) else ()
    flat = [entry for operand in operands for entry in entries(operand)]
    return np.moveaxis(cast(np.ndarray, array_of(flat, (len(operands), *shape))), 0, params["axis"])


SHAPES: dict[str, Callable[[list[Any], Params], Any]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda operands, params: np.concatenate(operands, axis=params["dimension"]),
    "reshape": lambda operands, _: operands[0],
    "rev": lambda operands, params: np.flip(operands[0], params["dimensions"]),
    "slice": _slice,
    "squeeze": lambda operands, _: operands[0],
    "stack": _stack,
    "transpose": lambda operands, params: np.transpose(operands[0], params["permutation"]),
}
"""Primitives that rearrange the entries of arrays."""
