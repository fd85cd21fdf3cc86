"""Measurements of speed and memory: `python -m benchmarks`. See docs/performance.md for the last results."""
