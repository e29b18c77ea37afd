"""Loop-back loss L_Θ: can f read the pose back from what M made of it?"""

import numpy as np

__all__ = ["loopback"]


def loopback(predicted, theta):
    """L_Θ = ‖f(M(Θ', U)) − Θ'‖²  (eq. 3 of the paper), the mean over a batch where there is one.

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
    """
    away = np.asarray(predicted, dtype=float) - np.asarray(theta, dtype=float)
    batch = len(away) if away.ndim == 3 else 1
    return float(np.vdot(away, away)) / batch, (2.0 / batch) * away
