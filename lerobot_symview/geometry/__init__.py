"""Cameras, workspaces and the geometry of views: pure functions on NumPy arrays."""
