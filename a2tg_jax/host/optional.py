"""Libraries that only some functions need."""

import importlib
from typing import Any


def optional(module: str, need: str, extra: str) -> Any:
    """Import and return a module. Raises ValueError if it is not installed: `need` says what it is for, as in "a mesh
    needs scikit-image", and `extra` is the extra of this package that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ValueError(f"{need}, which is not installed: pip install 'a2tg-jax[{extra}]'") from error
