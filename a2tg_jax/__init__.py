"""Adaptive anisotropic textured Gaussians as a functional JAX library. Its public names are in `__init__.pyi`.

Names are imported at their first use, so that `import a2tg_jax` costs little more than `import jax`.
"""

import importlib.util
import sys
from typing import Any

import lazy_loader

_import_name, _, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Import a public name, or a package or module of this library, at its first use."""
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("a2tg-jax")
    # The stub lists names, not modules.
    if name not in __all__ and importlib.util.find_spec(f"{__name__}.{name}") is not None:
        return importlib.import_module(f"{__name__}.{name}")
    # Most names start JAX. The command line checks by itself, for commands that do.
    if f"{__name__}.cli" not in sys.modules:
        importlib.import_module(f"{__name__}.base.memory").check_ulimits()
    return _import_name(name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
