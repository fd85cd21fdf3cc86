"""Elementary functions of float32 from arithmetic, as JAX functions: traced once, then translated as all others.

Errors are in units in the last place (ulp), measured against float64 over the whole range. Results below 2⁻¹²⁵ may be
zero, and arguments below 2⁻¹²⁶ count as zero, as XLA flushes subnormal numbers on CPUs.

The coefficients are minimax fits of this project.
"""

import math

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

LN2_HIGH, LN2_LOW = 0.693359375, -2.12194440e-4
"""ln 2 in two parts; the first has trailing zeros, so that its product with a small integer is exact."""
HALF_PI = [float(np.float32(part)) for part in (1.5703125, 4.837512969970703e-4, 7.549790126404332e-8)]
"""π/2 in three parts, the first two with trailing zeros."""
LARGEST_ANGLE = 3000.0
"""Largest |x| for which the bounds of `sin`, `cos` and `tan` hold."""


def _polynomial(x: Array, *coefficients: float) -> Array:
    """Return Σ coefficients[k]·xᵏ."""
    total = coefficients[-1] * jnp.ones_like(x)
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def _round(x: Array, bias: int = 0) -> tuple[Array, Array]:
    """Return the nearest integer n, |n| < 2²², as a float, and bits whose lowest ones are those of n + bias."""
    magic = 1.5 * 2**23 + bias
    shifted = x + magic
    return shifted - magic, lax.bitcast_convert_type(shifted, jnp.int32)


def _half_power(bits: Array) -> Array:
    """Return 2^(n − 1), or 0 for n = −126, from the bits of `_round` with bias 126."""
    return lax.bitcast_convert_type(bits << 23, jnp.float32)


def _hold(x: Array, low: float, high: float) -> Array:
    """Return x clipped to [low, high]; NaN stays NaN."""
    x = jnp.where(x < low, low, x)
    return jnp.where(x > high, high, x)


def _twice_exp(r: Array) -> Array:
    """Return 2·exp(r) for |r| <= ln 2 / 2."""
    tail = _polynomial(r, 0.99999988079, 0.33333042264, 0.08333677798, 0.01673742011, 0.00276292209)
    return (tail * r + 2.0) * r + 2.0


def exp(x: Array) -> Array:
    """Return exp(x) to 0.9 ulp: 2ⁿ·exp(r) with r = x − n·ln 2."""
    # Beyond these limits the result is 0 or ∞.
    x = _hold(x, -87.5, 89.0)
    n, bits = _round(x * math.log2(math.e), bias=126)
    r = (x - n * LN2_HIGH) - n * LN2_LOW
    return _twice_exp(r) * _half_power(bits)


def exp2(x: Array) -> Array:
    """Return 2ˣ to 0.9 ulp."""
    x = _hold(x, -126.0, 129.0)
    n, bits = _round(x, bias=126)
    return _twice_exp((x - n) * math.log(2)) * _half_power(bits)


def expm1(x: Array) -> Array:
    """Return exp(x) − 1 to 1.4 ulp: 2ⁿ·(exp(r) − 1) + (2ⁿ − 1)."""
    held = _hold(x, -20.0, 89.0)
    n, bits = _round(held * math.log2(math.e), bias=126)
    r = (held - n * LN2_HIGH) - n * LN2_LOW
    tail = _polynomial(r, 0.5, 0.16666665673, 0.04166636243, 0.00833338965, 0.00139406172, 0.00019845876)
    half = _half_power(bits)
    result = 2 * (half * (tail * r * r + r) + (half - 0.5))
    return jnp.where(jnp.abs(x) < 1e-5, x * (1 + 0.5 * x), result)


def _log_of_parts(f: Array, n: Array, correction: Array | float) -> Array:
    """Return log(2ⁿ·(1 + f)) + correction for 1 + f in [√½, √2]."""
    tail = _polynomial(
        f, 0.33333313465, -0.25000008941, 0.20002119243, -0.16667996347, 0.14219550789,
        -0.12405591458, 0.11888174713, -0.11675640941, 0.06746601313,
    )  # fmt: skip
    square = f * f
    low = tail * f * square - 0.5 * square + (correction + n * LN2_LOW)
    return (f + low) + n * LN2_HIGH


def _parts(x: Array) -> tuple[Array, Array]:
    """Return f and n with x = 2ⁿ·(1 + f), 1 + f in [√½, √2], for positive x."""
    bits = lax.bitcast_convert_type(x, jnp.int32)
    exponent = (bits - 0x3F3504F3) >> 23
    return lax.bitcast_convert_type(bits - (exponent << 23), jnp.float32) - 1.0, exponent.astype(jnp.float32)


def _log_at_ends(x: Array, result: Array) -> Array:
    """Return a logarithm with its values at 0, at ∞, below 0 and for NaN put in."""
    result = jnp.where(x < np.finfo(np.float32).tiny, jnp.where(x < 0, np.nan, -np.inf), result)
    return jnp.where(x < np.inf, result, x)


