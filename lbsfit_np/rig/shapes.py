"""Shape parameters: named linear directions in which a template changes from one person to another.

With values v of the parameters and their defaults d,

    U' = U + Σ_k (v_k − d_k) D_k,    J' = J + Σ_k (v_k − d_k) E_k.

In files the directions D are whole multiples of a power of two, as many as 16 bits can hold: rounding them once
(:meth:`ShapeSpace.rounded`) makes every file small, and every copy of it exact.
"""

from dataclasses import dataclass, replace
from numbers import Real

import numpy as np

from ..errors import InputError
from .locked import locked

__all__ = ["ShapeSpace", "check_shapes", "from_counts", "to_counts"]

_MOST = 32767  # of a 16-bit integer
_PER_PARAMETER = ("lower", "upper", "default", "spread")


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeSpace:
    """Shape parameters of a rig and what a unit of each does.

    Attributes
    ----------
    names : (K,) tuple of str
        Such as "height"; valid as keyword arguments of ``Rig.subject``.
    units : (K,) tuple of str
        Unit of each parameter, such as "m" or "kg"; "" for a plain number.
    lower, upper : (K,) arrays
        Range of each parameter in which the directions hold.
    default : (K,) array
        The values that the rig's template has.
    spread : (K,) array
        Standard deviation of each parameter among people, with the others held fixed.
    vertices : (K, m, 3) array
        D, the change of the template for one unit of the parameter, in rig units.
    joints : (K, J, 3) array
        E, the change of the joint positions.
    """

    names: tuple
    units: tuple
    lower: np.ndarray
    upper: np.ndarray
    default: np.ndarray
    spread: np.ndarray
    vertices: np.ndarray
    joints: np.ndarray

    def __post_init__(self):
        for name, value in list(self.__dict__.items()):
            object.__setattr__(self, name, locked(value))

    def __setstate__(self, state):
        """Restore a pickled space; NumPy's pickles forget that arrays were locked."""
        self.__dict__.update({name: locked(value, copy=False) for name, value in state.items()})

    def __len__(self):
        return len(self.names)

    def __repr__(self):
        return f"<ShapeSpace: {', '.join(map(self.words, range(len(self))))}>"

    def words(self, k):
        """Parameter ``k`` with its range, such as "height 1.5 to 2.0 m"."""
        unit = f" {self.units[k]}" if self.units[k] else ""
        return f"{self.names[k]} {self.lower[k]:.4g} to {self.upper[k]:.4g}{unit}"

    def values(self, parameters):
        """Return the values of all parameters, (K,), from a mapping of some; the others take their defaults.

        Raises
        ------
        InputError
            A name that is not known; a value that is not a number or is out of its range.
        """
        values = np.array(self.default)
        for name, value in parameters.items():
            if name not in self.names:
                known = "; ".join(map(self.words, range(len(self))))
                raise InputError(name, "a shape parameter that the rig does not have", f"one of: {known}")
            k = self.names.index(name)
            number = isinstance(value, Real) and not isinstance(value, bool)
            if not number or not self.lower[k] <= value <= self.upper[k]:
                unit = f" {self.units[k]}" if self.units[k] else ""
                got = f"{float(value):g}" if number else repr(value)
                raise InputError(name, got, f"a number from {self.lower[k]:.4g} to {self.upper[k]:.4g}{unit}")
            values[k] = value
        return values

    def offsets(self, values):
        """(m, 3): U' − U at the values (K,) of the parameters."""
        return np.tensordot(values - self.default, self.vertices, 1)

    def moved_joints(self, values):
        """(J, 3): J' − J."""
        return np.tensordot(values - self.default, self.joints, 1)

    def at(self, values):
        """Return the same directions for a template that has these values, (K,)."""
        return replace(self, default=np.array(values, dtype=float))

    def mapped(self, change):
        """The same parameters with directions ``change(vertices)``, ``change(joints)``, for a rig in another frame or unit."""
        return replace(self, vertices=change(self.vertices), joints=change(self.joints))

    def rounded(self, error=0.0):
        """Return the same parameters with directions that a file holds in 16 bits.

        Parameters
        ----------
        error : float, default 0
            Largest error in a coordinate, in rig units, that is allowed at four standard deviations of a parameter. What 16
            bits cannot hold is rounded in any case, by at most 1/32,767 of the largest entry.
        """
        steps = _steps(self.vertices)
        allowed = np.where(self.spread > 0, error / (2 * np.maximum(self.spread, 1e-300)), 0.0)
        coarser = np.where(allowed > 0, 2.0 ** np.floor(np.log2(np.maximum(allowed, 1e-300))), 0.0)
        steps = np.maximum(steps, coarser)[:, None, None]
        return replace(self, vertices=np.rint(self.vertices / steps) * steps + 0.0)


