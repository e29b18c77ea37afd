"""Pictures of fits, drawn with NumPy. Holds no method."""
