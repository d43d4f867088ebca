"""From a mask of voxels to the path along the middle of the lumen. Knows no file format."""
