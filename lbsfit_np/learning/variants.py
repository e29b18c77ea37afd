"""The paper's ablations as switches of the loop."""

from dataclasses import dataclass

from ..errors import InputError, brief, did_you_mean

__all__ = ["VARIANTS", "Variant", "as_variant", "note_on", "unused"]

# What means nothing without skinning, as there is no pose to look for and nothing to train.
_OF_SKINNING = ("partial", "cropped", "effort", "registration", "training_scans", "training", "rounds", "held_out")
_OF_SKINNING += ("sequence", "smooth")
# What then tells nothing but where a floor, a table or a wall may be.
_OF_FLOORS = ("orientation", "up")


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
    prior : bool
        Each pose is drawn to what all tell of poses, as far as its own scan leaves it open, and held so while templates
        are found.
    skinning : bool
        False: no joints at all, vertices move freely.
    """

    name: str
    labels: bool = True
    inferred_poses: bool = True
    deformed: bool = True
    library: bool = True
    prior: bool = True
    skinning: bool = True


VARIANTS = {
    v.name: v
    for v in (
        Variant("joint"),
        Variant("pose-only", deformed=False),
        Variant("rand", inferred_poses=False, deformed=False, prior=False),
        Variant("cd", labels=False, library=False, prior=False),
        Variant("free-form", labels=False, inferred_poses=False, deformed=False, library=False, prior=False, skinning=False),
    )
}


def as_variant(name):
    """The Variant of that name."""
    if not isinstance(name, str) or name not in VARIANTS:
        raise InputError("variant", brief(name), " or ".join(map(repr, VARIANTS)), did_you_mean(name, VARIANTS))
    return VARIANTS[name]


def unused(name, given):
    """Those of the parameters ``given``, by their names, that mean nothing in a variant."""
    return [] if as_variant(name).skinning else [key for key in given if key in _OF_SKINNING]


def note_on(name, given):
    """What is to be known of a variant without skinning and of the options ``given``, in a line; nothing of others."""
    if as_variant(name).skinning:
        return ""
    words = [f"in the variant {name}, scans must face the same way as the rig"]
    of_floors = [key for key in given if key in _OF_FLOORS]
    for keys, one, several in (
        (of_floors, "only says where a floor may be", "only say where a floor may be"),
        (unused(name, given), "has no effect", "have no effect"),
    ):
        if keys:
            flags = ", ".join(f"--{key.replace('_', '-')}" for key in keys)
            words.append(f"{flags} {one if len(keys) == 1 else several}")
    return "; ".join(words)
