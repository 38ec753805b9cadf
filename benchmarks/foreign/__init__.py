"""Foreign FMUs as models of joints, measured; see :mod:`benchmarks.foreign.__main__`."""