def log(x: Array) -> Array:
    """Return the natural logarithm to 1 ulp."""
    return _log_at_ends(x, _log_of_parts(*_parts(x), 0.0))


def log1p(x: Array) -> Array:
    """Return log(1 + x) to 1 ulp: log(u) plus the rounding error of u = 1 + x, divided by u."""
    u = 1.0 + x
    rest = jnp.where(x > 1, 1.0 - (u - x), x - (u - 1.0)) / u
    result = _log_at_ends(u, _log_of_parts(*_parts(u), rest))
    return jnp.where(jnp.abs(x) < 1e-5, x - 0.5 * x * x, result)


def tanh(x: Array) -> Array:
    """Return tanh(x) to 1.5 ulp."""
    size, square = jnp.abs(x), x * x
    tail = _polynomial(
        square, -0.33333331347, 0.13333210349, -0.05394720286, 0.02170296758, -0.00818267372, 0.00214753696
    )
    near = jnp.where(x == 0, x, x + x * square * tail)
    far = 1.0 - 2.0 / (exp(size + size) + 1.0)
    return jnp.where(size < 0.625, near, jnp.where(x < 0, -far, far))


def _sine_and_cosine(x: Array) -> tuple[Array, Array, Array]:
    """Return sine and cosine of x − n·π/2, and bits whose lowest ones are those of n."""
    n, bits = _round(x * (2 / math.pi))
    r = ((x - n * HALF_PI[0]) - n * HALF_PI[1]) - n * HALF_PI[2]
    square = r * r
    sine = r + r * square * _polynomial(square, -0.16666667163, 0.00833332911, -0.00019839335, 2.718312e-6)
    tail = _polynomial(square, 0.04166666791, -0.00138888834, 2.479952e-5, -2.7210237e-7)
    return sine, 1.0 - 0.5 * square + square * square * tail, bits


def sin(x: Array) -> Array:
    """Return sin(x) to 1.6 ulp for |x| <= LARGEST_ANGLE."""
    sine, cosine, n = _sine_and_cosine(x)
    result = jnp.where((n & 1) != 0, cosine, sine)
    return jnp.where(x == 0, x, jnp.where((n & 2) != 0, -result, result))


def cos(x: Array) -> Array:
    """Return cos(x), with the bound of `sin`."""
    sine, cosine, n = _sine_and_cosine(x)
    result = jnp.where((n & 1) != 0, sine, cosine)
    return jnp.where(((n + 1) & 2) != 0, -result, result)


def tan(x: Array) -> Array:
    """Return tan(x) to 3.5 ulp for |x| <= LARGEST_ANGLE."""
    sine, cosine, n = _sine_and_cosine(x)
    is_odd = (n & 1) != 0
    return jnp.where(x == 0, x, jnp.where(is_odd, -cosine, sine) / jnp.where(is_odd, sine, cosine))


def atan(x: Array) -> Array:
    """Return atan(x) to 2.5 ulp; the argument is reduced to below tan(π/8)."""
    size = jnp.abs(x)
    is_large, is_medium = size > 1 + math.sqrt(2), size > math.sqrt(2) - 1
    above, below = jnp.where(is_large, -1.0, size - 1.0), jnp.where(is_large, size, size + 1.0)
    reduced = jnp.where(is_medium, above / below, size)
    offset = jnp.where(is_large, math.pi / 2, jnp.where(is_medium, math.pi / 4, 0.0))
    square = reduced * reduced
    tail = _polynomial(square, -0.33333316445, 0.1999848932, -0.14243848622, 0.10595998168, -0.06083445624)
    result = offset + (reduced + reduced * square * tail)
    return jnp.where(x < 0, -result, jnp.where(x == 0, x, result))


def erf(x: Array) -> Array:
    """Return erf(x) to 2.5 ulp."""
    square = x * x
    near = x * _polynomial(
        square, 1.1283792257, -0.3761263788, 0.1128378212, -0.02686540037, 0.00522094546, -0.00084828287,
        0.00011256948, -9.6415147e-6,
    )  # fmt: skip
    size = jnp.where(jnp.abs(x) > 3.95, 3.95, jnp.abs(x))
    exponent = _polynomial(
        size, -0.00018847029, 1.12958037853, 0.63321638107, 0.1084221229, -0.02521035634, 0.00420529069,
        -0.00044147388, 2.16977e-5,
    )  # fmt: skip
    far = 1.0 - exp(-exponent)
    return jnp.where(jnp.abs(x) < 1, near, jnp.where(x < 0, -far, jnp.where(x >= 1, far, x)))


FORMULAS = {function.__name__: function for function in (exp, exp2, expm1, log, log1p, tanh, sin, cos, tan, atan, erf)}
