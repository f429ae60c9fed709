"""Simulators that others wrote on MuJoCo, with freely placed cameras. Importing this package does not import MuJoCo."""
