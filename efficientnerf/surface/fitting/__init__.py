"""Vertices of a surface moved to what views and photographs show of it. Arrays in, arrays out."""
