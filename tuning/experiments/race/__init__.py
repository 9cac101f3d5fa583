"""Fitting methods against each other."""
