"""Text and numbers of types of their own, such as NumPy's, fractions, or members of an Enum, as Python's."""

from numbers import Integral, Real

import numpy as np

__all__ = ["plain"]


def plain(value):
    """The same as plain text, or a plain number, where it is one; anything else, and True and False, as it is."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, bool) or not isinstance(value, Real):
        return value
    return int(value) if isinstance(value, Integral) else float(value)
