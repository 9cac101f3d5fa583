"""Conformance tests that each filter subclasses, and small frames to run them on.

Needs pytest; nothing of the library imports this package.
"""
