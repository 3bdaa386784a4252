"""Refinement: fit a baked tree's values to the training images.

targets  training pixels and what the tree is composited with
state    the tree being fitted and RMSprop's moments
host     steps on the CPU (numba)
device   steps on CUDA (Triton)
fit      what callers use: picks one of the two by where the targets are
"""
