"""The paper's losses: each is one function that returns its value and its gradients. docs/losses.md gives the definitions."""

from .chamfer import chamfer
from .composite import composite_chamfer, composite_structured_chamfer
from .laplacian import cotangent_matrix, laplacian_offsets, laplacian_posed
from .loopback import loopback
from .objective import PRESETS, LossWeights, objective
from .structured import structured_chamfer

__all__ = [
    "PRESETS",
    "LossWeights",
    "chamfer",
    "composite_chamfer",
    "composite_structured_chamfer",
    "cotangent_matrix",
    "laplacian_offsets",
    "laplacian_posed",
    "loopback",
    "objective",
    "structured_chamfer",
]
