"""What a measurement that is not made comes to."""

from benchmarks import harness

TIMING = harness.Timing(first_s=9.0, median_s=2.0, fastest_s=1.0, slowest_s=3.0)
