"""Store of the photographs of a scene: in memory while there is room, otherwise read on demand from a disk."""

import dataclasses
import functools
import tempfile
import threading
import weakref
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from a2tg_jax import Picture
from a2tg_jax.base.machine import cache_folder
from a2tg_jax.base.memory import memory_limit
from a2tg_jax.core.pictures import checksum_of
from a2tg_jax.data.decoding import read_pixels

SHARE_OF_MEMORY = 0.25
"""Share of the process's memory for photographs; those beyond it stay on disk."""


class Shelf:
    """Store of the pictures of one scene; safe to use from several threads.

    Beyond the memory limit, pixels of an unchanged image file are dropped: decoding it again takes less time than a
    training step of that size. Undistorted or resized pixels go to an unnamed file in `cache_folder()`, which
    disappears with the process, however that ends.
    """

    def __init__(self, room: int | None = None):
        """Make an empty store.

        Args:
          room: memory limit of the pictures in bytes; None: `SHARE_OF_MEMORY` of the memory of the process.
        """
        self._room = int(SHARE_OF_MEMORY * memory_limit()) if room is None else room
        self._lock = threading.Lock()
        self._file: BinaryIO | None = None
        self._end = 0

    def keep(self, pixels: np.ndarray, source: Path | None = None) -> Picture:
        """Return a picture of these pixels, uint8 of any shape.

        Args:
          pixels: the pixels.
          source: image file with exactly these pixels; None: there is none.
        """
        with self._lock:
            # Smaller pictures may still fit after a larger one did not.
            self._room -= pixels.nbytes
            if self._room >= 0:
                return Picture.of(pixels)
            self._room += pixels.nbytes
        # docs/reliability.md, "Photographs beyond the memory"
        checksum = checksum_of(pixels)
        if source is not None:
            read_again = functools.partial(_read_unchanged, source, checksum)
            return _FilePicture(pixels.shape, read_again, checksum=checksum)
        folder = cache_folder()
        shape = pixels.shape
        try:
            with self._lock:
                if self._file is None:
                    folder.mkdir(parents=True, exist_ok=True)
                    self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - as long as there are pictures
                    weakref.finalize(self, self._file.close)
                file = self._file
                start = self._end
                file.seek(start)
                file.write(np.ascontiguousarray(pixels).data)
                file.flush()
                self._end += pixels.nbytes  # After the write: the next one replaces one that failed.
        except OSError as error:
            advice = "make room there, name another place in XDG_CACHE_HOME, or use a larger downscale"
            raise OSError(f"{folder}: cannot keep the scene's photographs ({error.strerror}): {advice}") from error

        def read() -> np.ndarray:
            again = np.empty(shape, np.uint8)
            with self._lock:  # Pictures share the position in the file.
                file.seek(start)
                file.readinto(again)  # type: ignore[attr-defined]
            return again

        return Picture(shape, read, checksum=checksum)


def _read_unchanged(source: Path, checksum: int) -> np.ndarray:
    """Return the pixels of an image file. ValueError: they have changed."""
    pixels = np.ascontiguousarray(read_pixels(source))
    if checksum_of(pixels) != checksum:
        raise ValueError(f"{source}: has changed since the scene was loaded; restore it or start again")
    return pixels


class _FilePicture(Picture):
    """Pixels of an image file as they are in it."""

    def __reduce__(self) -> Any:
        """Pickle the place of the file, not the pixels."""
        return type(self), tuple(getattr(self, field.name) for field in dataclasses.fields(self))
