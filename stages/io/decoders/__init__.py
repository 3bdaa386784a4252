"""What Pillow does not do by itself for the one place that opens pictures: cameras' raw formats, colour profiles."""
