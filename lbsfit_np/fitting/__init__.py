"""The fit of one scan: its stages, the labels in between, and the result."""
