"""Encoders of images, voxels and point clouds."""
