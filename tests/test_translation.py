"""Jaxprs as native loops: random ones made of every primitive, control flow, accuracy, and what is refused."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from lane_loop import run_native, run_xla
from scipy import special

from a2tg_jax.rasterize.kernels.jaxprs import CALLS, REDUCTIONS, SHAPES, Untranslatable
from a2tg_jax.rasterize.kernels.native.primitives import PRIMITIVES

STRUCTURE = {*CALLS, *REDUCTIONS, *SHAPES, "cond", "optimization_barrier", "scan", "while"}
AWAY, EVEN = lax.RoundingMethod.AWAY_FROM_ZERO, lax.RoundingMethod.TO_NEAREST_EVEN


class Op(NamedTuple):
    """A function of scalars, the kinds of its arguments and result (float, integer, unsigned, bool), and whether it is
    the same to the bit however it is computed."""

    name: str
    function: Callable
    arguments: str
    result: str
    is_exact: bool = True


def tame(x):
    """A float as a multiple of 1/4 up to 64, if it is finite: products and sums of two such are exact."""
    held = jnp.clip(lax.round(x * 4, EVEN) / 4, -64, 64)
    return jnp.where(jnp.isfinite(x), held, x)


def whole(x):
    return x.astype(jnp.int64 if x.dtype == jnp.float64 else jnp.int32)


def as_unsigned(x):
    return lax.bitcast_convert_type(x, np.dtype(f"uint{8 * x.dtype.itemsize}"))


@jax.custom_jvp
def custom(x, y):
    return x + y


custom.defjvp(lambda primals, tangents: (custom(*primals), sum(tangents)))


@jax.custom_vjp
def custom_reverse(x, y):
    return x - y


custom_reverse.defvjp(lambda x, y: (x - y, None), lambda _, g: (g, -g))


def doubled_until_large(x):
    away = lambda x: x * 2 + jnp.where(x < 0, -1, 1).astype(x.dtype)  # noqa: E731
    return lax.while_loop(lambda c: jnp.abs(c[0]) < 9, lambda c: (away(c[0]), c[1] + 1), (x, jnp.zeros_like(x)))


FLOATS = [
    *(Op(name, getattr(lax, name), "f", "f") for name in ("abs", "neg", "sign", "floor", "ceil", "square")),
    *(Op(name, getattr(lax, name), "ff", "f") for name in ("add", "sub", "mul", "max", "min", "rem")),
    *(Op(name, getattr(lax, name), "ff", "b") for name in ("eq", "ne", "lt", "le", "gt", "ge")),
    Op("round", lambda x: lax.round(x, AWAY), "f", "f"),
    Op("round to even", lambda x: lax.round(x, EVEN), "f", "f"),
    Op("is_finite", lax.is_finite, "f", "b"),
    Op("clamp", lax.clamp, "fff", "f"),
    Op("relu", lambda x: jnp.maximum(x, 0), "f", "f"),
    Op("clip", lambda x: jnp.clip(x, -1, 1), "f", "f"),
    Op("below zero", lambda x: jnp.minimum(-0.0, x), "f", "f"),
    Op("select_n", lax.select_n, "bff", "f"),
    Op("integer_pow", lambda x: lax.integer_pow(x, 2), "f", "f"),
    Op("copy", jnp.copy, "f", "f"),
    Op("stop_gradient", lax.stop_gradient, "f", "f"),
    Op("to integer", whole, "f", "i"),
    Op("to unsigned", lambda x: x.astype(f"uint{8 * x.dtype.itemsize}"), "f", "u"),
    Op("to byte and back", lambda x: x.astype(jnp.int8).astype(x.dtype), "f", "f"),
    Op("to bool", lambda x: x.astype(bool), "f", "b"),
    Op("bitcast", lambda x: as_unsigned(jnp.where(jnp.isnan(x), 0, x)), "f", "u"),
]
INTEGERS = [
    Op(f"{name} {kind}", getattr(lax, name), "xx".replace("x", kind), kind)
    for kind in "iu"
    for name in ("add", "sub", "mul", "div", "rem", "max", "min", "and", "or", "xor")
    for name in ((f"bitwise_{name}",) if name in ("and", "or", "xor") else (name,))
]
INTEGERS += [
    *(Op(f"{name} {kind}", getattr(lax, name), kind * 2, kind) for kind in "iu" for name in (
        "shift_left", "shift_right_logical", "shift_right_arithmetic")),
    *(Op(f"{name} {kind}", getattr(lax, name), kind * 2, "b") for kind in "iu" for name in ("eq", "lt", "ge")),
    *(Op(f"{name} {kind}", getattr(lax, name), kind, kind) for kind in "iu" for name in (
        "sign", "abs", "bitwise_not", "clz", "population_count") if (name, kind) != ("abs", "u")),
    Op("neg i", lax.neg, "i", "i"),
    Op("whole power i", lambda x: lax.integer_pow(x, 5), "i", "i"),
    Op("clamp u", lax.clamp, "uuu", "u"),
    Op("select of three", lambda k, x, y: lax.select_n(lax.rem(abs(k), jnp.full_like(k, 3)), x, y, x), "iff", "f"),
    Op("i to float", lambda x, y: x.astype(y.dtype), "if", "f"),
    Op("u to float", lambda x, y: x.astype(y.dtype), "uf", "f"),
    Op("i to short", lambda x: x.astype(jnp.int16).astype(x.dtype), "i", "i"),
    Op("u to short", lambda x: x.astype(jnp.uint16).astype(x.dtype), "u", "u"),
    Op("i to unsigned", as_unsigned, "i", "u"),
    Op("i to bool", lambda x: x.astype(bool), "i", "b"),
    *(Op(f"{name} b", getattr(lax, name), "bb", "b") for name in ("bitwise_and", "bitwise_or", "bitwise_xor", "lt")),
    Op("not b", lax.bitwise_not, "b", "b"),
    Op("b to float", lambda x, y: x.astype(y.dtype), "bf", "f"),
    Op("b to integer", lambda x, y: x.astype(y.dtype), "bi", "i"),
]  # fmt: skip
ELEMENTARY = [
    *(Op(name, getattr(lax, name), "f", "f", False) for name in (
        "exp", "exp2", "expm1", "log", "log1p", "logistic", "tanh", "sin", "cos", "tan", "asin", "acos", "atan", "sinh",
        "cosh", "asinh", "acosh", "atanh", "erf", "erfc", "cbrt", "sqrt", "rsqrt")),
    *(Op(name, getattr(lax, name), "ff", "f", False) for name in ("pow", "atan2", "div", "nextafter")),
    Op("power of integer", lax.pow, "fi", "f", False),
    Op("negative power", lambda x: x**-3, "f", "f", False),
    Op("gradient", jax.grad(lambda x, y: jnp.exp(x * 0.125) * jnp.cos(y)), "ff", "f", False),
    Op("single or double", lambda x: x.astype(jnp.float32).astype(x.dtype), "f", "f", False),
]  # fmt: skip
CONTROL = [
    Op("jit", jax.jit(lambda x, y: x - y), "ff", "f"),
    Op("remat2", jax.checkpoint(lambda x, y: x + y), "ff", "f"),
    Op("custom_jvp_call", custom, "ff", "f"),
    Op("custom_vjp_call", custom_reverse, "ff", "f"),
    Op("optimization_barrier", lax.optimization_barrier, "f", "f"),
    Op("cond", lambda p, x, y: lax.cond(p, lambda x, y: x + y, lambda x, y: x - y, x, y), "bff", "f"),
    Op("switch", lambda k, x, y: lax.switch(k, [lambda: x, lambda: y, lambda: x + y, lambda: x - y]), "iff", "f"),
    Op("scan", lambda x, y: lax.fori_loop(0, 4, lambda k, c: tame(c + y), x), "ff", "f"),
    Op("while", lambda x: doubled_until_large(x)[0], "f", "f"),
    Op("while in cond", lambda p, x: lax.cond(p, lambda: doubled_until_large(x)[1], lambda: x), "bf", "f"),
    Op("stacked scan", lambda x, y: lax.scan(lambda c, z: (tame(c + z), c), x, jnp.stack([x, y, x]))[1][2], "ff", "f"),
    Op("reductions", lambda x, y: jnp.max(jnp.stack([x, y])) + jnp.min(jnp.stack([y, x])), "ff", "f"),
    Op("array", lambda x, y: jnp.sum(jnp.flip(jnp.stack([x, y])) * jnp.asarray([1, -2], x.dtype)), "ff", "f"),
    Op("grid", lambda x, y: jnp.sum((jnp.stack([x, y])[:, None] * jnp.asarray([[1, 2]], x.dtype)).T[1]), "ff", "f"),
    Op("all", lambda p, q: jnp.all(jnp.stack([p, q])) | jnp.any(jnp.stack([q, p])[:1]), "bb", "b"),
    Op("joined", lambda x, y: jnp.concatenate([jnp.stack([x, y]), x.reshape(1)]).reshape(3, 1)[2, 0], "ff", "f"),
    Op("product", lambda x: tame(jnp.prod(jnp.broadcast_to(x, (3,)))), "f", "f"),
]
OPS = FLOATS + INTEGERS + ELEMENTARY + CONTROL


def primitives_of(jaxpr) -> set[str]:
    """The names of all primitives in a jaxpr and the jaxprs within."""
    found = set()
    for equation in jaxpr.eqns:
        found.add(equation.primitive.name)
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns")):
            if hasattr(inner, "eqns"):
                found |= primitives_of(inner)
    return found


def random_program(rng: np.random.Generator):
    """A function of floats x, y, z, integers i, j, unsigned u and v, and bool p, that applies every op, in random
    order, to arguments or earlier results; and which op made each of its results."""
    made: dict[str, list[int]] = {kind: [] for kind in "fiub"}
    steps = []
    for index, kind in enumerate("fffiiuub"):
        made[kind].append(index)
    for op in rng.permutation(np.arange(len(OPS))):
        op = OPS[op]
        steps.append((op, [int(rng.choice(made[kind])) for kind in op.arguments]))
        if op.is_exact:
            made[op.result].append(8 + len(steps) - 1)

    def program(*inputs):
        values = list(inputs)
        for op, arguments in steps:
            value = op.function(*(values[k] for k in arguments))
            values.append(tame(value) if op.is_exact and op.result == "f" else value)
        return values[8:]

    return program, [op for op, _ in steps]


def random_inputs(rng: np.random.Generator, dtype: str, num: int) -> list[np.ndarray]:
    bits = 8 * np.dtype(dtype).itemsize
    floats = np.array([0, -0.0, np.nan, np.inf, -np.inf, 1, -1, 0.5, -0.25, 2.5, -3.75, 17, -60], dtype)
    integers = np.array([0, 1, -1, 2, -3, 7, 31, 32, 100, 2 ** (bits - 1) - 1, -(2 ** (bits - 1))], f"int{bits}")
    signed = [rng.choice(integers, num) for _ in range(4)]
    unsigned = [array.view(f"uint{bits}") for array in signed[2:]]
    return [*(rng.choice(floats, num) for _ in range(3)), *signed[:2], *unsigned, rng.choice([False, True], num)]


def assert_same(found: np.ndarray, expected: np.ndarray, op: Op, program) -> None:
    assert found.dtype == expected.dtype
    if not op.is_exact:
        tolerance = 1e-5 if found.dtype == np.float32 else 1e-12
        is_same = np.isclose(found, expected, rtol=tolerance, atol=tolerance * 1e-2, equal_nan=True)
    elif found.dtype.kind == "f":
        is_same = (found == expected) & (np.signbit(found) == np.signbit(expected)) | np.isnan(found) & np.isnan(
            expected
        )
    else:
        is_same = found == expected
    if not is_same.all():
        k = int(np.argmin(is_same))
        raise AssertionError(f"'{op.name}': lane {k} is {found[k]!r}, not {expected[k]!r}, in\n{program()}")


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("width", [1, 4, 8, 16])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_random_programs_are_those_of_xla(dtype, width):
    rng = np.random.default_rng(width)
    inputs = random_inputs(rng, dtype, 256)
    program, ops = random_program(rng)
    found, expected = run_native(program, inputs, width), run_xla(program, inputs)
    as_text = lambda: jax.make_jaxpr(program)(*(array[0] for array in inputs))  # noqa: E731
    for one, other, op in zip(found, expected, ops, strict=True):
        assert_same(one, other, op, as_text)


def test_every_primitive_is_tried():
    program, _ = random_program(np.random.default_rng(0))
    inputs = random_inputs(np.random.default_rng(0), "float32", 1)
    tried = primitives_of(jax.make_jaxpr(program)(*(array[0] for array in inputs)).jaxpr)
    # Under other names, or in other versions of JAX.
    aliases = {"add_any", "copy_p", "stop_gradient", "pjit", "closed_call", "core_call", "call", "remat", "checkpoint"}
    aliases |= {"custom_vjp_call_jaxpr"}
    assert (set(PRIMITIVES) | STRUCTURE) - tried - aliases == set()


@pytest.mark.parametrize("width", [1, 8])
def test_loops_run_as_often_as_they_say(width):
    """A scan, a while loop that lanes leave at different times, and the gradient of a scan, through stacked values."""

    def steps(x, y):
        return lax.fori_loop(0, 4, lambda k, c: c * 2 + y, x)

    def halvings(x):
        return lax.while_loop(lambda c: c[0] > 1, lambda c: (c[0] / 2, c[1] + 1), (x, jnp.int32(0)))[1]

    x, y = np.full(8, 0.5, np.float32), np.full(8, 1.0, np.float32)
    assert run_native(steps, [x, y], width)[0].tolist() == [23.0] * 8
    powers = np.asarray([0.5, 1, 2, 4, 8, 1024, 2.0**30, 3], np.float32)
    assert run_native(halvings, [powers], width)[0].tolist() == [0, 0, 1, 2, 3, 10, 30, 2]
    slope = jax.grad(lambda x, y: lax.fori_loop(0, 3, lambda k, c: c * c + y, x))
    np.testing.assert_allclose(run_native(slope, [x, y], width)[0], run_xla(slope, [x, y])[0], rtol=1e-6)


ACCURACY = {
    "exp": (np.exp, 0.9),
    "exp2": (np.exp2, 0.9),
    "expm1": (np.expm1, 1.4),
    "log": (np.log, 0.9),
    "log1p": (np.log1p, 1.0),
    "logistic": (special.expit, 2.3),
    "tanh": (np.tanh, 1.5),
    "sin": (np.sin, 1.6),
    "cos": (np.cos, 1.6),
    "tan": (np.tan, 3.5),
    "atan": (np.arctan, 2.5),
    "erf": (special.erf, 2.5),
    "rsqrt": (lambda x: 1 / np.sqrt(x), 1.5),
}
"""In units in the last place of float32, as the docstrings of `elementary` state."""


@pytest.mark.filterwarnings("ignore:(divide|invalid|overflow):RuntimeWarning")
@pytest.mark.parametrize("name", ACCURACY)
def test_elementary_functions_are_as_accurate_as_they_say(name):
    reference, limit = ACCURACY[name]
    rng = np.random.default_rng(0)
    sizes = 2.0 ** np.concatenate([rng.uniform(-30, 127, 4096), rng.uniform(-4, 7, 12288)])
    x = (sizes * rng.choice([-1, 1], len(sizes))).astype(np.float32)
    found, expected = run_native(getattr(lax, name), [x], 16)[0], reference(x.astype(np.float64))
    is_normal = np.isfinite(expected) & (np.abs(expected) > 2.0**-125) & (np.abs(expected) < np.finfo(np.float32).max)
    unit = np.spacing(np.abs(expected[is_normal]).astype(np.float32)).astype(np.float64)
    assert np.max(np.abs(found[is_normal] - expected[is_normal]) / unit) <= limit


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lax.digamma, "'digamma'"),
        (lambda x: jnp.sort(jnp.stack([x, -x]))[0], "'sort'"),
        (lambda x: x.astype(jnp.bfloat16).astype(x.dtype), "bfloat16"),
        (lambda x: jnp.sum(jnp.broadcast_to(x, (1000,))), "shape .1000,."),
        (lambda x: lax.scan(lambda c, _: (c + x, c), x, None, length=300)[1][7], "256 steps"),
        (lambda x: jax.pure_callback(np.sin, x, x), "'pure_callback'"),
    ],
)
def test_what_cannot_be_translated_is_named(function, words):
    with pytest.raises(Untranslatable, match=words):
        run_native(function, [np.ones(8, np.float32)], 8)


def test_what_is_made_of_a_function_can_be_read(tmp_path, monkeypatch):
    monkeypatch.setenv("A2TG_DUMP", str(tmp_path / "dump"))
    run_native(lambda x: jnp.tanh(x) + 1, [np.ones(8, np.float32)], 8)
    texts = {path.name.partition(".")[2]: path.read_text("utf-8") for path in (tmp_path / "dump").iterdir()}
    assert set(texts) == {"jaxpr", "ll", "optimised.ll", "s"}
    assert "tanh" in texts["jaxpr"] and "define void" in texts["ll"] and "<8 x float>" in texts["optimised.ll"]


def test_the_manual_lists_the_primitives():
    text = (Path(__file__).resolve().parents[1] / "docs" / "compiler.md").read_text(encoding="utf-8")
    _, _, table = text.partition("## What is translated")
    table = table.partition("\n## ")[0]
    rows = "".join(line for line in table.splitlines() if line.startswith("| "))
    assert set(re.findall(r"`(\w+)`", rows)) == set(PRIMITIVES) | STRUCTURE
