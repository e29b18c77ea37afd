"""The whole objective of a fit: L = L_{c²,λ} + λ_s L_{s²,λ} + λ_lap L_lap. The paper's L_Θ trains f, here by itself."""

from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError, did_you_mean
from .chamfer import neighbors, one_sided_terms
from .checks import (
    check_choice,
    check_flag,
    check_index,
    check_labels,
    check_number,
    check_same_length,
    check_set,
    check_weights,
)
from .laplacian import laplacian_offsets, laplacian_posed
from .structured import neighbors_in_parts

__all__ = ["BOTH", "PLAIN", "PRESETS", "STRUCTURED", "LossWeights", "as_weights", "check_compare", "objective"]

# Of weights.
_LARGEST = 1e100


@dataclass(frozen=True)
class LossWeights:
    """Weights of the objective's terms, for a template with a longest half-extent of 1; by default the paper's.

    ``PRESETS["default"]``, what fits use by default, has others: ``PRESETS["default"].replace(lam=0.2)`` changes one of them.

    Attributes
    ----------
    chamfer : float
        Weight of L_{c²,λ}; 1 in the paper. 0 leaves the plain term out: fits then need labels and λ_s.
    lam : float
        λ, the weight of the undeformed template in both composites.
    lam_s : float
        λ_s, the weight of L_{s²,λ}.
    lam_lap : float
        λ_lap.
    laplacian : {"posed", "offsets"}
        ‖K V^d‖ (the paper) or ‖K (U^d − U)‖.
    squared : bool
        Whether the Laplacian's norm is squared.
    """

    chamfer: float = 1.0
    lam: float = 0.5
    lam_s: float = 1.0
    lam_lap: float = 0.005
    laplacian: str = "posed"
    squared: bool = False

    def __post_init__(self):
        for name in ("chamfer", "lam", "lam_s", "lam_lap"):
            value = check_number(name, getattr(self, name))
            if value > _LARGEST:  # sums of weighted terms, and their gradients, would not be finite
                raise InputError(name, f"{value:.3g}", f"at most {_LARGEST:.0e}")
            object.__setattr__(self, name, value)
        object.__setattr__(self, "squared", check_flag("squared", self.squared))
        check_choice("laplacian", self.laplacian, ("posed", "offsets"))

    def replace(self, **changes):
        """Return the same weights with some changed; InputError for a name that is not one of them."""
        known = self.__dataclass_fields__
        for name in changes:
            if name not in known:
                raise InputError(name, "an unknown weight", f"one of {', '.join(known)}", did_you_mean(name, known))
        return replace(self, **changes)


PRESETS = {
    "paper": LossWeights(),
    "default": LossWeights(lam=0.1, lam_s=0.3, lam_lap=0.3, laplacian="offsets", squared=True),
}


# Of the stages before there are offsets, which need no term of the undeformed template. The first pose goes by the labels
# alone: the plain term would hold it where it happens to stand. Once the basin is right, labels only hold the pose back:
# borders between parts are where they err, and joints lie there.
STRUCTURED = LossWeights(chamfer=0.0, lam=0.0, lam_s=1.0, lam_lap=0.0)
BOTH = LossWeights(chamfer=1.0, lam=0.0, lam_s=1.0, lam_lap=0.0)
PLAIN = LossWeights(chamfer=1.0, lam=0.0, lam_s=0.0, lam_lap=0.0)


def as_weights(weights):
    """A preset's name or a LossWeights → LossWeights."""
    if isinstance(weights, LossWeights):
        return weights
    if isinstance(weights, str) and weights in PRESETS:
        return PRESETS[weights]
    raise InputError("weights", repr(weights), f"a LossWeights or one of {', '.join(map(repr, PRESETS))}")


def check_compare(weights, labels):
    """Raise InputError where no term of some LossWeights compares the mesh with the scan.

    ``labels``: whether there are parts for the structured term to go by.
    """
    if weights.chamfer or (labels and weights.lam_s):
        return
    got = "chamfer=0 and lam_s=0" if labels else "chamfer=0 without labels, which the structured term goes by"
    remedy = f"Pass a larger chamfer{' or lam_s' if labels else ''}."
    raise InputError("weights", got, "at least one term that compares the mesh with the scan", remedy)


@dataclass(frozen=True)
class ObjectiveValue:
    """Value, terms and gradients of :func:`objective`."""

    value: float
    terms: dict  # unweighted: "chamfer" L_{c²,λ}, "structured" L_{s²,λ}, "laplacian" L_lap
    grad_Vd: np.ndarray  # (m, 3)
    grad_V: np.ndarray  # (m, 3)
    grad_offsets: np.ndarray  # (m, 3), of the Laplacian on the offsets; the path through V^d is the skinning adjoint's


