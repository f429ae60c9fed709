"""Training `symview_sacfd`: replay, updates, and `symview-train-rl`, which runs them beside simulators."""
