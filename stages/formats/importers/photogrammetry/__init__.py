"""Cameras that photogrammetry programs found."""
