"""Planar groups, their representations, and augmentation by their elements."""
