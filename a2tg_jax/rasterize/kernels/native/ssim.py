"""Native score of two images: the average over windows of a function of the means of x, y, x² + y² and x·y.

    score(x, y, sums, d_means, rows; first, last, channels, height, width)
    pull_back(x, y, d_mean, d_squares, d_product, share, d_x, rows; the same)

Windows are separable; their T taps go down the columns first, then along the row. `score` computes the rows
first..last − 1 of windows, counted through all channels; `pull_back` computes such rows of pixels.

Buffers: x, y and d_x [C, height, width]; sums [C·down] of the scores of each row, of down × across windows; d_means
[4, C, down + 2·(T − 1), across] derivatives of the scores by each mean, between margins of zeros; d_mean, d_squares and
d_product three of these; share [1] the weight of each score; rows: workspace for the sums of columns.
"""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import example, trace
from a2tg_jax.rasterize.kernels.native import ffi, llvm_code
from a2tg_jax.rasterize.kernels.native.lanes import Lanes
from a2tg_jax.rasterize.kernels.native.llvm_code import INT, LONG, CompiledFunction, Writer
from a2tg_jax.rasterize.kernels.score import Score

SCORE = ("x", "y", "sums", "d_means", "rows")
PULL_BACK = ("x", "y", "d_mean", "d_squares", "d_product", "share", "d_x", "rows")
INTEGERS = ("first", "last", "channels", "height", "width")
LEAST_PIXELS = 10_000
"""Least number of pixels that is worth another thread."""


def least_width(dtype: DTypeLike, num_taps: int) -> int:
    """Return the least width of an image: the windows of a row must fill a vector."""
    return llvm_code.num_lanes(dtype) + num_taps - 1


