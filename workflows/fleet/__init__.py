"""Many scenes at once: the manifest that lists them, sweeps over settings, the page, the live table."""
