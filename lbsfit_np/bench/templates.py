"""How far the templates of fits are from the true ones, of benchmarks and of the study."""

import numpy as np

from .measure import vertex_error

__all__ = ["learned_templates", "template_gap", "templates_of"]


def learned_templates(fitter):
    """What was learned, as the scans have it.

    Parameters
    ----------
    fitter : LBSFitter
        That has learned.

    Returns
    -------
    dict of id to (m, 3) array
        The subjects' U^d, in the unit of their scans.
    """
    root = fitter.rig.root
    return {k: _in_scan_units(fitter.unit_[k], t.vertices, t.joints[root]) for k, t in fitter.template_.items()}


def templates_of(rig, results):
    """The template of each fit, as its scan has it.

    Parameters
    ----------
    rig : Rig
    results : sequence of FitResult

    Returns
    -------
    list of (m, 3) arrays
        U^d in the unit of the scan.
    """
    return [_in_scan_units(r.scale, rig.vertices + r.offsets, r.rest_joints[rig.root]) for r in results]


def template_gap(rig, templates, true):
    """How far templates are from the true ones, mean distances of vertices in half sizes.

    Parameters
    ----------
    rig : Rig
    templates, true : list of (m, 3) arrays
        U^d and U^gt, as scans in rig units have them.

    Returns
    -------
    dict
        "before" ‖U − U^gt‖, "after" ‖U^d − U^gt‖, and both "up to a shift", which no scan shows.
    """
    half, U = rig.size / 2, rig.vertices
    centred = [_centred(V) for V in true]
    return {
        "before": _mean(vertex_error(U, V) / half for V in true),
        "after": _mean(vertex_error(D, V) / half for D, V in zip(templates, true, strict=True)),
        "before, up to a shift": _mean(vertex_error(_centred(U), V) / half for V in centred),
        "after, up to a shift": _mean(vertex_error(_centred(D), V) / half for D, V in zip(templates, centred, strict=True)),
    }


def _in_scan_units(unit, template, root):
    """A template in the unit of the scans, in which people are made; the root joint stays, as where people grow."""
    return root + unit * (template - root)


def _centred(vertices):
    vertices = np.asarray(vertices)
    return vertices - vertices.mean(axis=0)


def _mean(values):
    return float(np.mean(list(values)))
