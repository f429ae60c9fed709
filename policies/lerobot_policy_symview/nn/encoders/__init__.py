"""Encoders of images, voxel grids and point clouds, and their registry."""
