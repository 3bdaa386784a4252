"""Frames of videos as photographs: reading them, how sharp they are and how far the picture has moved, which are chosen."""
