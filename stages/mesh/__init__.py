"""Parts of the stage `mesh`."""
