"""Random streams from the user's seed: same seed and same keys, same stream, whatever runs before or beside it."""

import zlib

import numpy as np

from .errors import InputError, is_whole

__all__ = ["check_random_state", "generator", "integer_seed"]


def check_random_state(random_state):
    """Raise InputError unless it is a seed, a Generator or None."""
    number = is_whole(random_state, 0)
    if not (number or random_state is None or isinstance(random_state, np.random.Generator)):
        raise InputError("random_state", repr(random_state), "a non-negative integer, a numpy.random.Generator or None")


def generator(random_state, *keys):
    """An independent random stream for one purpose.

    Parameters
    ----------
    random_state : int, numpy.random.Generator or None
        A seed; a Generator is used as it is (and advanced); None takes fresh entropy.
    *keys : str or int
        What the stream is for, such as ``("scan", 3)``.
    """
    if isinstance(random_state, np.random.Generator):
        return random_state
    return np.random.default_rng(_sequence(random_state, keys))


def integer_seed(random_state, *keys):
    """A 31-bit integer seed, for scikit-learn, which refuses Generators."""
    if isinstance(random_state, np.random.Generator):
        return int(random_state.integers(2**31 - 1))
    return int(_sequence(random_state, keys).generate_state(1)[0] & 0x7FFFFFFF)


def _sequence(random_state, keys):
    if random_state is None:
        return np.random.SeedSequence()
    check_random_state(random_state)
    words = [zlib.crc32(k.encode()) if isinstance(k, str) else int(k) for k in keys]
    return np.random.SeedSequence(int(random_state), spawn_key=tuple(words))
