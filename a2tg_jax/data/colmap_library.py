"""The one place that imports pycolmap."""

import contextlib
import sys
import threading
from types import ModuleType

from a2tg_jax.host.signals import signal_handlers_kept

_lock = threading.Lock()


def pycolmap() -> ModuleType:
    """Return the module pycolmap, imported at its first use because that takes a third of a second.

    zlib must be loaded before it: otherwise Python's own zlib (np.savez_compressed, gzip, PNG) crashes on its next use
    with "free(): invalid pointer" (pycolmap 4.2.1). Its import also installs glog's signal handlers, which print a
    C++ stack at SIGTERM; the handlers from before are restored. Photographs are read by several threads, of which only
    one may import it.

    Raises:
      ValueError: if it is not installed. It is in the extra [train], and has no wheel for some machines.
    """
    import zlib  # noqa: F401

    with _lock, contextlib.nullcontext() if "pycolmap" in sys.modules else signal_handlers_kept():
        try:
            import pycolmap  # noqa: F401
        except ImportError as error:  # There are wheels for x86-64 Linux and Windows and for macOS on arm64.
            raise ValueError(
                f"finding cameras and undistorting photographs need pycolmap, which is not installed ({error}): "
                "pip install 'a2tg-jax[train]' or, if it has no wheel for this machine, do this step on another one, "
                "with a2tg sfm or COLMAP's image_undistorter"
            ) from None

    return sys.modules["pycolmap"]
