"""Units of length: metres in each, and their names in words."""

import math

__all__ = ["METRES", "USUAL", "WORDS", "unit_name"]

# Metres in a unit, by the names that cards, parameters and options have for it.
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
# The same names in words.
WORDS = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches", "ft": "feet"}
# Those that scans are usually in, among which one is guessed where none is said.
USUAL = ("m", "cm", "mm", "in")


def unit_name(metres):
    """The name of the unit of so many metres, but for rounding; None of other units, and where ``metres`` is None."""
    return next((name for name, known in METRES.items() if metres is not None and math.isclose(metres, known)), None)
