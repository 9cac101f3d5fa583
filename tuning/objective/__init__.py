"""From parameters to one number: windows, batches, terms and their reduction."""
