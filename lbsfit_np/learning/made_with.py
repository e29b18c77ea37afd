"""What results say that they were made with: what was learned, and the parameters of the fitter."""

import json
from dataclasses import replace

from .. import __version__
from .archive import learned_digests, model_digest, plain_parameters
from .plain import plain

__all__ = ["as_fitted", "as_learned", "settings_of"]

# Parameters that learning alone hangs on.
_OF_LEARNING = ("rounds", "held_out", "sequence", "smooth")


def settings_of(fitter, *, learning=False):
    """``FitResult.settings`` of a fitter's fits, or of those that learning leaves."""
    left_out = ("unit",) if learning else ("unit", *_OF_LEARNING)  # the unit is a field of its own
    settings = {name: value for name, value in plain_parameters(fitter).items() if name not in left_out}
    settings["training"] = settings["training"] or {}
    return json.loads(json.dumps(settings, default=_jsonable)) | {"version": __version__}


def _jsonable(value):
    """``default`` of ``json.dumps``: no fit is lost for how a parameter was written."""
    known = plain(value)
    return str(value) if known is value else known


def as_fitted(fitter, result, *, subject=None):
    """The result of a scan that a fitter has fitted, as ``subject`` where one was named."""
    return replace(result, model_digest=model_digest(fitter, subject), settings=settings_of(fitter))


def as_learned(fitter, collection, results):
    """The results, or None, that learning itself leaves of a collection's scans."""
    digests, out = learned_digests(fitter), list(results)
    for m in collection.members:
        if out[m.index] is not None:
            made = {"model_digest": digests[m.subject], "settings": settings_of(fitter, learning=True)}
            out[m.index] = replace(out[m.index], **made)
    return out
