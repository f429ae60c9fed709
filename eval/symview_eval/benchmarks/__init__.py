"""The command `symview-benchmark` and its suites."""
