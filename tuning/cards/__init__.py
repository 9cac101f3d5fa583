"""The card of a preset: what it changes, and where it is worse."""
