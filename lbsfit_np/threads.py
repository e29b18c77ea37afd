"""Linear algebra on one thread: results must not depend on how many there are, and on small arrays more of them cost time."""

from contextlib import contextmanager

__all__ = ["one_thread"]


@contextmanager
def one_thread():
    """All BLAS libraries of this process on one thread, as they were afterwards; for ``with``, or as a decorator."""
    import scipy.linalg  # noqa: F401 (SciPy has a BLAS of its own, which no limit would hold if it were loaded later)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        yield
