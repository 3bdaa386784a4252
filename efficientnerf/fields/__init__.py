"""Fields: density and colour of points, by a hash grid or networks."""
