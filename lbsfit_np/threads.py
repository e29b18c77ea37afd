"""Linear algebra on one thread: results must not depend on how many there are, and on small arrays more of them cost time."""

import threading
from contextlib import contextmanager

__all__ = ["one_thread"]

_lock, _inside = threading.Lock(), []  # the limit, once for each that is within it, in whichever thread


@contextmanager
def one_thread():
    """All BLAS libraries of this process on one thread, as they were afterwards; for ``with``, or as a decorator.

    The limit is the process's. Of several that are inside at once, in threads of their own, the last to leave lifts it.
    """
    with _lock:
        _inside.append(_inside[0] if _inside else _limited())
    try:
        yield
    finally:
        with _lock:
            limit = _inside.pop()
            if not _inside:
                _in_control()
                limit.restore_original_limits()
                _in_control()


def _limited():
    import scipy.linalg  # noqa: F401 (SciPy has a BLAS of its own, which no limit would hold if it were loaded later)
    from threadpoolctl import threadpool_limits

    _in_control()
    return threadpool_limits(1)


def _in_control():
    """Let this thread change limits, which newer versions of threadpoolctl leave to the first one that has, while it lives."""
    import threadpoolctl

    clear = getattr(getattr(threadpoolctl, "OpenBLASController", None), "clear_controlling_thread", None)
    if clear is not None:
        clear(force=True)
