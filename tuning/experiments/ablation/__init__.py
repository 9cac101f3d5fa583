"""A claim about a filter, measured with the feature off and on."""
