"""Names, numbers and folders on disk."""
