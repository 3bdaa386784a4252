"""FLEET/index.html, FLEET/comparison.html and FLEET/fleet.csv."""
