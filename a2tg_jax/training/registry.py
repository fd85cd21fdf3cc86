"""Systems by name: the library's, and others as package.module:NAME."""

import importlib
import sys
from collections.abc import Mapping
from typing import Any

from a2tg_jax.base.config_json import config_from_dict, config_to_dict
from a2tg_jax.base.text import did_you_mean, shortened
from a2tg_jax.training.options import System

SYSTEMS = {
    "a2tg": "a2tg_jax.systems.a2tg:A2tg",
    "gaussians-2d": "a2tg_jax.systems.baselines:Gaussians2d",
    "gaussians-2d-mcmc": "a2tg_jax.systems.baselines:Gaussians2dMcmc",
    "textured-gaussians": "a2tg_jax.systems.baselines:TexturedGaussians",
    "supergaussians": "a2tg_jax.systems.baselines:SuperGaussians",
    "bbsplat": "a2tg_jax.systems.baselines:BBSplat",
    "bytewise": "a2tg_jax.systems.bytewise:Bytewise",
}
"""Module and class of each system of this library, imported on demand."""
LONGEST_REASON = 300


def find_system(reference: str) -> System:
    """Return the system of a name, or of package.module:NAME, with its own defaults; the module is imported.

    Args:
      reference: the name, such as "bytewise", or the place of a custom system.

    Returns:
      The system.

    Raises:
      ValueError: if there is no such system.

    Examples:
      >>> a2tg.find_system("bytewise").preset("quick", memory_budget="300kB").memory_budget
      0.3
    """
    path, _, attribute = SYSTEMS.get(reference, reference).partition(":")
    name = repr(shortened(reference))
    if not attribute:
        raise ValueError(
            f"there is no system {name}; the systems are {', '.join(SYSTEMS)}, "
            f"and your own as package.module:NAME{did_you_mean(reference, SYSTEMS)}"
        )
    try:
        system = getattr(importlib.import_module(path), attribute)
    except Exception as error:  # A custom module may fail in any way.
        kind = "" if isinstance(error, ImportError | AttributeError) else f"{type(error).__name__}: "
        near = did_you_mean(attribute, vars(sys.modules[path]) if path in sys.modules else {})
        reason = shortened(f"{kind}{error}", LONGEST_REASON)
        if isinstance(error, ModuleNotFoundError) and path.partition(".")[0] == str(error.name).partition(".")[0]:
            reason += ": install it, add its folder to PYTHONPATH, or start in that folder"
        raise ValueError(f"the system {name} cannot be imported: {reason}{near}") from error
    if isinstance(system, type) and issubclass(system, System):
        try:
            return system()
        except TypeError as error:
            raise ValueError(f"every option of the system {name} must have a default: {error}") from error
    if not isinstance(system, System):
        raise ValueError(f"{name} is no system: it must be a subclass or an instance of a2tg_jax.System")
    return system


def reference_of(system: System) -> str:
    """Return the name with which `find_system` finds a system's class."""
    reference = f"{type(system).__module__}:{type(system).__qualname__}"
    return next((name for name, path in SYSTEMS.items() if path == reference), reference)


def system_to_dict(system: System) -> dict[str, object]:
    """Return a system and all its options as values for JSON."""
    return {"name": reference_of(system), "options": config_to_dict(system)}


def system_from_dict(data: Mapping[str, Any], where: str, kind: type[System] | None = None) -> System:
    """Return the system from its options, the inverse of `system_to_dict`.

    A file never makes this program import foreign modules: the class of a custom system must be given, or its module
    already imported.

    Args:
      data: name and options.
      where: name of the file in errors.
      kind: class of the system if no imported module has one of that name.

    Raises:
      ValueError: if the class is not known, or an option is missing, unknown or of another type.
    """
    if not isinstance(data, Mapping) or not isinstance(data.get("name"), str) or "options" not in data:
        raise ValueError(f"{where}: does not name its system; it is damaged or of another version")
    name = data["name"]
    options = data["options"]
    if name in SYSTEMS:
        kind = type(find_system(name))
    else:
        module, _, attribute = name.partition(":")
        kind = getattr(sys.modules.get(module), attribute, kind)
    if not (isinstance(kind, type) and issubclass(kind, System)):
        raise ValueError(
            f"{where}: is of the system {shortened(name)!r}, which is not known here: import its module first"
        )
    return config_from_dict(kind, options, f"{where}: options")
