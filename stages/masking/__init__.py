"""Masks for photographs that have none: from a screen of one colour behind the object, or from a background that stands still while the object turns."""
