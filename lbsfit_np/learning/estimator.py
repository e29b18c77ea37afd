"""The conventions of scikit-learn's estimators, without importing it."""

import inspect

from .parameters import check_names

__all__ = ["Estimator"]


class Estimator:
    """What ``sklearn.base.clone`` and others ask of an estimator; its parameters are what the constructor stores.

    In place of scikit-learn's ``BaseEstimator``, as importing that takes a second in each process that fits, half of its start.
    """

    @classmethod
    def _defaults(cls):
        """Each parameter's default, by name; ``inspect.Parameter.empty`` where it has none."""
        parameters = inspect.signature(cls).parameters.values()
        return {p.name: p.default for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}

    @classmethod
    def _settled(cls):
        """Names of the parameters of base classes that the constructor does not take, but settles."""
        return {name for kind in cls.__mro__ if issubclass(kind, Estimator) for name in kind._defaults()} - {*cls._defaults()}

    def _all_params(self):
        """The parameters by name, with those that the constructor settles: all that a fit depends on."""
        return self.get_params() | {name: getattr(self, name) for name in sorted(self._settled())}

    def get_params(self, deep=True):
        """Get the parameters by name; ``deep`` changes nothing, as none of them is an estimator."""
        return {name: getattr(self, name) for name in sorted(self._defaults())}

    def set_params(self, **parameters):
        """Set parameters by name, and return the estimator.

        Raises
        ------
        InputError
            For a name that is no parameter; nothing is set then.
        """
        check_names(parameters, self._defaults())
        for name, value in parameters.items():
            setattr(self, name, value)
        return self

    def __repr__(self):
        defaults = self._defaults()
        given = {name: repr(getattr(self, name, default)) for name, default in defaults.items()}
        changed = (f"{name}={value}" for name, value in given.items() if value != repr(defaults[name]))
        return f"{type(self).__name__}({', '.join(changed)})"

    def __sklearn_tags__(self):
        from sklearn.base import BaseEstimator

        return BaseEstimator().__sklearn_tags__()
