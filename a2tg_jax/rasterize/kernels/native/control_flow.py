"""Calls, branches and loops of jaxprs, and operations on the shapes of small arrays.

A value is an LLVM value; an array is a numpy array of LLVM values, one per entry. Lanes are independent, so that some
may take a branch or leave a loop while others do not. Every branch runs, and its results are chosen lane by lane; a
loop runs until the last lane has left it.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from a2tg_jax.rasterize.kernels.native.primitives import PRIMITIVES
from a2tg_jax.rasterize.kernels.native.vectors import (
    BOOL,
    INT,
    Equation,
    Translator,
    Untranslatable,
    result_of,
    scalar_type,
)

MOST_ENTRIES = 256
"""Largest number of entries of an array, and of steps of a scan over arrays, for which code is unrolled."""
Params = dict[str, Any]
"""Parameters of an equation."""
Emitter = Callable[[Translator, list[Any], Equation], list[Any]]
"""Function of (lanes, operands, equation) that emits code and returns its results."""
CALLS = (
    *("jit", "pjit", "closed_call", "core_call", "call", "remat", "remat2", "checkpoint"),
    *("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"),
)
"""Primitives that run their jaxpr once, by their names in all versions of JAX from 0.10 on."""


def entries(value: Any) -> list[ir.Value]:
    """Return all LLVM values of a value."""
    return list(value.flat) if isinstance(value, np.ndarray) else [value]


def like(value: Any, new: Iterator[ir.Value]) -> Any:
    """Make a value of the same shape from the next LLVM values."""
    if not isinstance(value, np.ndarray):
        return next(new)
    return array_of([next(new) for _ in range(value.size)], value.shape)


def array_of(values: Sequence[Any], shape: Sequence[int]) -> Any:
    """Make a value of a shape from its LLVM values."""
    if math.prod(shape) > MOST_ENTRIES:
        raise Untranslatable(f"native loops take functions of scalars; an array has shape {tuple(shape)}")
    array = np.empty(len(values), object)
    array[:] = values
    return array.reshape(shape) if shape else values[0]


def map_entries(emit: Callable[[list[ir.Value]], ir.Value], operands: Sequence[Any]) -> Any:
    """Emit an element-wise primitive on scalars, or entry by entry on arrays; axes of length 1 broadcast."""
    shapes = [operand.shape for operand in operands if isinstance(operand, np.ndarray)]
    if not shapes:
        return emit(list(operands))
    shape = np.broadcast_shapes(*shapes)
    rows = [list(np.broadcast_to(operand, shape).flat) for operand in operands]
    return array_of([emit(list(numbers)) for numbers in zip(*rows, strict=True)], shape)


def _call(lanes: Translator, operands: list[Any], equation: Equation) -> list[Any]:
    params = equation.params
    return lanes.run(params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"], operands)


def _branches(lanes: Translator, operands: list[Any], equation: Equation) -> list[Any]:
    """Emit `cond` or `switch`: all lanes run every branch, and some take part in it."""
    index, *operands = operands
    branches, b = equation.params["branches"], lanes.builder
    chosen: list[Any] = []
    for k, branch in enumerate(branches):
        symbol = "<=" if k == 0 else (">=" if k == len(branches) - 1 else "==")
        is_here = b.icmp_signed(symbol, index, lanes.constant(k, INT))
        with _taking_part(lanes, is_here):
            results = lanes.run(branch, operands)
        choose = functools.partial(_choose, lanes, is_here)
        chosen = list(map(choose, results, chosen)) if chosen else results
    return chosen


def _choose(lanes: Translator, condition: ir.Value, if_true: Any, if_false: Any) -> Any:
    return map_entries(lambda pair: lanes.builder.select(condition, *pair), [if_true, if_false])


@contextlib.contextmanager
def _taking_part(lanes: Translator, mask: ir.Value) -> Iterator[None]:
    """Restrict the lanes that take part, for which inner loops continue, to those of a mask."""
    before = lanes.taking_part
    lanes.taking_part = mask if before is None else lanes.builder.and_(before, mask)
    yield
    lanes.taking_part = before


class _Carry:
    """Values in variables on the stack."""

    def __init__(self, lanes: Translator, values: Sequence[Any]):
        self.lanes, self.values = lanes, values
        self.rooms = [lanes.room(entry.type) for value in values for entry in entries(value)]
        self.types = [entry.type for value in values for entry in entries(value)]
        self.store(values)

    def store(self, values: Sequence[Any]) -> None:
        flat = [entry for value in values for entry in entries(value)]
        for entry, room in zip(flat, self.rooms, strict=True):
            self.lanes.builder.store(entry, room)

    def load(self) -> list[Any]:
        loaded = [self.lanes.builder.load(room, typ=type_) for room, type_ in zip(self.rooms, self.types, strict=True)]
        remaining = iter(loaded)
        return [like(value, remaining) for value in self.values]


@contextlib.contextmanager
def _loop(lanes: Translator, make_condition: Callable[[], ir.Value]) -> Iterator[None]:
    """Write a loop that repeats the code emitted inside while the condition holds."""
    b = lanes.builder
    test, body, after = (b.append_basic_block(name) for name in ("test", "body", "after"))
    b.branch(test)
    b.position_at_end(test)
    b.cbranch(make_condition(), body, after)
    b.position_at_end(body)
    yield
    b.branch(test)
    b.position_at_end(after)


def _while(lanes: Translator, operands: list[Any], equation: Equation) -> list[Any]:
    params, b = equation.params, lanes.builder
    num_cond, num_body = params["cond_nconsts"], params["body_nconsts"]
    cond_consts, body_consts = operands[:num_cond], operands[num_cond : num_cond + num_body]
    carry = _Carry(lanes, operands[num_cond + num_body :])
    everyone = lanes.constant(1, BOOL)
    live = _Carry(lanes, [everyone if lanes.taking_part is None else lanes.taking_part])

    def is_unfinished() -> ir.Value:
        (goes_on,) = lanes.run(params["cond_jaxpr"], [*cond_consts, *carry.load()])
        (before,) = live.load()
        now = b.and_(before, goes_on)
        live.store([now])
        return lanes.any(now)

    with _loop(lanes, is_unfinished):
        before, (mask,) = carry.load(), live.load()
        with _taking_part(lanes, mask):
            after = lanes.run(params["body_jaxpr"], [*body_consts, *before])
        carry.store([_choose(lanes, mask, new, old) for new, old in zip(after, before, strict=True)])
    return carry.load()


def _scan(lanes: Translator, operands: list[Any], equation: Equation) -> list[Any]:
    """Emit a loop, unrolled if it reads or writes arrays."""
    params, length = equation.params, equation.params["length"]
    num_consts, num_carry = _scan_sizes(params)
    consts, carry = operands[:num_consts], operands[num_consts : num_consts + num_carry]
    arrays, num_written = operands[num_consts + num_carry :], len(equation.outvars) - num_carry
    if not arrays and not num_written:
        return _counted(lanes, length, carry, lambda carry: lanes.run(params["jaxpr"], [*consts, *carry]))
    if length > MOST_ENTRIES:
        raise Untranslatable(f"native loops unroll a scan over arrays for {MOST_ENTRIES} steps at most; got {length}")
    written: list[Any] = [None] * length
    for step in reversed(range(length)) if params["reverse"] else range(length):
        results = lanes.run(params["jaxpr"], [*consts, *carry, *(array[step] for array in arrays)])
        carry, written[step] = results[:num_carry], results[num_carry:]
    stacked = []
    for k in range(num_written):
        flat = [entry for row in written for entry in entries(row[k])]
        stacked.append(array_of(flat, result_of(equation, num_carry + k).shape))
    return [*carry, *stacked]


def _scan_sizes(params: Params) -> tuple[int, int]:
    """Return the numbers of constants and of carried values of a scan."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()  # JAX 0.12
    return len(list(consts)), len(list(carry))


