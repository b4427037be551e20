"""Measurements of speed and memory, as ratios within one run (docs/results.md)."""

from gausim.benchmark.harness import Options, Row, medians, peak_resident, peak_saved_bytes
from gausim.benchmark.peaks import Peaks, peaks

__all__ = ["Options", "Peaks", "Row", "medians", "peak_resident", "peak_saved_bytes", "peaks"]
