"""Imports run downward only, and importing the package changes no setting of JAX."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "a2tg_jax"
LAYERS = (
    {"control_groups"},
    {"classes", "cores", "memory", "json_text"},
    {"numerics", "startup", "bilinear", "checks", "signals", "arguments"},
    {"machine"},
    {"sh", "cameras", "npz", "rigid"},
    {"gaussians"},
    {"geometry", "sharing", "gradient_statistics", "budget"},
    {"texture", "tiles", "data"},
    {"sh_bands"},
    {"appearance", "transform", "paths", "origin"},
    {"pixel"},
    {"splats"},
    {"kernels"},
    {"compositor", "losses"},
    {"render", "optim", "metrics"},
    {"model"},
    {"io", "renderer", "gradients"},
    {"events"},
    {"adapt", "mcmc", "densify", "view_dependence", "corrections"},
    {"splitting", "pruning"},
    {"least_squares", "alignment"},
    {"training"},
    {"systems", "evaluation", "compaction", "web"},
    {"shrinking"},
    {"results"},
    {"cli_view"},
    {"cli_train"},
    {"cli"},
)
"""Lowest first. A module may import from lower layers, and, within one subpackage, from itself."""
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def component(path: Path) -> str:
    """The module or subpackage of the package that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_components(path: Path) -> set[str]:
    """The modules and subpackages of the package that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            names = [node.module or ""]
            if node.module == "a2tg_jax":
                names = [f"a2tg_jax.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        found |= {name.split(".")[1] for name in names if name.startswith("a2tg_jax.")}
    return found


def layer(name: str) -> int:
    return next(index for index, names in enumerate(LAYERS) if name in names)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_downward(path):
    importer = component(path)
    for imported in imported_components(path) - {importer}:
        assert layer(imported) < layer(importer), (
            f"{path.relative_to(PACKAGE)} imports {imported}, which is not below {importer}"
        )


def test_adaptation_and_mcmc_know_neither_render_nor_each_other():
    names = {"adapt", "mcmc", "densify"}
    for name in names:
        assert not imported_components(PACKAGE / f"{name}.py") & ({"render", *names} - {name})


def test_jaxopt_has_one_importer():
    importers = [path.name for path in MODULES if "jaxopt" in path.read_text(encoding="utf-8").split()]
    assert importers in (["optim.py"], [])


def test_import_leaves_jax_alone():
    """The import compiles nothing, starts no device, and leaves configuration and environment as they were."""
    script = """
import os, jax
before = dict(jax.config.values), dict(os.environ)
import a2tg_jax, a2tg_jax.startup, a2tg_jax.training, a2tg_jax.render
now = {name: jax.config.values[name] for name in before[0]}  # JAX's own modules may bring options of their own.
assert now == before[0], "configuration changed"
assert dict(os.environ) == before[1], "environment changed"
from jax._src import xla_bridge
assert not xla_bridge._backends, "a device was started"
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


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
