"""The platform is chosen when JAX compiles, from where arrays are; CUDA kernels are checked before they draw."""

import functools
import os
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, as_textures, draw_scene

from a2tg_jax import RenderSettings, render_image
from a2tg_jax.rasterize.kernels import platforms
from a2tg_jax.rasterize.kernels.cuda import check, composite, nvrtc
from a2tg_jax.rasterize.kernels.platforms import by_platform
from a2tg_jax.training.losses import mean_ssim

NATIVE = r"custom_call @a2tg_"
CUDA = rf"custom_call @{re.escape('__gpu$xla.gpu.ptx')}"


def image(gaussians, textures=None, **settings):
    camera = as_camera(draw_scene(4, num=8, width=40, height=24), "float32")
    return render_image(gaussians, camera, textures, settings=RenderSettings(capacity=512, **settings)).color


def loss(gaussians, textures=None, **settings):
    color = image(gaussians, textures, **settings)
    return jnp.sum(color) + mean_ssim(color, color**2)


def lowered(platform, function=loss, **settings):
    """A program lowered for a platform: the gradient of a render and of SSIM, or another one."""
    gradient = jax.jit(jax.grad(functools.partial(function, **settings)))
    gaussians = as_gaussians(draw_scene(4, num=8), "float32")
    return gradient.trace(gaussians).lower(lowering_platforms=(platform,)).as_text().replace('"', "")


@pytest.fixture
def fake_nvrtc(monkeypatch):
    """Programs for CUDA are lowered, but their kernels are empty."""
    monkeypatch.setattr(nvrtc, "find", lambda: True)
    monkeypatch.setattr(nvrtc, "ptx", lambda source, capability: "none")
    platforms.has_cuda.cache_clear()
    jax.clear_caches()
    yield
    platforms.has_cuda.cache_clear()


@pytest.mark.usefixtures("fake_nvrtc")
def test_one_function_takes_the_kernels_of_the_platform_that_it_is_lowered_for():
    """On CPUs lists, both passes and both passes of SSIM; on NVIDIA GPUs both passes; elsewhere none."""
    cpu, cuda, rocm = (lowered(platform) for platform in ("cpu", "cuda", "rocm"))
    assert len(re.findall(NATIVE, cpu)) >= 5 and not re.search(CUDA, cpu)
    assert len(re.findall(CUDA, cuda)) == 2 and not re.search(NATIVE, cuda)
    assert not re.search(f"{NATIVE}|{CUDA}", rocm)
    with pytest.raises(ValueError, match="compositor='cuda' needs JAX on an NVIDIA GPU"):
        lowered("cpu", compositor="cuda")
    with pytest.raises(ValueError, match="compositor='native' needs JAX on the CPU"):
        lowered("cuda", compositor="native")


@pytest.mark.long
@pytest.mark.parametrize("compositor", ["xla", "autodiff"])
def test_xla_takes_more_tiles_at_once_elsewhere(compositor):
    """15 tiles one by one on CPUs, else all together."""

    def total(gaussians):
        return jnp.sum(image(gaussians, compositor=compositor, tile_size=8))

    many = [len(re.findall("tensor<15x[0-9x]*64xf32>", lowered(name, total))) for name in ("cpu", "cuda")]
    assert many[0] < many[1]


def code_of(platform, by):
    return lambda x: {"sum": x[0] + by, "name": jnp.int32(len(platform))}


def tripled(x):
    shapes = {"sum": jax.ShapeDtypeStruct((), x.dtype), "name": jax.ShapeDtypeStruct((), jnp.int32)}
    return by_platform(code_of, (3,), shapes, (x,), advice="no slope")


def test_a_function_by_platform_under_transformations():
    """Eagerly, without jit, under vmap of vmap, and in a loop; not differentiated."""
    x = jnp.arange(6.0)
    for run in (tripled, jax.jit(tripled)):
        assert run(x[1]) == {"sum": 4, "name": 3}
        with jax.disable_jit():
            assert run(x[1])["sum"] == 4
    both = jax.vmap(jax.vmap(tripled, out_axes=0), in_axes=1)(x.reshape(2, 3))
    np.testing.assert_array_equal(both["sum"], x.reshape(2, 3).T + 3)
    np.testing.assert_array_equal(jax.lax.map(tripled, x)["sum"], x + 3)
    with pytest.raises(ValueError, match="no slope"):
        jax.grad(lambda x: tripled(x)["sum"])(1.0)


