"""The command `a2tg download`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.data.download import BENCHMARK_SETS, fetch
from a2tg_jax.host.text import did_you_mean


@dataclasses.dataclass(frozen=True)
class Download:
    """Download benchmark data sets and unpack them.

    An interrupted download continues when the command is given again. What is there is left alone. The experiments find
    the scenes where they are unpacked.

    Examples:
      a2tg download --list
      a2tg download mipnerf360 tandt-db --out scenes
    """

    names: Annotated[Positional[tuple[str, ...]], arg(metavar="NAME")] = ()
    """Data sets, as --list names them."""
    out: Annotated[Path, arg(metavar="SCENES")] = Path("scenes")
    """Folder for all scenes."""
    list: bool = False
    """Print names, sizes and contents of the data sets."""

    def run(self) -> None:
        if self.list or not self.names:
            print(_table())
            return
        for name in self.names:
            if name not in BENCHMARK_SETS:
                near = did_you_mean(name, BENCHMARK_SETS)
                raise ValueError(f"there is no data set {name!r}{near or ';'} they are {', '.join(BENCHMARK_SETS)}")
        for name in self.names:
            archive = BENCHMARK_SETS[name]
            print(f"{name}: {archive.url}", flush=True)
            is_new = fetch(archive, self.out)
            print(f"{name}: {'unpacked' if is_new else 'is there already'} in {self.out / archive.folder}")


def _table() -> str:
    rows = []
    for name, known in BENCHMARK_SETS.items():
        size = known.num_bytes
        told = "      ?" if size is None else f"{size / 1e9:4.1f} GB"
        rows.append(f"{name:<17} {told}  {known.content}")
    return "\n".join([*rows, "Sizes with ? are told by the server before the download."])
