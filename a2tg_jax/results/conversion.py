"""Conversion of models between formats of files."""

import dataclasses
import time
from pathlib import Path

from a2tg_jax.core.display import counted, in_bytes
from a2tg_jax.io.formats import file_bytes, format_of, lost_by, save_splats
from a2tg_jax.model import Model
from a2tg_jax.results.output import check_output
from a2tg_jax.results.viewing import open_source


@dataclasses.dataclass(frozen=True)
class Converted:
    """A converted model, and its bytes before and after."""

    source: Path
    out: Path
    model: Model
    bytes_before: int
    bytes_after: int
    lost: tuple[str, ...]
    seconds: float

    @property
    def text(self) -> str:
        """Summary in a line or two."""
        ratio = self.bytes_after / max(self.bytes_before, 1)
        sizes = f"{in_bytes(self.bytes_after)} from {in_bytes(self.bytes_before)} ({ratio:.2f} times)"
        lines = [f"{self.out}: {counted(self.model.num, 'Gaussian')}, {sizes}, {self.seconds:.1f} s"]
        if self.lost:
            lines.append(f"not kept by this format: {', '.join(self.lost)}")
        if self.model.origin is not None and not format_of(self.out).keeps_origin:
            lines.append("world: the original one, in its units and axes")
        return "\n".join(lines)


def convert(source: Path, out: Path, name: str | None = None) -> Converted:
    """Write a model in the format of another suffix.

    Args:
      source: a run folder or a file of any known format.
      out: the file.
      name: which model of a run; None is the last of its main system.

    Raises:
      FileNotFoundError: if there is no such file, or the run's stage is not finished.
      ValueError: if a format is unknown, or the source cannot be read or written.
    """
    format_of(out)
    if out.is_dir():
        raise ValueError(f"{out} is a folder; give the path of a file")
    if source.resolve() == out.resolve():
        raise ValueError(f"{out} is the source: choose another name")
    check_output(out)
    start = time.perf_counter()
    opened = open_source(source, name)
    save_splats(out, opened.model)
    return Converted(
        source,
        out,
        opened.model,
        opened.num_bytes,
        file_bytes(out),
        tuple(lost_by(opened.model, out)),
        time.perf_counter() - start,
    )
