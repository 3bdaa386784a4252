"""Entropy coding of the asset layout `packed` (efficientnerf/asset/FORMAT.md, section 14)."""
