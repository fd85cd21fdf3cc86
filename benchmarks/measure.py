"""Measure one case in a process of its own, which gives it its own peak memory and compilation.

    python -m benchmarks.measure '{"case": "render", "num": 10000, "width": 320, "height": 240, "textures": "mixed"}'

prints a line of JSON. Times are in milliseconds, medians over several warm runs; `threads` limits the processors, and
`cache` has compiled programs kept on disk.
"""

import json
import os
import sys


def main() -> None:
    case = json.loads(sys.argv[1])
    if case.get("threads"):
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[: case["threads"]]))
    import jax

    import a2tg_jax
    from benchmarks import limit, rendering, stages, timing, training

    a2tg_jax.configure_cpu(use_cache="cache" in case)
    measures = {
        "render": rendering.measure_render,
        "stages": stages.measure_stages,
        "step": stages.measure_step,
        "limit": limit.measure_limit,
        "training": training.measure_training,
    }
    figures = measures[case["case"]](case)
    figures["peak_mb"] = timing.memory_peak() / 1e6
    on_device = jax.local_devices()[0].memory_stats()
    if on_device and "peak_bytes_in_use" in on_device:
        figures["device_peak_mb"] = on_device["peak_bytes_in_use"] / 1e6
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
