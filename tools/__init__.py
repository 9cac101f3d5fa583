"""Scripts of this repository, which are not shipped."""
