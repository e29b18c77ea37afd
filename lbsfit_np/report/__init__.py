"""Pictures of fits, drawn with NumPy, and animated glTF. Holds no method."""
