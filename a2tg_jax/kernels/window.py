"""The mean under a separable window, natively: SSIM's eleven taps, down a column and then along the row.

    window(images, means, row; first, last, height, width)

makes the rows `first` to `last` of the means, counted through all images; buffers: images [C, height, width], means
[C, height − T + 1, width − T + 1] for T taps, row [width] for the columns' sums.
"""

import functools
import hashlib
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax import Array
from llvmlite import ir

from a2tg_jax.kernels import foreign, library, threads
from a2tg_jax.kernels.lanes import FLAGS, Lanes
from a2tg_jax.kernels.writer import LONG, Writer

BUFFERS = ("images", "means", "row")
INTEGERS = ("first", "last", "height", "width")
LEAST_NUMBERS = 20_000
"""Fewer means than this are not worth another thread."""


def window_mean(images: Array, taps: Sequence[float]) -> Array:
    """[C, H, W] → [C, H−T+1, W−T+1]: Σ_ij taps_i·taps_j·images[c, y+i, x+j], for rows of at least `least_width`."""
    count, height, width = images.shape
    name = f"a2tg_window_{images.dtype}_{hashlib.sha256(repr(taps).encode()).hexdigest()[:16]}"
    foreign.register(name, functools.partial(_handler, _compiled(str(images.dtype), tuple(taps)), len(taps)))
    shape = jax.ShapeDtypeStruct((count, height - len(taps) + 1, width - len(taps) + 1), images.dtype)
    return jax.ffi.ffi_call(name, shape, vmap_method="sequential")(images)


def least_width(dtype, num_taps: int) -> int:
    """The narrowest image that the loops can do: its means fill a vector."""
    return library.vector_bytes() // np.dtype(dtype).itemsize + num_taps - 1


def _handler(run: Any, num_taps: int, arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
    (images,), (means,) = arguments, results
    _, height, width = images.shape

    def part(first: int, last: int, _: int) -> None:
        row = np.empty(width, images.dtype)
        run(images.ctypes.data, means.ctypes.data, row.ctypes.data, first, last, height, width)

    num_rows = means.shape[0] * means.shape[1]
    threads.run_spans(part, threads.even_spans(num_rows, max(1, LEAST_NUMBERS // width)))


class _Window(Writer):
    def __init__(self, module: ir.Module, name: str, dtype: str, taps: Sequence[float]):
        super().__init__(module, name, BUFFERS, INTEGERS, dtype)
        self.lanes, self.taps = Lanes(self.b, library.vector_bytes() // np.dtype(dtype).itemsize), taps

    def write(self) -> None:
        b, given = self.b, {name: self.arguments[name] for name in BUFFERS}
        height, width = (self.long(self.arguments[name]) for name in ("height", "width"))
        num_rows, num_columns = (b.sub(size, LONG(len(self.taps) - 1)) for size in (height, width))
        with self.loop(self.long(self.arguments["first"]), self.long(self.arguments["last"])) as (index, _):
            image, y = b.sdiv(index, num_rows), b.srem(index, num_rows)
            source = self.at(given["images"], b.mul(b.add(b.mul(image, height), y), width), self.real)
            self.weigh(source, width, given["row"], width)
            target = self.at(given["means"], b.mul(index, num_columns), self.real)
            self.weigh(given["row"], LONG(1), target, num_columns)
        b.ret_void()

    def weigh(self, source: ir.Value, stride: ir.Value, target: ir.Value, num: ir.Value) -> None:
        """target[x] = Σ_i taps_i·source[x + i·stride] for x < num; the last vector may overlap the one before."""
        b, width, reals = self.b, self.lanes.width, self.lanes.vector(self.real)
        with self.loop(LONG(0), b.sdiv(b.add(num, LONG(width - 1)), LONG(width))) as (k, _):
            x, last = self.times(k, width), b.sub(num, LONG(width))
            x = b.select(b.icmp_signed("<", x, last), x, last)
            total = self.lanes.constant(0.0, self.real)
            for i, tap in enumerate(self.taps):
                numbers = self.load(self.at(source, b.add(x, self.times(stride, i)), self.real), 0, reals)
                product = b.fmul(numbers, self.lanes.constant(tap, self.real), flags=FLAGS)
                total = b.fadd(total, product, flags=FLAGS)
            self.store(total, self.at(target, x, self.real), 0)


_numbers = itertools.count()


@functools.cache
def _compiled(dtype: str, taps: tuple[float, ...]) -> Any:
    module, name = ir.Module("window"), f"window_{next(_numbers)}"
    _Window(module, name, dtype, taps).write()
    return library.as_function(library.compile_module(module)[name], len(BUFFERS), len(INTEGERS))
