"""The baked asset: structure, baking, file format."""
