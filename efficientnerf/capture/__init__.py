"""Photographs and cameras as arrays: their analysis before training. No files."""
