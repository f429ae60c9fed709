"""Equivariant layers, encoders and heads."""
