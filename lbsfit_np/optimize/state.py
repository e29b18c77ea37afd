"""State: what a fit changes, and how it is laid out in the optimiser's vector: the angles that turn come first."""

from dataclasses import dataclass, replace

import numpy as np

__all__ = ["IN_UNIT", "Layout", "MOST_PROPORTION", "SIZED", "State", "free_angles"]

# The blocks of a pose where the scan's unit is known, and where it is not.
IN_UNIT = ("pose", "translation")
SIZED = (*IN_UNIT, "scale")
# Of a coefficient of the proportions, either way.
MOST_PROPORTION = 0.5


@dataclass(frozen=True)
class State:
    """A pose of a changed template, in the normalised frame of a :class:`~lbsfit_np.optimize.problem.Problem`.

    The deformed template is U^d = U + Σ_k c_k b_k + residual: proportions and girths of the rig's bones, and the rest. Where
    there is a displacement, the skin has that in place of the residual; the joints stay where the residual has them.
    """

    theta: np.ndarray  # (J, 3)
    translation: np.ndarray  # (3,)
    scale: float  # relative to the problem's reference scale
    coefficients: np.ndarray  # (k,) c, of the model's family: proportions, girths, shifts of joints
    residual: np.ndarray | None  # (m, 3); None for 0
    displacement: np.ndarray | None = None  # (m, 3), of ``optimize.registration``

    def replace(self, **changes):
        """The same state but for some fields."""
        return replace(self, **changes)

    def in_unit(self, q):
        """The same state in a frame of q times the unit, that of its problem's ``in_unit``."""
        return replace(self, scale=self.scale / q, translation=self.translation / q)


def free_angles(rig):
    """(J, 3) bool: the angles of the block "pose", those that turn and the root's."""
    turning = rig.turning.copy()
    turning[rig.root] = True
    return turning


class Layout:
    """Which blocks of a State are free, and where they stand in the vector x.

    In x, the place of the scan is that of the template's root joint, t + s J_root, and the scale is one about it: of a rig that
    lies far from its own origin a change of scale alone would carry the mesh away.

    Parameters
    ----------
    rig : Rig
        Its moving joints' axes with room between their limits are free in the block "pose"; the root is unbounded.
    free : collection of {"pose", "translation", "scale", "proportions", "residual"}
    """

    def __init__(self, rig, free, n_coefficients):
        self._free = frozenset(free)
        m = len(rig.vertices)
        self.turning = turning = free_angles(rig)
        # One unit of each block changes the loss by a comparable amount, which is what L-BFGS starts from: a single
        # vertex counts for 1/m of the loss where an angle moves many.
        self._residual_unit = 0.25 * np.sqrt(m)
        sizes = {"pose": int(turning.sum()), "translation": 3, "scale": 1, "proportions": n_coefficients, "residual": 3 * m}
        self._spans, start = {}, 0
        for block, size in sizes.items():
            if block in self._free:
                self._spans[block] = slice(start, start + size)
                start += size
        self.size = start
        self.blocks = tuple(self._spans)
        lower, upper = rig.lower.copy(), rig.upper.copy()
        lower[rig.root], upper[rig.root] = -np.inf, np.inf
        self._all_limits = lower, upper
        self._root = rig.joints[rig.root]
        self._limits = lower[turning], upper[turning]

    def pack(self, state):
        """State → x."""
        x = np.empty(self.size)
        values = {
            "pose": lambda: state.theta[self.turning],
            "translation": lambda: state.translation + state.scale * self._root,
            "scale": lambda: np.log(state.scale),
            "proportions": lambda: state.coefficients,
            "residual": lambda: 0.0 if state.residual is None else state.residual.ravel() / self._residual_unit,
        }
        for block, span in self._spans.items():
            x[span] = values[block]()
        return x

    def unpack(self, x, base):
        """x → State; blocks that are not free come from ``base``."""
        changes, place, scale = {}, base.translation + base.scale * self._root, base.scale
        for block, span in self._spans.items():
            value = x[span]
            if block == "pose":
                theta = base.theta.copy()
                theta[self.turning] = value
                changes["theta"] = theta
            elif block == "translation":
                place = value
            elif block == "scale":
                changes["scale"] = scale = float(np.exp(value[0]))
            elif block == "proportions":
                changes["coefficients"] = value.copy()
            else:
                changes["residual"] = value.reshape(-1, 3) * self._residual_unit
        if self._free & {"translation", "scale"}:
            changes["translation"] = place - scale * self._root
        return base.replace(**changes)

    def gradient(self, state, theta, translation, scale, coefficients, residual):
        """Gradients to the State's fields → gradient to x."""
        g = np.empty(self.size)
        for block, span in self._spans.items():
            if block == "pose":
                g[span] = theta[self.turning]
            elif block == "translation":
                g[span] = translation
            elif block == "scale":
                g[span] = (scale - translation @ self._root) * state.scale
            elif block == "proportions":
                g[span] = coefficients
            else:
                g[span] = residual.ravel() * self._residual_unit
        return g

    def units(self, state):
        """(size,): what a step of 1 in x is in the unit of its block, in which ``optimize.jacobian`` has its columns."""
        units = np.ones(self.size)
        for block, unit in (("scale", state.scale), ("residual", self._residual_unit)):
            if block in self._spans:
                units[self._spans[block]] = unit
        return units

    def bounds(self):
        """(lower, upper) of x: joint limits on the pose, a factor of 3 on the scale, ±``MOST_PROPORTION`` on proportions."""
        lower, upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        if "pose" in self._spans:
            lower[self._spans["pose"]], upper[self._spans["pose"]] = self._limits
        for block, most in (("scale", np.log(3.0)), ("proportions", MOST_PROPORTION)):
            if block in self._spans:
                lower[self._spans[block]], upper[self._spans[block]] = -most, most
        return lower, upper

    def inside(self, state):
        """The state moved inside the limits; joints and axes that cannot turn are put back to where they are held."""
        state = state.replace(theta=np.clip(state.theta, *self._all_limits))
        x = self.pack(state)
        lower, upper = self.bounds()
        return self.unpack(np.clip(x, lower, upper), state)