def _counted(lanes: Translator, length: int, values: list[Any], step: Callable[[list[Any]], list[Any]]) -> list[Any]:
    """Emit a loop of a fixed number of steps."""
    b, carry, count = lanes.builder, _Carry(lanes, values), _Carry(lanes, [INT(0)])
    with _loop(lanes, lambda: b.icmp_signed("<", count.load()[0], INT(length))):
        carry.store(step(carry.load()))
        count.store([b.add(count.load()[0], INT(1))])
    return carry.load()


def _broadcast(operand: Any, params: Params) -> Any:
    shape, dimensions = params["shape"], params["broadcast_dimensions"]
    if not isinstance(operand, np.ndarray):
        return array_of([operand] * math.prod(shape), shape)
    inner = [1] * len(shape)
    for size, dimension in zip(operand.shape, dimensions, strict=True):
        inner[dimension] = size
    return np.broadcast_to(operand.reshape(inner), shape)


def _slice(operand: Any, params: Params) -> Any:
    starts, limits = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or (1,) * len(starts)
    return operand[tuple(map(slice, starts, limits, strides))]


def _shaped(make: Callable[[Any, Params], Any]) -> Emitter:
    """Make an emitter of a primitive that rearranges the entries of one array."""

    def emit(lanes: Translator, operands: list[Any], equation: Equation) -> list[Any]:
        result = make(operands[0], equation.params)
        return [array_of(entries(result), result_of(equation).shape)]

    return emit


