"""The asset file: container, metadata, layouts, and the memory that a file may take; `efficientnerf.asset.format` reads and writes it."""
