"""Filtering files, one or many."""