def _steps(directions):
    """(K,) powers of two whose 16-bit multiples reach the largest entry of each direction."""
    most = np.abs(directions).max(axis=(1, 2), initial=0.0)
    return 2.0 ** np.ceil(np.log2(np.where(most > 0, most, 1.0) / _MOST))


def to_counts(directions):
    """Directions (K, m, 3) as 16-bit counts and their steps (K,), or as they are with steps 1 where that would change a bit."""
    steps = _steps(directions)
    counts = np.rint(directions / steps[:, None, None])
    back = counts * steps[:, None, None]
    if np.abs(counts).max(initial=0) > _MOST or not np.array_equal(back, directions):
        return directions, np.ones(len(directions))
    return counts.astype(np.int16), steps


def from_counts(counts, steps):
    """The directions that :func:`to_counts` took apart, (K, m, 3) float."""
    return counts.astype(float) * np.asarray(steps, dtype=float)[:, None, None]


def check_shapes(report, shapes, m, J):
    """A checked ShapeSpace with arrays of its own, or None where there is none or it has no parameter.

    Parameters
    ----------
    report : rig.checks.Reporter
        Raises the errors.
    shapes : ShapeSpace or None
    m, J : int
        Vertices and joints of the rig.
    """
    if shapes is None:
        return None
    if not isinstance(shapes, ShapeSpace):
        report.fail("shapes", type(shapes).__name__, "a ShapeSpace, or None")
    names, units = tuple(shapes.names), tuple(shapes.units)
    K = len(names)
    if len(set(names)) < K or not all(isinstance(n, str) and n.isidentifier() for n in names):
        report.fail("shapes, names", f"{list(names)}", "different names that can be keyword arguments")
    reserved = {"self", "random_state", "amount"} & set(names)
    if reserved:
        report.fail("shapes, names", repr(reserved.pop()), "another name, as this is an argument of Rig.subject")
    if len(units) != K or not all(isinstance(u, str) for u in units):
        report.fail("shapes, units", f"{list(units)}", f"a text for each of the {K} parameters")
    row = {key: report.array(f"shapes, {key}", getattr(shapes, key), (K,)) for key in _PER_PARAMETER}
    wrong = ~((row["lower"] <= row["default"]) & (row["default"] <= row["upper"]) & (row["lower"] < row["upper"]))
    if wrong.any():
        k = int(np.argmax(wrong))
        got = f"lower {row['lower'][k]:g}, default {row['default'][k]:g}, upper {row['upper'][k]:g} of {names[k]!r}"
        report.fail("shapes", got, "lower < upper with the default between them")
    if (row["spread"] < 0).any():
        report.fail("shapes, spread", f"{row['spread'].min():g}", "standard deviations of 0 and more")
    vertices = report.array("shapes, vertices", shapes.vertices, (K, m, 3))
    joints = report.array("shapes, joints", shapes.joints, (K, J, 3))
    return ShapeSpace(names=names, units=units, vertices=vertices, joints=joints, **row) if K else None
