"""The GPU kernels without a GPU: NVRTC compiles them, ptxas counts registers, XLA takes them, OpenCL runs them."""

import dataclasses
import re
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scenes_random import (
    as_camera,
    as_gaussians,
    as_settings,
    as_textures,
    assert_all_close,
    draw_scene,
    quick_then_long,
)

from a2tg_jax import Appearance, RenderSettings, Texture, TextureOptions, combine, partition, render_image
from a2tg_jax.appearance import StaticShading
from a2tg_jax.rasterize.kernels.cuda import nvrtc
from a2tg_jax.rasterize.kernels.cuda.source import PRIMITIVES, Argument, c_function, source
from a2tg_jax.rasterize.kernels.jaxprs import Untranslatable, trace
from a2tg_jax.rasterize.kernels.native import lanes as of_native
from a2tg_jax.rasterize.splats import PassSettings
from a2tg_jax.rasterize.tiles import TileGrid
from a2tg_jax.rasterize.views import render_traced

NOT_PRINTED = {"bitcast_convert_type", "shift_right_arithmetic"}
"""Primitives of the formulas of native loops, which GPU kernels have no use for."""


def source_of(has_textures=True, dtype="float32", tile_size=16, options=TextureOptions()):  # noqa: B008 - frozen
    textures = as_textures(draw_scene(4, num=8), "float32")
    static = StaticShading.of(Appearance(texture=Texture(textures, options=options)) if has_textures else Appearance())
    columns = 4 if has_textures else 0
    settings = PassSettings(static, 0, columns, 3, dtype, TileGrid(0, 0, tile_size), 0.2, True, "position")
    return source(settings, "cuda")


@pytest.fixture
def has_nvrtc():
    if nvrtc.find() is None:
        pytest.skip("NVRTC is not installed: pip install nvidia-cuda-nvrtc")


@pytest.mark.usefixtures("has_nvrtc", "x64")
@pytest.mark.parametrize("has_textures", [False, True])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("tile_size", [5, 16, 24])
def test_nvrtc_compiles_them(has_textures, dtype, tile_size):
    text = source_of(has_textures, dtype, tile_size)
    for capability in ("7.5", "9.0", "12.0"):
        program = nvrtc.ptx(text, capability)
        assert ".entry forward(" in program and ".entry backward(" in program
        assert re.search(r"\b(atom|red)\.[a-z.]*global\.", program)


def test_the_extent_of_textures_is_all_that_differs_in_their_kernels():
    """1/3 becomes 1/1.5 in the lookup, and 3 becomes 1.5 in the comparison."""
    wide, narrow = (source_of(options=TextureOptions(outside="identity", extent=extent)) for extent in (3.0, 1.5))
    moved = wide.replace("0x1.5555560000000p-2f", "0x1.5555560000000p-1f")
    assert moved.replace("<= (0x1.8000000000000p+1f)", "<= (0x1.8000000000000p+0f)") == narrow != wide


@pytest.mark.usefixtures("has_nvrtc")
@pytest.mark.parametrize("has_textures", [False, True])
def test_they_fit_the_registers_of_three_blocks(tmp_path, has_textures):
    """80 registers of 256 threads are a third of those that a processor of an H100 has; few bytes are spilled."""
    if shutil.which("ptxas") is None:
        pytest.skip("ptxas is not installed; it comes with CUDA's compiler")
    (tmp_path / "tiles.ptx").write_text(nvrtc.ptx(source_of(has_textures), "9.0"))
    command = ["ptxas", "-v", "-arch=sm_90", "tiles.ptx", "-o", "tiles.cubin"]
    log = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stderr
    assert max(map(int, re.findall(r"Used (\d+) registers", log))) <= 80
    assert max(map(int, re.findall(r"(\d+) bytes spill", log))) <= 64


def test_nvrtc_tells_what_it_refuses(has_nvrtc):
    with pytest.raises(nvrtc.CompilationError, match=r"(?s)NVRTC refused a kernel.*undefined"):
        nvrtc.ptx('extern "C" __global__ void f(float *x) { *x = nothing; }', "9.0")


@pytest.mark.usefixtures("has_nvrtc")
def test_xla_takes_them():
    """A program for CUDA, lowered on a machine without it, launches one kernel each way, a thread a pixel."""
    scene = draw_scene(4, num=8, width=40, height=24)
    gaussians = as_gaussians(scene, "float32")
    camera = as_camera(scene, "float32")

    def loss(gaussians):
        settings = RenderSettings(compositor="cuda", tile_size=16, capacity=512)
        return jnp.sum(render_image(gaussians, camera, settings=settings).color)

    lowered = jax.jit(jax.grad(loss)).trace(gaussians).lower(lowering_platforms=("cuda",)).as_text()
    calls = re.findall(rf"custom_call @{re.escape('__gpu$xla.gpu.ptx')}.*", lowered.replace('"', ""))
    assert len(calls) == 2
    for name, call in zip(("forward", "backward"), calls, strict=True):
        assert f"name = {name}" in call and "block_x = 256" in call and "grid_x = 6 " in call


