"""Camera models, the workspace and view geometry: pure functions on NumPy arrays."""
