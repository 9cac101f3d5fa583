"""Scenes, and scenes of families, rendered to files."""
