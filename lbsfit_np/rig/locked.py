"""Arrays that nobody can write to any more: what makes rigs and their parts immutable."""

from copy import deepcopy

import numpy as np
from scipy import sparse

__all__ = ["ReadOnly", "locked"]


class ReadOnly(dict):
    """A dict that nobody can write to; copies of it that are deep are plain dicts."""

    def _refuse(self, *args, **more):
        raise TypeError("rigs are immutable: make another one with dataclasses.replace")

    __setitem__ = __delitem__ = __ior__ = clear = pop = popitem = setdefault = update = _refuse

    def __reduce__(self):
        return type(self), (dict(self),)

    def __deepcopy__(self, memo):
        return deepcopy(dict(self), memo)


def locked(value, copy=True):
    """An array or sparse matrix read-only, by default a copy where its maker could still write to it; others as they are."""
    if isinstance(value, np.ndarray):
        value = value.copy() if copy and _is_shared(value) else value
        _lock(value)
    elif sparse.issparse(value):
        if copy and any(map(_is_shared, (value.data, value.indices, value.indptr))):
            value = value.copy()
        for a in (value.data, value.indices, value.indptr):
            _lock(a)
    return value


def _is_shared(array):
    """Whether others may write to it, or to what it is a view of."""
    return any(a.flags.writeable for a in _with_bases(array))


def _lock(array):
    for a in _with_bases(array):
        a.flags.writeable = False


def _with_bases(array):
    """The array, and the arrays that it is a view of."""
    while isinstance(array, np.ndarray):
        yield array
        array = array.base
