"""What each stage takes at its peak, and whether that fits: by terms, each measured (docs/experiments/memory.md)."""
