"""Filters frame by frame, beside raw samples."""
