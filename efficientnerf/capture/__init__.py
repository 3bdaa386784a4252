"""Photographs and cameras as arrays: what is found out of them before anything is trained. No files."""
