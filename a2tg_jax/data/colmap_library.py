"""The one place that imports pycolmap."""

import contextlib
import sys
import threading
from types import ModuleType

from a2tg_jax.host.operating_system import signal_handlers_kept

_lock = threading.Lock()


def pycolmap() -> ModuleType:
    """Return the module pycolmap, imported at its first use because that takes a third of a second.

    zlib must be loaded before it: otherwise Python's own zlib (np.savez_compressed, gzip, PNG) crashes on its next use
    with "free(): invalid pointer" (pycolmap 4.2.1). Its import also installs glog's signal handlers, which print a
    C++ stack at SIGTERM; the handlers from before are restored. Photographs are read by several threads, of which only
    one may import it.
    """
    import zlib  # noqa: F401

    with _lock, contextlib.nullcontext() if "pycolmap" in sys.modules else signal_handlers_kept():
        import pycolmap  # noqa: F401

    return sys.modules["pycolmap"]
