"""Kernels on triangle meshes."""
