"""What result.json of a fit holds."""