def _concatenate(lanes: Translator, operands: list[Any], equation: Equation) -> list[Any]:
    return [np.concatenate(operands, axis=equation.params["dimension"])]


def _stack(lanes: Translator, operands: list[Any], equation: Equation) -> list[Any]:
    shape, axis = result_of(equation).shape, equation.params["axis"]
    flat = [entry for operand in operands for entry in entries(operand)]
    first = [len(operands), *np.delete(shape, axis).tolist()]
    return [np.moveaxis(array_of(flat, first), 0, axis)]


def _reduction(name: str) -> Emitter:
    """Make an emitter that reduces axes by an element-wise primitive."""

    def emit(lanes: Translator, operands: list[Any], equation: Equation) -> list[Any]:
        (array,), axes = operands, equation.params["axes"]

        def combine(x: ir.Value, y: ir.Value) -> ir.Value:
            return PRIMITIVES[name](lanes, [x, y], equation)

        kept = np.moveaxis(array, axes, range(len(axes)))
        rows = kept.reshape(math.prod(kept.shape[: len(axes)]), -1)
        result = result_of(equation)
        # Sums begin with 0 as in XLA, which matters if all addends are −0.
        first = [lanes.constant(0, scalar_type(result.dtype))] if name == "add" else []
        return [array_of([functools.reduce(combine, [*first, *column]) for column in rows.T], result.shape)]

    return emit


STRUCTURE: dict[str, Emitter] = {
    **dict.fromkeys(CALLS, _call),
    "broadcast_in_dim": _shaped(_broadcast),
    "concatenate": _concatenate,
    "cond": _branches,
    "optimization_barrier": lambda lanes, operands, _: operands,
    "reduce_and": _reduction("and"),
    "reduce_max": _reduction("max"),
    "reduce_min": _reduction("min"),
    "reduce_or": _reduction("or"),
    "reduce_prod": _reduction("mul"),
    "reduce_sum": _reduction("add"),
    "reshape": _shaped(lambda operand, _: operand),
    "rev": _shaped(lambda operand, params: np.flip(operand, params["dimensions"])),
    "scan": _scan,
    "slice": _shaped(_slice),
    "stack": _stack,
    "squeeze": _shaped(lambda operand, _: operand),
    "transpose": _shaped(lambda operand, params: np.transpose(operand, params["permutation"])),
    "while": _while,
}
"""Emitters by the name of the primitive."""
