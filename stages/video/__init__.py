"""What becomes photographs: frames of videos (reading them, how sharp they are and how far the picture has moved, which are chosen) and views of panoramas."""
