"""Errors that a user can do something about, and their texts."""

import jax

from a2tg_jax.host.text import shortened


def error_text(error: Exception, less_memory: str) -> str | None:
    """Return the text of a user's error, or of a lack of memory; None for an error of the program itself.

    Args:
      error: any error.
      less_memory: advice that follows if the machine or a device has run out of memory.
    """
    is_of_device = isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error)
    if is_of_device or isinstance(error, MemoryError):
        details = shortened(str(error), 120)
        return f"the memory does not suffice{f' ({details})' if details else ''}: {less_memory}"
    return str(error) if isinstance(error, ValueError | OSError) else None
