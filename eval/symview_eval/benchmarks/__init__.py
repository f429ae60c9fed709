"""The suites of `symview-benchmark`."""
