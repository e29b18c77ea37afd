"""Where a fit begins: the reference scale, and a pose from the parts that the labels show."""
