"""The paper's ablations as switches of the loop."""

from dataclasses import dataclass

from ..errors import InputError, brief

__all__ = ["VARIANTS", "Variant", "as_variant"]


@dataclass(frozen=True)
class Variant:
    """What a variant uses.

    Attributes
    ----------
    name : str
    labels : bool
        The structured term, and starts from parts.
    inferred_poses : bool
        Training scans take half of their poses from the fits; else all are uniform.
    deformed : bool
        Training scans are made of the subjects' templates; else of the rig's, with random proportions.
    library : bool
        Starts from synthesised poses that look like the scan, beside the regressor's.
    skinning : bool
        False: no joints at all, vertices move freely.
    """

    name: str
    labels: bool = True
    inferred_poses: bool = True
    deformed: bool = True
    library: bool = True
    skinning: bool = True


VARIANTS = {
    v.name: v
    for v in (
        Variant("joint"),
        Variant("pose-only", deformed=False),
        Variant("rand", inferred_poses=False, deformed=False),
        Variant("cd", labels=False, library=False),
        Variant("free-form", labels=False, inferred_poses=False, deformed=False, library=False, skinning=False),
    )
}


def as_variant(name):
    """The Variant of that name."""
    if name not in VARIANTS:
        raise InputError("variant", brief(name), " or ".join(map(repr, VARIANTS)))
    return VARIANTS[name]
