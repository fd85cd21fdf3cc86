"""XLA's flags in tests. Compiling takes most of their time, and unoptimised code is ready in a third of it.

Without MLIR's fusions it is ready in half of that. jaxlib 0.11 does not know the flag any more, and aborts.
"""

import importlib.metadata

HAS_OTHER_FUSIONS = importlib.metadata.version("jaxlib").startswith("0.10.")
UNOPTIMISED = "--xla_backend_optimization_level=0"
TEST_FLAGS = f"{UNOPTIMISED} --xla_cpu_use_fusion_emitters=false" if HAS_OTHER_FUSIONS else UNOPTIMISED
