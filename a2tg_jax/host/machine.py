"""What the last bits of a training run depend on besides its numbers: versions, processor, device, threads."""

import dataclasses

import jax

from a2tg_jax.host.cores import VARIABLE, num_threads
from a2tg_jax.host.startup import processor_key


@dataclasses.dataclass(frozen=True)
class Machine:
    """Where numbers were computed."""

    jax: str
    """Version."""
    jaxlib: str
    """Version."""
    device: str
    """JAX's platform and the kind of device."""
    processor: str
    """A text that processors share for which the same code is made."""
    threads: int
    """Of native loops, among which sums are divided."""

    def differences(self, now: "Machine") -> list[str]:
        """What is another now, so that numbers will differ in their last bits; with what to do, where there is."""
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


def this_machine() -> Machine:
    """Return the one that this process runs on; JAX's devices are started."""
    device = jax.devices()[0]
    kind = f"{device.platform} {device.device_kind}"
    return Machine(jax.__version__, jax.lib.__version__, kind, processor_key(), num_threads())
