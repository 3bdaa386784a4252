"""The memory of each stage at its peak, and whether it fits: by terms, each measured (docs/experiments/memory.md)."""
