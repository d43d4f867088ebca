"""Readers of files of anatomy, one format a file. They know points and voxels, and no robot."""
