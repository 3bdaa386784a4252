"""3D Gaussians as files, one module per format. All take them in the capture's frame, and spherical harmonics up to degree 3, as 3DGS has them."""
