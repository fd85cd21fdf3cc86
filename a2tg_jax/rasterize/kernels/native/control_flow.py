"""Branches and loops of lanes.

Lanes are independent, so that some may take a branch or leave a loop while others do not. Every branch runs, and its
results are chosen lane by lane; a loop runs until the last lane has left it.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence

from jax.extend import core
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import Step, Value, Values, entries, map_entries, rebuilt_like
from a2tg_jax.rasterize.kernels.native.vectors import BOOL, INT, Translator


def branches(
    lanes: Translator, index: ir.Value, jaxprs: Sequence[core.ClosedJaxpr], operands: Values[ir.Value]
) -> Values[ir.Value]:
    """Emit `cond` or `switch`: all lanes run every branch, and some take part in it."""
    b = lanes.builder
    chosen: Values[ir.Value] = []
    for k, branch in enumerate(jaxprs):
        symbol = "<=" if k == 0 else (">=" if k == len(jaxprs) - 1 else "==")
        is_here = b.icmp_signed(symbol, index, lanes.constant(k, INT))
        with _taking_part(lanes, is_here):
            results = lanes.run(branch, operands)
        choose = functools.partial(_choose, lanes, is_here)
        chosen = list(map(choose, results, chosen)) if chosen else results
    return chosen


def loop(
    lanes: Translator, values: Values[ir.Value], test: Callable[[Values[ir.Value]], ir.Value], step: Step[ir.Value]
) -> Values[ir.Value]:
    """Emit a loop that runs until `test` fails in the last lane."""
    b, carry = lanes.builder, _Carry(lanes, values)
    everyone = lanes.constant(1, BOOL)
    live = _Carry(lanes, [everyone if lanes.taking_part is None else lanes.taking_part])

    def is_unfinished() -> ir.Value:
        goes_on = test(carry.load())
        (before,) = live.load()
        now = b.and_(before, goes_on)
        live.store([now])
        return lanes.any(now)

    with _loop(lanes, is_unfinished):
        before, (mask,) = carry.load(), live.load()
        with _taking_part(lanes, mask):
            after = step(before)
        carry.store([_choose(lanes, mask, new, old) for new, old in zip(after, before, strict=True)])
    return carry.load()


def fixed_loop(lanes: Translator, length: int, values: Values[ir.Value], step: Step[ir.Value]) -> Values[ir.Value]:
    """Emit a loop of a fixed number of steps."""
    b, carry, count = lanes.builder, _Carry(lanes, values), _Carry(lanes, [INT(0)])
    with _loop(lanes, lambda: b.icmp_signed("<", count.load()[0], INT(length))):
        carry.store(step(carry.load()))
        count.store([b.add(count.load()[0], INT(1))])
    return carry.load()


def _choose(
    lanes: Translator, condition: ir.Value, if_true: Value[ir.Value], if_false: Value[ir.Value]
) -> Value[ir.Value]:
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

    def __init__(self, lanes: Translator, values: Values[ir.Value]):
        self.lanes, self.values = lanes, values
        self.rooms = [lanes.room(entry.type) for value in values for entry in entries(value)]
        self.types = [entry.type for value in values for entry in entries(value)]
        self.store(values)

    def store(self, values: Values[ir.Value]) -> None:
        flat = [entry for value in values for entry in entries(value)]
        for entry, room in zip(flat, self.rooms, strict=True):
            self.lanes.builder.store(entry, room)

    def load(self) -> Values[ir.Value]:
        loaded = [self.lanes.builder.load(room, typ=type_) for room, type_ in zip(self.rooms, self.types, strict=True)]
        remaining = iter(loaded)
        return [rebuilt_like(value, remaining) for value in self.values]


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
