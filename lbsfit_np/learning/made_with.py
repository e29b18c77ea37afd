"""What results say that they were made with: what was learned, and the parameters of the fitter."""

import json
from dataclasses import replace

from .. import __version__
from .archive import as_plain, learned_digests, model_digest, plain_parameters

__all__ = ["as_fitted", "as_learned", "settings_of"]

# Parameters that are a field of their own, or that learning alone hangs on.
_OTHERS = ("unit", "rounds", "held_out", "sequence", "smooth")


def settings_of(fitter):
    """``FitResult.settings`` of a fitter's fits."""
    settings = {name: value for name, value in plain_parameters(fitter).items() if name not in _OTHERS}
    return json.loads(json.dumps(settings, default=as_plain)) | {"version": __version__}


def as_fitted(fitter, result, *, subject=None):
    """The result of a scan that a fitter has fitted, as ``subject`` where one was named."""
    return replace(result, model_digest=model_digest(fitter, subject), settings=settings_of(fitter))


def as_learned(fitter, collection, results):
    """The results, or None, that learning itself leaves of a collection's scans."""
    digests, settings, out = learned_digests(fitter), settings_of(fitter), list(results)
    for m in collection.members:
        if out[m.index] is not None:
            out[m.index] = replace(out[m.index], model_digest=digests[m.subject], settings=settings)
    return out
