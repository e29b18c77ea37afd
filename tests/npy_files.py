"""Damaged NPY files for tests: headers on which NumPy fails in ever other ways."""

import numpy as np

# What np.load raises for them: IndexError, ValueError, TypeError, OverflowError, TokenError, RecursionError, SyntaxError, …
DAMAGED_HEADERS = (
    "{'descr': (), 'fortran_order': False, 'shape': (5, 3), }",
    "{'descr': [()], 'fortran_order': False, 'shape': (5, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000000000000, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (5000000000, 300000), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (5, 3",
    "{'descr': '<,8', 'fortran_order': False, 'shape': (5, 3), }",
    "(" * 3000,
    "-" * 5000 + "1",
    "[]",
    "",
)


def npy(header):
    """An NPY file of version 1 with the given header and some zeros."""
    text = header.encode("latin-1") + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(120)


def damaged(good, rng):
    """An NPY file with a few bytes of its header changed, mostly into ones that mean something there."""
    data = bytearray(good)
    for _ in range(rng.integers(1, 5)):
        data[rng.integers(6, 128)] = rng.choice(np.frombuffer(b"\0\xff(){}[]',:0123<>fiOVSUM8bLh\\\n \"#-", dtype=np.uint8))
    return bytes(data)
