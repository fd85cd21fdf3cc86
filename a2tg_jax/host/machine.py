"""Machine of a run. Beside the options it decides the last bits: versions, processor, device, threads."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxlib.version import __version__ as jaxlib_version

from a2tg_jax.host.cores import VARIABLE, num_threads
from a2tg_jax.host.startup import processor_key


@dataclasses.dataclass(frozen=True)
class Machine:
    """Machine and software that computed a result."""

    jax: str
    """Version."""
    jaxlib: str
    """Version."""
    device: str
    """JAX's platform and the kind of device."""
    processor: str
    """Text shared by processors that run the same compiled code."""
    threads: int
    """Number of threads of native loops, which divide sums among them."""

    def differences(self, now: "Machine") -> list[str]:
        """Return the differences to another machine that change the last bits, with a remedy if there is one."""
        told = [
            f"{name} is {getattr(now, name)} and was {getattr(self, name)}"
            for name in ("jax", "jaxlib", "device", "processor")
            if getattr(self, name) != getattr(now, name)
        ]
        if self.threads != now.threads and now.device.startswith("cpu"):
            told.append(
                f"there are {now.threads} threads and were {self.threads} ({VARIABLE}={self.threads} keeps them)"
            )
        return told


@dataclasses.dataclass(frozen=True)
class Devices:
    """Numbers of devices and processes that train one scene together."""

    each: int = 1
    """Devices of each process."""
    processes: int = 1


ALONE = Devices()
"""One device of one process."""


def default_platform() -> str:
    """Return JAX's platform of the device on which new arrays are placed ("cpu" or "gpu")."""
    (device,) = jnp.zeros(()).devices()
    platform: str = device.platform
    return platform


def this_machine() -> Machine:
    """Return the machine of this process. This starts JAX's devices."""
    device = jax.devices()[0]
    kind = f"{device.platform} {device.device_kind}"
    return Machine(jax.__version__, jaxlib_version, kind, processor_key(), num_threads())
