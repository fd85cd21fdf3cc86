"""The one place that imports pycolmap."""

from types import ModuleType


def pycolmap() -> ModuleType:
    """Return the module pycolmap, imported at its first use because that takes a third of a second.

    zlib must be loaded before it: otherwise Python's own zlib (np.savez_compressed, gzip, PNG) crashes on its next use
    with "free(): invalid pointer" (pycolmap 4.2.1).
    """
    import zlib  # noqa: F401

    import pycolmap

    return pycolmap
