"""Folder of rendered pictures, with a list of what renders wrote there; nothing else is replaced or deleted unasked."""

import contextlib
import dataclasses
import re
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.results.kept_lpips import sha256_of
from a2tg_jax.results.output import check_new

LIST = ".a2tg-frames"
"""Name of the list, which has the format of sha256sum."""
MOST_BYTES = 1 << 26
FRAME_NAME = "frame_%04d.png"
"""File name of a flight's frame by its number, as Python and ffmpeg write it."""
FRAME = re.compile(r"frame_\d{4,}\.png")


@dataclasses.dataclass(frozen=True)
class FrameFolder:
    """Folder into which frames and videos are rendered."""

    path: Path

    @property
    def listed(self) -> dict[str, set[str]]:
        """SHA-256 of what renders wrote, by file name: the newest, and older ones if a render was killed."""
        found: dict[str, set[str]] = {}
        if is_regular(self.path / LIST):
            for line in read_regular(self.path / LIST, MOST_BYTES).decode(errors="surrogateescape").splitlines():
                digest, _, name = line.partition("  ")
                found.setdefault(name, set()).add(digest)
        return found

    def check(self, names: Iterable[str], *, overwrite: bool) -> None:
        """Raise FileExistsError if a file would be replaced, without `overwrite`, that no render wrote."""
        listed = self.listed
        for name in names:
            if not self._is_own(name, listed):
                check_new(self.path / name, "--out", overwrite=overwrite)

    @contextlib.contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Yield a temporary path, as `replacing` does, for a file of the folder, and list the file."""
        with replacing(self.path / name) as temporary:
            yield temporary
            with open(self.path / LIST, "a", encoding="utf-8", errors="surrogateescape") as file:
                file.write(f"{sha256_of(temporary)}  {name}\n")

    def drop_frames(self, kept: Collection[str]) -> None:
        """Delete the frames of earlier flights, except those of some names, and list only what is left."""
        listed = self.listed
        for name in listed:
            if FRAME.fullmatch(name) and name not in kept and self._is_own(name, listed):
                (self.path / name).unlink()
        left = [f"{sha256_of(self.path / name)}  {name}\n" for name in listed if self._is_own(name, listed)]
        with replacing(self.path / LIST) as temporary:
            temporary.write_text("".join(left), encoding="utf-8", errors="surrogateescape")

    def _is_own(self, name: str, listed: dict[str, set[str]]) -> bool:
        """Return whether a render wrote what a file holds now."""
        return name in listed and is_regular(self.path / name) and sha256_of(self.path / name) in listed[name]
