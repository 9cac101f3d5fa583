"""Frames and sequences beside their references, and filters that make images of them."""