SCRIPT = """
import jax, numpy as np
from test_platforms import image
from scenes_random import as_gaussians, draw_scene
gaussians = as_gaussians(draw_scene(4, num=8), "float32")
found = {}
for device in jax.devices():
    draw = jax.jit(jax.grad(lambda gaussians: image(gaussians).sum()))
    found[device] = draw(jax.device_put(gaussians, device))
    assert all(leaf.devices() == {device} for leaf in jax.tree.leaves(found[device]))
    with jax.default_device(device):
        for a, b in zip(jax.tree.leaves(draw(jax.tree.map(np.asarray, gaussians))), jax.tree.leaves(found[device])):
            np.testing.assert_array_equal(a, b)
first, *others = found.values()
assert len(others) == 1
for other in others:
    jax.tree.map(np.testing.assert_array_equal, first, other)
"""


@pytest.mark.long
def test_each_of_several_devices_draws_the_same(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([os.path.dirname(__file__), *sys.path]))
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def a_gpu(monkeypatch, tmp_path, gpu_kernels):
    """The CPU passes for an NVIDIA GPU, on which "auto" takes the CUDA kernels, run as OpenCL. Returns the cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setitem(platforms.PLATFORMS, "native", "none")
    (device,) = jax.local_devices()
    monkeypatch.setattr(jax, "local_devices", lambda backend: [device])
    platforms.has_cuda.cache_clear()
    jax.clear_caches()
    yield tmp_path / "a2tg-jax"
    platforms.has_cuda.cache_clear()
    jax.clear_caches()


def drawn(compositor="auto"):
    """A textured view; the compositor is chosen inside a trace."""
    scene = draw_scene(4, num=8, width=40, height=24)
    arrays = as_gaussians(scene, "float32"), as_textures(scene, "float32")

    return jax.jit(functools.partial(image, compositor=compositor))(*arrays)


drawn_by_xla = functools.cache(functools.partial(drawn, "xla"))


def assert_drawn_like_xla(found):
    np.testing.assert_allclose(found, drawn_by_xla(), rtol=1e-3, atol=1e-4)


@pytest.mark.long
def test_kernels_that_agree_with_xla_are_used_and_checked_once(a_gpu, monkeypatch):
    checked = []
    run = check.largest_difference
    monkeypatch.setattr(check, "largest_difference", lambda device: checked.append(run(device)) or checked[-1])
    launched = []
    launch_it = composite.launch
    monkeypatch.setattr(composite, "launch", lambda *given: launched.append(given[1]) or launch_it(*given))
    assert_drawn_like_xla(drawn())
    assert launched == ["forward", "backward", "forward"] and len(checked) == 1
    assert checked[0] < 1e-5
    (file,) = a_gpu.iterdir()
    assert file.read_text() == ""
    platforms.has_cuda.cache_clear()
    assert platforms.choose("auto", "cpu") == "cuda" and len(checked) == 1


def fails(*_):
    raise RuntimeError("CUDA_ERROR_ILLEGAL_ADDRESS\nat 0x0")


def stale(spec, name, num_tiles, inputs, results, totals=()):
    """Kernels that run but write nothing."""
    return [*(jnp.zeros(shape.shape, shape.dtype) for shape in results), *totals]


@pytest.mark.long
@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (fails, r"failed: RuntimeError: CUDA_ERROR_ILLEGAL_ADDRESS at 0x0"),
        (stale, r"differ from XLA by 1e\+02 %"),
    ],
)
def test_xla_takes_over_from_kernels_that_are_wrong(a_gpu, monkeypatch, broken, words):
    """The warning is one line, and comes again in the next process, which does not run the kernels again."""
    monkeypatch.setattr(composite, "launch", broken)
    with pytest.warns(UserWarning, match=f"by XLA, which is slower: CUDA kernels {words}; .* delete ") as printed:
        found = drawn() if broken is fails else platforms.choose("auto", "cpu")
    assert len(printed) == 1 and "\n" not in str(printed[0].message)
    if broken is fails:
        assert_drawn_like_xla(found)
    (file,) = a_gpu.iterdir()
    assert str(file) in str(printed[0].message) and file.read_text() in str(printed[0].message)
    platforms.has_cuda.cache_clear()
    monkeypatch.setattr(check, "largest_difference", None)
    with pytest.warns(UserWarning, match="CUDA kernels"):
        assert platforms.choose("auto", "cpu") == "xla"
    assert platforms.choose("cuda", "cpu") == "cuda"


def test_a_cache_folder_that_cannot_be_written_is_done_without(a_gpu, monkeypatch):
    a_gpu.write_text("a file where the folder would be")
    monkeypatch.setattr(check, "largest_difference", lambda device: 0.0)
    assert platforms.choose("auto", "cpu") == "cuda"
