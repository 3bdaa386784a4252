"""Layouts of published data sets."""
