"""Folder of rendered pictures, with a list of what renders wrote there; nothing else is replaced or deleted unasked."""

import contextlib
import dataclasses
import re
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.regular_files import is_regular, read_regular, sha256_of
from a2tg_jax.results.checks import check_new

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
    def listed(self) -> dict[str, list[str]]:
        """SHA-256 of what renders wrote, by file name: the newest last, after older ones if a render was killed."""
        found: dict[str, list[str]] = {}
        if is_regular(self.path / LIST):
            for line in read_regular(self.path / LIST, MOST_BYTES).decode(errors="surrogateescape").splitlines():
                digest, _, name = line.partition("  ")
                found.setdefault(name, []).append(digest)
        return found

    def check(self, names: Iterable[str], *, overwrite: bool) -> None:
        """Raise FileExistsError if a file would be replaced, without `overwrite`, that no render wrote."""
        listed = self.listed
        for name in names:
            if self._own_digest(name, listed.get(name, ())) is None:
                check_new(self.path / name, "--out", overwrite=overwrite)

    @contextlib.contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Yield a temporary path, as `replacing` does, for a file of the folder, and list the file."""
        with replacing(self.path / name) as temporary:
            yield temporary
            with open(self.path / LIST, "a", encoding="utf-8", errors="surrogateescape") as file:
                file.write(f"{sha256_of(temporary)}  {name}\n")

    def tidy(self, rendered: Collection[str], *, drops_frames: bool) -> None:
        """List only what is left after a render.

        Args:
          rendered: names of the files that it wrote.
          drops_frames: whether other frames of flights are deleted.
        """
        left = {}
        for name, digests in self.listed.items():
            digest = digests[-1] if name in rendered else self._own_digest(name, digests)
            if drops_frames and digest is not None and name not in rendered and FRAME.fullmatch(name):
                (self.path / name).unlink()
            elif digest is not None:
                left[name] = digest
        with replacing(self.path / LIST) as temporary:
            lines = [f"{digest}  {name}\n" for name, digest in left.items()]
            temporary.write_text("".join(lines), encoding="utf-8", errors="surrogateescape")

    def _own_digest(self, name: str, digests: Collection[str]) -> str | None:
        """Return the SHA-256 of a file if it is one of those that renders wrote, or None."""
        digest = sha256_of(self.path / name) if digests and is_regular(self.path / name) else None
        return digest if digest in digests else None
