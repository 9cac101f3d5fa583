"""Pages, plots and comparisons that show what was found."""
