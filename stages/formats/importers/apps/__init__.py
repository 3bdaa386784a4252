"""Cameras that phone apps tracked."""
