"""Filters fitted to all cases but one, and scored on the one left out."""
