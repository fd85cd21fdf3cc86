"""Jaxprs as native loops: random ones made of every primitive, accuracy, and what is refused."""

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

from a2tg_jax.rasterize.kernels.jaxprs import CALLS, FORMULAS, Untranslatable, _primitives
from a2tg_jax.rasterize.kernels.native.lanes import PRIMITIVES


class Op(NamedTuple):
    """A function of scalars, the kinds of its arguments and result (float, integer, bool), and whether it is
    the same to the bit however it is computed."""

    name: str
    function: Callable
    arguments: str
    result: str
    is_exact: bool = True


def tame(x):
    """A float as a multiple of 1/4 up to 64, if it is finite: products and sums of two such are exact."""
    held = jnp.clip(jnp.floor(x * 4) / 4, -64, 64)
    return jnp.where(jnp.abs(x) < jnp.inf, held, x)


def whole(x):
    return x.astype(jnp.int64 if x.dtype == jnp.float64 else jnp.int32)


def as_bits(x):
    return lax.bitcast_convert_type(x, np.dtype(f"int{8 * x.dtype.itemsize}"))


@jax.custom_jvp
def custom(x, y):
    return x + y


custom.defjvp(lambda primals, tangents: (custom(*primals), sum(tangents)))


@jax.custom_vjp
def custom_reverse(x, y):
    return x - y


custom_reverse.defvjp(lambda x, y: (x - y, None), lambda _, g: (g, -g))


FLOATS = [
    *(Op(name, getattr(lax, name), "f", "f") for name in ("abs", "neg", "sign", "floor", "ceil", "square")),
    *(Op(name, getattr(lax, name), "ff", "f") for name in ("add", "sub", "mul", "max", "min")),
    *(Op(name, getattr(lax, name), "ff", "b") for name in ("eq", "ne", "lt", "le", "gt", "ge")),
    Op("relu", lambda x: jnp.maximum(x, 0), "f", "f"),
    Op("clip", lambda x: jnp.clip(x, -1, 1), "f", "f"),
    Op("below zero", lambda x: jnp.minimum(-0.0, x), "f", "f"),
    Op("select_n", lax.select_n, "bff", "f"),
    Op("integer_pow", lambda x: lax.integer_pow(x, 2), "f", "f"),
    Op("stop_gradient", lax.stop_gradient, "f", "f"),
    Op("to integer", whole, "f", "i"),
    Op("to bool", lambda x: x.astype(bool), "f", "b"),
    Op("bitcast", lambda x: as_bits(jnp.where(x != x, 0, x)), "f", "i"),
]
INTEGERS = [
    *(Op(f"{name} i", getattr(lax, name), "ii", "i") for name in (
        "add", "sub", "mul", "div", "max", "min", "bitwise_and", "bitwise_or", "shift_right_arithmetic")),
    *(Op(f"{name} i", getattr(lax, name), "ii", "b") for name in ("eq", "ne", "lt", "le", "gt", "ge")),
    *(Op(f"{name} i", getattr(lax, name), "i", "i") for name in ("neg", "sign", "abs", "bitwise_not")),
    Op("whole power i", lambda x: lax.integer_pow(x, 5), "i", "i"),
    Op("select of three", lambda k, x, y: lax.select_n(jnp.clip(k, 0, 2), x, y, x), "iff", "f"),
    Op("i to float", lambda x, y: x.astype(y.dtype), "if", "f"),
    Op("i to int32", lambda x: x.astype(jnp.int32).astype(x.dtype), "i", "i"),
    Op("i to bool", lambda x: x.astype(bool), "i", "b"),
    *(Op(f"{name} b", getattr(lax, name), "bb", "b") for name in ("bitwise_and", "bitwise_or", "ne", "lt")),
    Op("not b", lax.bitwise_not, "b", "b"),
    Op("b to float", lambda x, y: x.astype(y.dtype), "bf", "f"),
    Op("b to integer", lambda x, y: x.astype(y.dtype), "bi", "i"),
]  # fmt: skip
ELEMENTARY = [
    *(
        Op(name, getattr(lax, name), "f", "f", False)
        for name in ("exp", "log", "logistic", "sin", "cos", "tanh", "sqrt")
    ),
    *(Op(name, getattr(lax, name), "ff", "f", False) for name in ("pow", "div")),
    Op("negative power", lambda x: x**-3, "f", "f", False),
    Op("gradient", jax.grad(lambda x, y: jnp.exp(x * 0.125) * jnp.cos(y)), "ff", "f", False),
    Op("single or double", lambda x: x.astype(jnp.float32).astype(x.dtype), "f", "f", False),
]
CALLED = [
    Op("jit", jax.jit(lambda x, y: x - y), "ff", "f"),
    Op("remat2", jax.checkpoint(lambda x, y: x + y), "ff", "f"),
    Op("custom_jvp_call", custom, "ff", "f"),
    Op("custom_vjp_call", custom_reverse, "ff", "f"),
]
OPS = FLOATS + INTEGERS + ELEMENTARY + CALLED


def random_program(rng: np.random.Generator):
    """A function of floats x, y, z, integers i, j, and bool p, that applies every op, in random
    order, to arguments or earlier results; and which op made each of its results."""
    made: dict[str, list[int]] = {kind: [] for kind in "fib"}
    steps = []
    for index, kind in enumerate("fffiib"):
        made[kind].append(index)
    for op in rng.permutation(np.arange(len(OPS))):
        op = OPS[op]
        steps.append((op, [int(rng.choice(made[kind])) for kind in op.arguments]))
        if op.is_exact:
            made[op.result].append(6 + len(steps) - 1)

    def program(*inputs):
        values = list(inputs)
        for op, arguments in steps:
            value = op.function(*(values[k] for k in arguments))
            values.append(tame(value) if op.is_exact and op.result == "f" else value)
        return values[6:]

    return program, [op for op, _ in steps]


