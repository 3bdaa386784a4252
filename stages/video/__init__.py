"""Sources of photographs: frames of videos (reading them, how sharp they are and how far the picture has moved, which are chosen) and views of panoramas."""

SUFFIXES = (".mp4", ".mov", ".m4v", ".3gp", ".webm", ".mkv", ".avi")
KNOWN = "mp4, mov, webm, mkv or avi"
