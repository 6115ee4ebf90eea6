"""The timing that the fixture `timed` of tests/benchmarks gives every measurement."""

from benchmarks import harness

TIMING = harness.Timing(compile_s=7.0, median_s=2.0, fastest_s=1.0, slowest_s=3.0)