def random_inputs(rng: np.random.Generator, dtype: str, num: int) -> list[np.ndarray]:
    bits = 8 * np.dtype(dtype).itemsize
    floats = np.array([0, -0.0, np.nan, np.inf, -np.inf, 1, -1, 0.5, -0.25, 2.5, -3.75, 17, -60], dtype)
    integers = np.array([0, 1, -1, 2, -3, 7, 31, 32, 100, 2 ** (bits - 1) - 1, -(2 ** (bits - 1))], f"int{bits}")
    signed = [rng.choice(integers, num) for _ in range(2)]
    return [*(rng.choice(floats, num) for _ in range(3)), *signed, rng.choice([False, True], num)]


def assert_same(found: np.ndarray, expected: np.ndarray, op: Op, program) -> None:
    assert found.dtype == expected.dtype
    is_same = found == expected
    if not op.is_exact:
        tolerance = 1e-5 if found.dtype == np.float32 else 1e-12
        is_same = np.isclose(found, expected, rtol=tolerance, atol=tolerance * 1e-2, equal_nan=True)
    elif found.dtype.kind == "f":
        is_same = is_same & (np.signbit(found) == np.signbit(expected)) | np.isnan(found) & np.isnan(expected)
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
    found = run_native(program, inputs, width)
    expected = run_xla(program, inputs)
    as_text = lambda: jax.make_jaxpr(program)(*(array[0] for array in inputs))  # noqa: E731
    for one, other, op in zip(found, expected, ops, strict=True):
        assert_same(one, other, op, as_text)


def test_every_primitive_is_tried_and_in_the_manual():
    program, _ = random_program(np.random.default_rng(0))
    inputs = random_inputs(np.random.default_rng(0), "float32", 1)
    tried = _primitives(jax.make_jaxpr(program)(*(array[0] for array in inputs)))
    # Under other names, or in other versions of JAX.
    aliases = {"add_any", "stop_gradient", "pjit", "closed_call", "core_call", "call", "remat", "checkpoint"}
    aliases |= {"custom_vjp_call_jaxpr"}
    translated = PRIMITIVES.keys() | FORMULAS | CALLS
    assert translated - tried - aliases == set()
    text = (Path(__file__).resolve().parents[1] / "docs" / "compiler.md").read_text(encoding="utf-8")
    table = text.partition("## What is translated")[2].partition("\n## ")[0]
    rows = "".join(line for line in table.splitlines() if line.startswith("| "))
    assert set(re.findall(r"`(\w+)`", rows)) == translated


ACCURACY = {"exp": (np.exp, 0.9), "log": (np.log, 0.9), "logistic": (special.expit, 2.3), "sin": (np.sin, 1.0)}
"""In units in the last place of float32."""


@pytest.mark.filterwarnings("ignore:(divide|invalid|overflow):RuntimeWarning")
@pytest.mark.parametrize("name", ACCURACY)
def test_elementary_functions_are_as_accurate_as_they_say(name):
    reference, limit = ACCURACY[name]
    rng = np.random.default_rng(0)
    sizes = 2.0 ** np.concatenate([rng.uniform(-30, 127, 4096), rng.uniform(-4, 7, 12288)])
    x = (sizes * rng.choice([-1, 1], len(sizes))).astype(np.float32)
    found = run_native(getattr(lax, name), [x], 16)[0]
    expected = reference(x.astype(np.float64))
    is_normal = np.isfinite(expected) & (np.abs(expected) > 2.0**-125) & (np.abs(expected) < np.finfo(np.float32).max)
    unit = np.spacing(np.abs(expected[is_normal]).astype(np.float32)).astype(np.float64)
    assert np.max(np.abs(found[is_normal] - expected[is_normal]) / unit) <= limit


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lax.digamma, "'digamma'"),
        (lambda x: jnp.sum(jnp.stack([x, -x])), "'stack'|'broadcast_in_dim'"),
        (lambda x: lax.fori_loop(0, 3, lambda k, y: y * x, x), "'scan'|'while'"),
        (lambda x: lax.cond(x > 0, lambda: x, lambda: -x), "'cond'"),
        (lambda x: x.astype(jnp.bfloat16).astype(x.dtype), "bfloat16"),
        (lambda x: x.astype(jnp.uint32).astype(x.dtype), "uint32"),
        (lambda x: jax.pure_callback(np.sin, x, x), "'pure_callback'"),
    ],
)
def test_what_cannot_be_translated_is_named(function, words):
    with pytest.raises(Untranslatable, match=words):
        run_native(function, [np.ones(8, np.float32)], 8)


def test_what_is_made_of_a_function_can_be_read(tmp_path, monkeypatch):
    monkeypatch.setenv("A2TG_DUMP", str(tmp_path / "dump"))
    run_native(lambda x: jnp.cos(x) + 1, [np.ones(8, np.float32)], 8)
    texts = {path.name.partition(".")[2]: path.read_text("utf-8") for path in (tmp_path / "dump").iterdir()}
    assert set(texts) == {"jaxpr", "ll", "optimised.ll", "s"}
    assert "cos" in texts["jaxpr"] and "define void" in texts["ll"] and "<8 x float>" in texts["optimised.ll"]
