"""Strictness for every test: no silent promotion of dtypes or ranks, warnings are errors (pyproject.toml)."""

import os

from xla_flags import TEST_FLAGS

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("XLA_FLAGS", TEST_FLAGS)  # Command lines that tests start inherit them.

import gc
import importlib
import pathlib
import sys

import jax
import psutil
import pytest

from a2tg_jax import set_num_threads
from a2tg_jax.base.operating_system import trim_heap

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Tracing makes so many objects that their collection takes a fifteenth of the tests' time.
gc.set_threshold(100_000, 50, 50)

SHARED = pathlib.Path(__file__).resolve().parents[2] / "shared"
READERS = pathlib.Path(__file__).resolve().parents[1] / "docs" / "reference"


LONGEST = {
    "test_bytewise", "test_devices", "test_experiments", "test_processes", "test_systems", "test_training",
    "test_viewer_browser",
}  # fmt: skip
"""Files that come first, so that no process is left with one of them while the others have nothing to do."""
MOST_BYTES = 2.5e9
"""Memory of a process beyond which compiled programs are dropped: about 6,000 pieces of memory on Linux."""
OTHER_KERNELS = {"test_gpu_kernels", "test_losses", "test_platforms"}
"""Modules whose programs are made of other kernels than those of this machine."""


def pytest_addoption(parser):
    parser.addoption("--long", action="store_true", help="run the tests marked `long` as well")


def pytest_xdist_auto_num_workers(config):
    """One file runs in this process. Otherwise there is one worker more than cores, since tests wait for processes."""
    args = config.args if config.args_source == pytest.Config.ArgsSource.ARGS else []
    if len(args) == 1 and ".py" in args[0]:
        return 0
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 7) + 1


def pytest_collection_modifyitems(config, items):
    """Skips the tests marked `long` without --long; the longest files come first."""
    items.sort(key=lambda item: item.path.stem not in LONGEST)
    if not config.getoption("--long"):
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(pytest.mark.skip(reason="takes long: pytest --long"))


def pytest_collection_finish():
    """What was imported stays: no collection looks at it again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def fresh_caches(request):
    """Compiled programs are dropped before there are too many. They take memory, in pieces of which a process may only
    have so many, and XLA waits for ever where it gets none (vm.max_map_count)."""
    yield
    if request.module.__name__ in OTHER_KERNELS or psutil.Process().memory_info().rss > MOST_BYTES:
        jax.clear_caches()
        gc.collect()
        trim_heap()


@pytest.fixture
def untouched_jax(monkeypatch):
    """Commands leave the flags of the tests' process as they are."""
    from a2tg_jax.cli import main as cli

    monkeypatch.setattr(cli, "configure_cpu", lambda: None)


@pytest.fixture
def x64():
    """Runs the test with 64-bit floats."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def threads(monkeypatch):
    """Neither `set_num_threads` nor the environment has set a number of threads, nor does the test's stay."""
    monkeypatch.delenv("A2TG_NUM_THREADS", raising=False)
    set_num_threads(None)
    yield
    set_num_threads(None)


@pytest.fixture
def shared():
    """The folder of real scenes and LPIPS weights; the test is skipped where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"real scenes and LPIPS weights are not at {SHARED}")
    return SHARED


@pytest.fixture
def gpu_kernels(monkeypatch):
    """Runs the GPU kernels: on JAX's GPU if it has one (JAX_PLATFORMS=cuda,cpu), else on the CPU, as OpenCL."""
    if jax.default_backend() == "gpu":
        return
    import opencl

    from a2tg_jax.rasterize.kernels import platforms
    from a2tg_jax.rasterize.kernels.cuda import composite, nvrtc

    opencl.queue()
    monkeypatch.setitem(platforms.PLATFORMS, "cuda", "cpu")
    monkeypatch.setattr(nvrtc, "find", lambda: True)
    monkeypatch.setattr(composite, "launch", opencl.launch)


@pytest.fixture(autouse=True)
def kernels_of_the_compositor(request):
    """The kernels that a test's parameter `compositor` asks for."""
    wanted = request.node.callspec.params.get("compositor") if hasattr(request.node, "callspec") else None
    if wanted == "cuda":
        request.getfixturevalue("gpu_kernels")
    elif wanted == "native" and jax.default_backend() != "cpu":
        pytest.skip("native loops run on CPUs")


@pytest.fixture(scope="module")
def reference():
    """The reference reader and renderer; none of their modules is left behind."""
    names = {path.stem for path in READERS.glob("*.py")}
    sys.path.insert(0, str(READERS))
    try:
        yield importlib.import_module("read_model").read_model, importlib.import_module("draw").draw
    finally:
        sys.path.remove(str(READERS))
        for name in names:
            sys.modules.pop(name, None)