def objective(
    X,
    Vd,
    V,
    *,
    weights,
    x_labels=None,
    v_labels=None,
    offsets=None,
    K=None,
    x_weights=None,
    v_weights=None,
    x_index=None,
    x_part_index=None,
):
    """Evaluate L without the loop-back term, which plays no part in the fit of one scan.

    Parameters
    ----------
    X : (n, 3) array
        Scan points, in units in which the template's longest half-extent is 1.
    Vd, V : (m, 3) arrays
        M(Θ, U^d) and M(Θ, U).
    weights : LossWeights or {"default", "paper"}
    x_labels, v_labels : int arrays, optional
        Parts; without both, the structured term is left out.
    offsets : (m, 3) array, optional
        U^d − U; needed by the "offsets" Laplacian.
    K : sparse array, optional
        Cotangent matrix of U; without it, the Laplacian is left out.
    x_weights, v_weights, x_index, x_part_index
        Weights of the points and of the vertices, and search structures over X, plain and with labels.

    Returns
    -------
    ObjectiveValue

    Raises
    ------
    InputError
        As in the terms; also where labels of one side or offsets that a term needs are missing.
    """
    weights = as_weights(weights)
    Vd, V = (check_set("V", V),) * 2 if Vd is V else (check_set("Vd", Vd), check_set("V", V))
    check_same_length("V", V, "Vd", Vd)
    X = check_set("X", X)
    if x_labels is not None and v_labels is None:
        raise InputError("v_labels", "None", "the part of each vertex, where x_labels are given")
    if v_labels is not None and x_labels is None:
        remedy = "Leave both out to do without the structured term."
        raise InputError("x_labels", "None", "the part of each point, where v_labels are given", remedy)
    sides = check_weights("x_weights", x_weights, len(X)), check_weights("v_weights", v_weights, len(V))
    if weights.chamfer and x_index is not None:
        check_index("x_index", x_index, X)
    labels = None
    if weights.lam_s and x_labels is not None:
        labels = check_labels("x_labels", x_labels, len(X)), check_labels("v_labels", v_labels, len(V))
        if x_part_index is not None:
            check_index("x_part_index", x_part_index, X, labels[0])
    deformed = _data_terms(X, Vd, weights, labels, sides, x_index, x_part_index)
    undeformed = {}  # searching costs the same whatever λ
    if weights.lam:
        undeformed = deformed if V is Vd else _data_terms(X, V, weights, labels, sides, x_index, x_part_index)
    terms = {}
    value = 0.0
    grad_Vd, grad_V, grad_offsets = np.zeros_like(V), np.zeros_like(V), np.zeros_like(V)
    for name, weight in (("chamfer", weights.chamfer), ("structured", weights.lam_s)):
        if name in deformed:
            terms[name], g = deformed[name]
            grad_Vd += weight * g
            if name in undeformed:
                second, g = undeformed[name]
                terms[name] += weights.lam * second
                grad_V += weight * (weights.lam * g)
            value += weight * terms[name]
    if weights.lam_lap and K is not None:
        if weights.laplacian == "posed":
            terms["laplacian"], g = laplacian_posed(Vd, K, squared=weights.squared)
            grad_Vd += weights.lam_lap * g
        else:
            if offsets is None:
                raise InputError("offsets", "None", "U^d − U, shape (m, 3)", "The 'offsets' Laplacian needs them.")
            offsets = check_set("offsets", offsets)
            check_same_length("offsets", offsets, "V", V)
            terms["laplacian"], g = laplacian_offsets(offsets, K, squared=weights.squared)
            grad_offsets += weights.lam_lap * g
        value += weights.lam_lap * terms["laplacian"]
    return ObjectiveValue(value, terms, grad_Vd, grad_V, grad_offsets)


def _data_terms(X, V, weights, labels, sides, x_index, x_part_index):
    """L_c and L_s of one template with their gradients, by name, where they have a weight: the composites' summands.

    They are made together, as most points of both have the same neighbours.
    """
    found, of_all = {}, None
    if weights.chamfer:
        of_all = neighbors(X, V, x_index)
        found["chamfer"] = one_sided_terms(X, V, *of_all, *sides)
    if labels is not None:
        found["structured"] = one_sided_terms(X, V, *neighbors_in_parts(X, V, *labels, x_part_index, of_all=of_all), *sides)
    return found
