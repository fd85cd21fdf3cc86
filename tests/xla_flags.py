"""XLA's flags in tests. Compiling takes most of their time, and unoptimised code is ready in a third of it.

Disabling MLIR's fusions halves it, and generating each program in one piece saves another eighth. jaxlib 0.11 does not
know the flag of fusions any more, and aborts.
"""

import importlib.metadata

HAS_OTHER_FUSIONS = importlib.metadata.version("jaxlib").startswith("0.10.")
IN_ONE_PIECE = " --xla_cpu_parallel_codegen_split_count=1" if HAS_OTHER_FUSIONS else ""
UNOPTIMISED = f"--xla_backend_optimization_level=0{IN_ONE_PIECE}"
TEST_FLAGS = f"{UNOPTIMISED} --xla_cpu_use_fusion_emitters=false" if HAS_OTHER_FUSIONS else UNOPTIMISED
