"""Importing the package: public names, what it loads, and that it changes no setting of JAX."""

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "a2tg_jax"
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def test_one_module_tells_systems_apart():
    """The C library's mathematics has another name on Windows, and a report names the system."""
    asking = re.compile(r"sys\.platform|os\.name\b|import (fcntl|msvcrt|resource)\b|sched_getaffinity")
    found = [path for path in MODULES if asking.search(path.read_text(encoding="utf-8"))]
    assert {path.relative_to(PACKAGE).as_posix() for path in found} == {
        "base/operating_system.py",
        "rasterize/kernels/native/llvm_code.py",
        "results/report.py",
    }


def test_the_library_names_no_command():
    """Neither in messages nor in docstrings. The rooms of the library are those of the contract of `lint-imports`."""
    settings = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    (rooms,) = [
        c["source_modules"] for c in settings["contracts"] if c["name"].startswith("The library has no command")
    ]
    paths = [path for path in MODULES if f"a2tg_jax.{path.relative_to(PACKAGE).with_suffix('').parts[0]}" in rooms]
    assert len(paths) > 80
    for path in paths:
        found = re.findall(r"\ba2tg [a-z]+|[ (`]--[a-z-]+", path.read_text(encoding="utf-8"))
        assert not found, (path, found)


def test_import_leaves_jax_alone():
    """The import compiles nothing, starts no device, and leaves configuration and environment as they were."""
    script = """
import os, jax
before = dict(jax.config.values), dict(os.environ)
import a2tg_jax, a2tg_jax.host.startup, a2tg_jax.training, a2tg_jax.render
now = {name: jax.config.values[name] for name in before[0]}  # JAX's own modules may bring options of their own.
assert now == before[0], "configuration changed"
assert dict(os.environ) == before[1], "environment changed"
from jax._src import xla_bridge
assert not xla_bridge._backends, "a device was started"
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


HEAVY = {"PIL", "matplotlib", "pycolmap", "scipy.ndimage", "skimage"}


def test_import_loads_no_more_than_it_needs_and_is_silent():
    """Neither readers of photographs and COLMAP models nor libraries for pictures. jaxopt warns when it is imported."""
    script = f"""
import importlib, sys
unwanted = {HEAVY | {"scipy", "jaxopt", "llvmlite"}}
for name in ("a2tg_jax", "a2tg_jax.model"):
    importlib.import_module(name)
    found = {{each for each in sys.modules if each in unwanted or each.startswith("a2tg_jax.data.")}}
    assert not found, (name, found)
    unwanted = {HEAVY}
import a2tg_jax.core.optim
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_lazy_names_are_those_that_type_checkers_see():
    """Each is the one that its module defines, and no other is public."""
    package = importlib.import_module("a2tg_jax")
    tree = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    homes = {a.name: node.module for node in tree.body if isinstance(node, ast.ImportFrom) for a in node.names}
    assert package.__all__ == sorted(homes) and set(homes) <= set(dir(package))
    for public, home in homes.items():
        assert getattr(package, public) is getattr(importlib.import_module(f"a2tg_jax.{home}"), public)
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = package.no_such_name


def test_public_names_in_a_fresh_process():
    """A star import, a function beside a module of its name, modules as attributes; all without the extra [train]."""
    script = """
import sys
sys.modules |= dict.fromkeys(("matplotlib", "pycolmap", "skimage"))
import a2tg_jax
from a2tg_jax.training import fit as function
assert callable(a2tg_jax.fit) and a2tg_jax.fit is function
assert a2tg_jax.adapt.Upscale is a2tg_jax.Upscale and a2tg_jax.load_scene is a2tg_jax.data.load.load_scene
from a2tg_jax import *
assert fit is function and Model is a2tg_jax.model.Model
from a2tg_jax.cli.main import main
sys.exit(main(["demo"]))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    remedy = "a2tg: error: this command needs matplotlib, which is not installed: pip install 'a2tg-jax[train]'\n"
    assert done.returncode == 2 and done.stderr == remedy, done.stderr


def test_the_first_function_of_a_process_is_traced_once():
    """Nothing that rendering imports on its first use changes the key of what is compiled."""
    script = """
import jax, a2tg_jax as a2tg
scene = a2tg.synthetic_scene(num_views=3, width=16, height=12, num_points=20)
gaussians, camera = a2tg.init_from_points(scene.points, scene.colors), scene.train[0].camera
settings = a2tg.RenderSettings(capacity=512)
draw = jax.jit(jax.grad(lambda g: a2tg.render_image(g, camera, settings=settings).color.sum()))
draw(draw(gaussians))
assert draw._cache_size() == 1, draw._cache_size()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_equations_name_functions_that_exist():
    text = (PACKAGE.parent / "docs" / "equations.md").read_text(encoding="utf-8")
    names = re.findall(r"`((?:[a-z_0-9]+\.)+\w+)`", text)
    assert len(names) > 30
    for name in names:
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(f"a2tg_jax.{module}"), attribute), f"{name} does not exist"
