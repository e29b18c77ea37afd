"""The error of a fitter that has not learned, in a module of its own: it takes a second to import its base class."""

from sklearn.exceptions import NotFittedError

from ..errors import InputError

__all__ = ["NotLearnedError"]


class NotLearnedError(InputError, NotFittedError):
    """A fitter was asked, before ``fit``, for what only comes after it."""
