"""Measurements over many fits or filters, each from one YAML file."""
