"""Four data structures for the occupied voxels of a cubic grid, and point queries in them (EfficientNeRF, section 3.5 and table 7).

    dense.DenseVoxels     one packed value for each voxel of the grid
    hashing.HashMap       open addressing over 64-bit keys: the sparse tensor
    octree.Octree         the node arrays of svox (PlenOctree)
    bricks.BrickTree      NerfTree: coarse dense records over packed 4^3 bricks; and FullBricks, the same as the paper prints it

All are built from the same `voxels.Voxels` and return the four half-precision values of the voxel at a point. `torch_structures` does the same in plain torch,
on any device.
"""
