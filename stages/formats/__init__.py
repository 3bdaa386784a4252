"""Formats that captures come in, and that assets are written to."""
