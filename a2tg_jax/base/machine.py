"""The machine of this process: its processor, its devices, and its cache folder.

JAX is imported in functions, so that the command line can answer a mistyped command at once.
"""

import dataclasses
import hashlib
import os
import platform
from pathlib import Path
from typing import TYPE_CHECKING

from jaxlib.version import __version__ as jaxlib_version

from a2tg_jax.base.threads import VARIABLE, num_threads

if TYPE_CHECKING:
    import jax


def processor_features(file: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """Return the processor's features as Linux lists them; macOS and Windows list none."""
    for line in file.read_text().splitlines() if file.exists() else ():
        if line.startswith("flags"):
            return frozenset(line.partition(":")[2].split())
    return frozenset()


def processor_key() -> str:
    """Return a hash that is equal for processors that can run each other's compiled code."""
    processor = f"{platform.machine()} {platform.processor()} {' '.join(sorted(processor_features()))}"
    return hashlib.sha256(processor.encode()).hexdigest()[:12]


@dataclasses.dataclass(frozen=True)
class Machine:
    """Machine and software that computed a result. Like the options, they affect its last bits."""

    jax: str
    """Version."""
    jaxlib: str
    """Version."""
    device: str
    """JAX's platform and the kind of device."""
    processor: str
    """Hash that is equal for processors that can run each other's compiled code."""
    threads: int
    """Number of threads of native loops, which divide sums among them."""

    def differences(self, now: "Machine") -> list[str]:
        """Return the differences to another machine that affect the last bits, with a remedy if there is one."""
        differences = []
        for name in ("jax", "jaxlib", "device", "processor"):
            before = getattr(self, name)
            if before != getattr(now, name):
                differences.append(f"{name} is {getattr(now, name)} and was {before}")
        if self.threads != now.threads and now.device.startswith("cpu"):
            remedy = f"{VARIABLE}={self.threads} keeps them"
            differences.append(f"there are {now.threads} threads and were {self.threads} ({remedy})")
        return differences


@dataclasses.dataclass(frozen=True)
class Devices:
    """Numbers of devices and processes that train one scene together."""

    each: int = 1
    """Devices of each process."""
    processes: int = 1


ALONE = Devices()


def default_device() -> "jax.Device":
    """Return JAX's device on which new arrays are placed."""
    import jax

    # jax.default_device may name another one than the first.
    (device,) = jax.numpy.zeros(()).devices()
    return device


def default_platform() -> str:
    """Return JAX's platform of the device on which new arrays are placed ("cpu" or "gpu")."""
    return default_device().platform


def this_machine() -> Machine:
    """Return the machine of this process. This starts JAX's devices."""
    import jax

    device = jax.devices()[0]
    kind = f"{device.platform} {device.device_kind}"
    return Machine(jax.__version__, jaxlib_version, kind, processor_key(), num_threads())


def cache_folder() -> Path:
    """Return the cache folder: $XDG_CACHE_HOME/a2tg-jax, or ~/.cache/a2tg-jax."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "a2tg-jax"