@pytest.mark.long
@pytest.mark.usefixtures("gpu_kernels", "x64")
@pytest.mark.parametrize(("num", "tile_size", "size"), [(300, 16, (33, 18)), (1, 5, (7, 9)), (90, 24, (24, 30))])
def test_long_lists_and_odd_tiles(num, tile_size, size):
    """More splats than a batch, tiles of several blocks, and tiles that no warp fills, with every texture size."""
    scene = draw_scene(7, num=num, width=size[0], height=size[1])
    gaussians = as_gaussians(scene, "float64")
    camera = as_camera(scene, "float64")
    textures = as_textures(scene, "float64")

    def loss(gaussians, buckets, compositor):
        settings = as_settings(compositor=compositor, tile_size=tile_size)
        shown = dataclasses.replace(textures, buckets=buckets)
        output = render_image(gaussians, camera, shown, settings=settings)
        return jnp.sum(output.color**2) + jnp.sum(output.depth) + jnp.sum(output.normal * output.color), output

    differentiate = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
    reference = "xla" if jax.default_backend() == "gpu" else "native"
    found, wanted = (differentiate(gaussians, textures.buckets, name) for name in ("cuda", reference))
    for a, b in zip(jax.tree.leaves(wanted), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-11 * max(1.0, float(jnp.abs(a).max(initial=0))))


@pytest.mark.usefixtures("gpu_kernels")
@pytest.mark.parametrize(
    ("has_textures", "statistic"),
    quick_then_long([(False, "position")], [(True, "position"), (False, "screen"), (False, "center")]),
)
def test_gpu_kernels_are_those_of_xla(has_textures, statistic):
    """Interpreted, on a small scene: the image, the gradient, and a statistic."""
    scene = draw_scene(4, num=16, width=19, height=13)
    gaussians = as_gaussians(scene, "float32")
    camera = as_camera(scene, "float32")
    appearance = Appearance(texture=Texture(as_textures(scene, "float32"))) if has_textures else Appearance()
    floats, rest = partition(appearance)

    def loss(gaussians, floats, probe, compositor):
        settings = RenderSettings(compositor=compositor, capacity=1024)
        shown = combine(floats, rest)
        output, _ = render_traced(gaussians, camera, shown, jnp.ones(3), settings, probe=probe, statistic=statistic)
        return jnp.sum(output.color**2) + jnp.sum(output.depth) + jnp.sum(output.normal * output.color), output

    differentiate = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True), static_argnums=3)
    inputs = gaussians, floats, jnp.zeros((gaussians.num, 4))
    wanted, found = (differentiate(*inputs, name) for name in ("xla", "cuda"))
    assert wanted[0][1].alpha.max() > 0.5 and wanted[1][2][:, 3].max() > 10
    assert_all_close(found, wanted, 1e-4, 2e-5)


def test_every_primitive_of_native_loops_is_printed():
    assert set(of_native.PRIMITIVES) - set(PRIMITIVES) == NOT_PRINTED
    assert set(PRIMITIVES) <= set(of_native.PRIMITIVES)


def program(x, y):
    """All that is printed."""
    whole = x.astype(jnp.int32)
    return (
        *(x + y, x - y, x * y, x / y, -x, jnp.sqrt(abs(x)), lax.square(x), lax.integer_pow(y, -3), abs(x) ** 2.5),
        *(jnp.clip(x, -1, y), jnp.minimum(x, y), jnp.maximum(x, y), jnp.sign(x), jnp.floor(x), jnp.ceil(y)),
        *(x == y, x != y, x < y, x <= y, x > y, x >= y, ~(x < y), (x > 0) & (y > 0), (x > 0) | (y > 0)),
        *(lax.div(whole, jnp.int32(3)), whole.astype(x.dtype), jnp.sign(whole), abs(whole), ~whole | (whole & 6)),
        *(whole.astype(bool), jnp.where(x > 0, x, y), lax.select_n(jnp.clip(whole, 0, 2), x, y, x + 1)),
        *(lax.stop_gradient(x), jnp.exp(x), jnp.log(abs(y)), jnp.sin(x), jnp.cos(y), jnp.tanh(x), jax.nn.sigmoid(y)),
    )


@pytest.mark.usefixtures("gpu_kernels", "x64")
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_printed_functions_compute_what_xla_does(dtype):
    import opencl

    numbers = [0.0, -0.0, 1.5, -2.75, 0.1, 31.0, -1e-3, np.inf, -np.inf, np.nan, 3e9, -3e9]
    x, y = (np.array(pair, dtype) for pair in zip(*[(a, b) for a in numbers for b in numbers], strict=True))
    closed, _ = trace(program, *[jax.ShapeDtypeStruct((), dtype)] * 2)
    real = {"float32": "float", "float64": "double"}[dtype]
    wanted = jax.jit(jax.vmap(program))(x, y)
    found = opencl.evaluate(closed, real, x, y)
    for index, (a, b) in enumerate(zip(wanted, found, strict=True)):
        tolerance = 1e-5 if dtype == "float32" else 1e-12
        np.testing.assert_allclose(b, np.asarray(a, np.float64), rtol=tolerance, atol=tolerance, err_msg=str(index))


@pytest.mark.parametrize(
    ("function", "words"),
    [(lax.digamma, "'digamma'"), (lambda x: x.astype(jnp.bfloat16).astype(x.dtype), "bfloat16")],
)
def test_what_cannot_be_printed_is_named(function, words):
    closed, _ = trace(function, jax.ShapeDtypeStruct((), "float32"))
    with pytest.raises(Untranslatable, match=words):
        c_function("f", closed, [Argument("x")], [Argument("y")])
