"""The version, written here alone: the build reads it, and so does the library."""

__version__ = "0.1.0"
__all__ = ["__version__"]
