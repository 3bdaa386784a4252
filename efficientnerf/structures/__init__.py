"""Four ways to keep the occupied voxels of a cubic grid, and to look points up in them (EfficientNeRF, section 3.5 and table 7).

    dense.DenseVoxels     one word for each voxel of the grid
    hashing.HashMap       open addressing over 64-bit keys: the sparse tensor
    octree.Octree         the node arrays of svox (PlenOctree)
    bricks.BrickTree      NerfTree: coarse dense records over packed 4^3 bricks; and FullBricks, the same as the paper prints it

All are built from the same `voxels.Voxels` and answer the same question: which four half-precision values does the voxel at a point hold?
`on_device` does the same in plain torch, on any device.
"""
