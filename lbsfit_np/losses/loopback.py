"""Loop-back loss L_Θ: can f read the pose back from what M made of it?"""

import numpy as np

from ..errors import InputError, as_floats, not_finite
from .checks import LARGEST

__all__ = ["loopback"]


def loopback(predicted, theta):
    """L_Θ = ‖f(M(Θ', U)) − Θ'‖²  (without a number in the paper); for a batch, the mean over it.

    Parameters
    ----------
    predicted : (J, 3) or (B, J, 3) array
        f(M(Θ', U)), radians.
    theta : array of the same shape
        Θ'.

    Returns
    -------
    value : float
        Squared radians.
    grad : array of the same shape
        ∂L_Θ/∂predicted.

    Raises
    ------
    InputError
        Wrong or different shapes, an empty batch, masked entries, numbers that are not finite.
    """
    expected = "numbers of shape (J, 3) or (B, J, 3)"
    predicted, theta = as_floats("predicted", predicted, expected), as_floats("theta", theta, expected)
    if predicted.ndim not in (2, 3) or predicted.shape[-1] != 3 or not predicted.size:
        flat = predicted.ndim in (1, 2) and predicted.size and predicted.shape[-1] % 3 == 0
        remedy = "Reshape to (B, J, 3), or one pose to (J, 3)." if flat else None
        raise InputError("predicted", f"shape {predicted.shape}", "shape (J, 3) or (B, J, 3)", remedy)
    if theta.shape != predicted.shape:
        raise InputError("theta", f"shape {theta.shape}", f"shape {predicted.shape}, as predicted has")
    for name, value in (("predicted", predicted), ("theta", theta)):
        if not np.isfinite(value).all():
            raise InputError(name, not_finite(int((~np.isfinite(value)).sum()), "value"), "finite numbers")
        if np.abs(value).max() >= LARGEST:
            raise InputError(name, f"angles of up to {np.abs(value).max():.3g}", f"angles below {LARGEST:.0e}")
    away = predicted - theta
    batch = len(away) if away.ndim == 3 else 1
    return float(np.vdot(away, away)) / batch, (2.0 / batch) * away