def value_and_slopes(score: Score, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the average over all windows of images [C, H, W], float32 or float64, at least `least_width` wide; and its
    derivatives by x and y."""
    count, height, width = x.shape
    margin = len(score.taps) - 1
    down = height - margin
    across = width - margin
    shapes = (count * down,), (4, count, down + 2 * margin, across)
    name = _registered(score, str(x.dtype), "score")
    sums, (d_x_mean, d_y_mean, *d_products) = ffi.call(name, [(shape, x.dtype) for shape in shapes], x, y)
    num_windows = count * down * across
    share = jnp.full(1, 1 / num_windows, x.dtype)
    name = _registered(score, str(x.dtype), "pull_back")
    # x² + y² and x·y are symmetric: the derivative by y is the one by x with the images and their means exchanged.
    slope = [(x.shape, x.dtype)]
    (d_x,) = ffi.call(name, slope, x, y, d_x_mean, *d_products, share)
    (d_y,) = ffi.call(name, slope, y, x, d_y_mean, *d_products, share)
    return jnp.sum(sums) / num_windows, d_x, d_y


def _registered(score: Score, dtype: str, name: Literal["score", "pull_back"]) -> str:
    function = getattr(score.function, "__qualname__", type(score.function).__name__)
    margin = len(score.taps) - 1

    def make_handler() -> ffi.Handler:
        run = _compiled(score, dtype)[name]

        def handler(arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
            count, height, width = arguments[0].shape
            if name == "score":
                num_rows = len(results[0])
                # `pull_back` reads T rows of windows for each row of pixels, also at the edges.
                results[1][:, :, :margin] = 0
                results[1][:, :, -margin:] = 0
            else:
                num_rows = count * height

            def part(first: int, last: int, _: int) -> None:
                # Four means of a row; or three rows of windows, between margins that stay zero.
                rows = np.zeros(4 * width if name == "score" else 3 * (width + margin), dtype)
                pointers = (array.ctypes.data for array in (*arguments, *results, rows))
                run(*pointers, first, last, count, height, width)

            least_rows = max(1, num_rows * LEAST_PIXELS // arguments[0].size)
            ffi.run_spans(part, ffi.even_spans(num_rows, least_rows))

        return handler

    rank = 1 if name == "score" else 3
    return ffi.registered(f"ssim {name} {dtype} {function} {score.taps}", (name, dtype, score), rank, make_handler)


class _ImageRows(Writer):
    """Base of the writers of both functions."""

    def __init__(self, module: ir.Module, name: str, buffers: Sequence[str], score: Score, dtype: str):
        super().__init__(module, name, buffers, INTEGERS, dtype)
        self.score = score
        self.margin = len(score.taps) - 1
        self.lanes = Lanes(self.b, llvm_code.num_lanes(dtype))
        self.reals = self.lanes.vector(self.real)
        self.channels, self.height, self.width = (self.long(self.arguments[name]) for name in INTEGERS[2:])
        self.down = self.b.sub(self.height, LONG(self.margin))
        self.across = self.b.sub(self.width, LONG(self.margin))

    def loop_over_rows(self) -> contextlib.AbstractContextManager[tuple[ir.Value, ir.Block]]:
        return self.loop(self.long(self.arguments["first"]), self.long(self.arguments["last"]))

    @contextlib.contextmanager
    def vectors(self, num: ir.Value) -> Iterator[tuple[ir.Value, ir.Value]]:
        """Write a loop over `num` numbers, L at a time; the last vector may overlap the one before.

        Yields:
          The start of each vector, and how many of its numbers the vector before contains.
        """
        b = self.b
        length = LONG(self.lanes.width)
        with self.loop(LONG(0), b.sdiv(b.add(num, LONG(self.lanes.width - 1)), length)) as (k, _):
            # The last vector begins L numbers before the end, so that no code for a remainder is needed.
            place = b.mul(k, length)
            last = b.sub(num, length)
            start = b.select(b.icmp_signed("<", place, last), place, last)
            yield start, b.sub(place, start)

    def row(self, name: str, index: ir.Value, length: ir.Value) -> ir.Value:
        return self.at(self.arguments[name], self.b.mul(index, length), self.real)

    def weighed(self, numbers: Sequence[ir.Value], taps: Sequence[float]) -> ir.Value:
        weights = [self.lanes.constant(tap, self.real) for tap in taps]
        return functools.reduce(self.sum, map(self.product, numbers, weights))

    def along(self, base: ir.Value, start: ir.Value, stride: ir.Value, num: int | None = None) -> list[ir.Value]:
        """Load the vectors of numbers under a window's taps, or under `num` of them, from `start` on."""
        num = self.margin + 1 if num is None else num
        places = [self.b.add(start, self.times(stride, i)) for i in range(num)]
        return [self.load(self.at(base, place, self.real), 0, self.reals) for place in places]

    def put(self, vector: ir.Value, base: ir.Value, start: ir.Value) -> None:
        self.store(vector, self.at(base, start, self.real), 0)


class _ScoreRows(_ImageRows):
    def write(self, dtype: str) -> None:
        b = self.b
        with_slopes, _ = trace(jax.value_and_grad(self.score.function, argnums=(0, 1, 2, 3)), *[example(dtype)] * 4)
        lane = ir.Constant(self.lanes.vector(INT), list(range(self.lanes.width)))
        total = self.variable(self.reals)
        zero = self.lanes.constant(0.0, self.real)
        means = [self.row("rows", LONG(k), self.width) for k in range(4)]
        padded = b.add(self.down, LONG(2 * self.margin))
        with self.loop_over_rows() as (index, _):
            channel = b.sdiv(index, self.down)
            y = b.srem(index, self.down)
            self.store_columns(means, b.add(b.mul(channel, self.height), y))
            b.store(zero, total)
            with self.vectors(self.across) as (start, num_done):
                windows = [self.weighed(self.along(mean, start, LONG(1)), self.score.taps) for mean in means]
                value, *slopes = self.lanes.emit(with_slopes, windows)
                # Each score counts once, where vectors overlap.
                is_new = b.icmp_signed(">=", lane, self.lanes.broadcast(b.trunc(num_done, INT)))
                b.store(self.sum(b.load(total, typ=self.reals), b.select(is_new, value, zero)), total)
                for k, slope in enumerate(slopes):
                    row = b.mul(b.add(self.times(self.channels, k), channel), padded)
                    row = b.add(row, b.add(y, LONG(self.margin)))
                    self.put(slope, self.row("d_means", row, self.across), start)
            self.store(self.lanes.sums([b.load(total, typ=self.reals)])[0], self.arguments["sums"], index)
        b.ret_void()

    def store_columns(self, means: Sequence[ir.Value], first: ir.Value) -> None:
        """Store each column's weighted sums of x, y, x² + y² and x·y over the rows of a window, from `first` on."""
        with self.vectors(self.width) as (start, _):
            xs = self.along(self.row("x", first, self.width), start, self.width)
            ys = self.along(self.row("y", first, self.width), start, self.width)
            squares = [self.sum(self.product(p, p), self.product(q, q)) for p, q in zip(xs, ys, strict=True)]
            products = list(map(self.product, xs, ys))
            for mean, numbers in zip(means, (xs, ys, squares, products), strict=True):
                self.put(self.weighed(numbers, self.score.taps), mean, start)


class _PullBackRows(_ImageRows):
    def write(self) -> None:
        b = self.b
        taps = self.score.taps[::-1]
        length = b.add(self.width, LONG(self.margin))
        rows = [self.row("rows", LONG(k), length) for k in range(3)]
        share = self.load(self.arguments["share"], 0, self.real)
        two = self.lanes.broadcast(self.real(2.0))
        share = self.lanes.broadcast(share)
        with self.loop_over_rows() as (index, _):
            channel = b.sdiv(index, self.height)
            y = b.srem(index, self.height)
            first = b.add(b.mul(channel, b.add(self.height, LONG(self.margin))), y)
            with self.vectors(self.across) as (start, _):
                for name, row in zip(PULL_BACK[2:5], rows, strict=True):
                    column = self.along(self.row(name, first, self.across), start, self.across)
                    self.put(self.weighed(column, taps), row, b.add(start, LONG(self.margin)))
            with self.vectors(self.width) as (start, _):
                d_mean, d_squares, d_product = (self.weighed(self.along(row, start, LONG(1)), taps) for row in rows)
                (x,) = self.along(self.row("x", index, self.width), start, LONG(1), num=1)
                (y,) = self.along(self.row("y", index, self.width), start, LONG(1), num=1)
                # d(x² + y²)/dx = 2x and d(x·y)/dx = y.
                by_x = self.sum(self.product(self.product(two, x), d_squares), self.product(y, d_product))
                self.put(self.product(share, self.sum(d_mean, by_x)), self.row("d_x", index, self.width), start)
        b.ret_void()


@functools.cache
def _compiled(score: Score, dtype: str) -> dict[str, CompiledFunction]:
    """Return the functions `score` and `pull_back`, compiled at the first call."""
    module = ir.Module("windows")
    forward = llvm_code.unique("score")
    backward = llvm_code.unique("pull_back")
    _ScoreRows(module, forward, SCORE, score, dtype).write(dtype)
    _PullBackRows(module, backward, PULL_BACK, score, dtype).write()
    signatures = {forward: (len(SCORE), len(INTEGERS)), backward: (len(PULL_BACK), len(INTEGERS))}
    return dict(zip(("score", "pull_back"), llvm_code.compiled(module, signatures), strict=True))
