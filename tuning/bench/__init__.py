"""Time and memory of filters."""
