"""What is known of registered scans: which places of one scan are which of another, and who was scanned.

Three kinds of truth, which the benchmark of pairs asks in the same way: ``asked`` draws places of a scan whose correspondences
are known, ``true`` says where these are on another.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..correspondence import at_places, surface_places
from ..errors import FileError, InputError, listed
from ..starts.scale import extent

__all__ = ["Asked", "Landmarks", "PairScan", "Registrations", "VertexOrder", "note_on_truth", "read_registrations"]


@dataclass(frozen=True)
class PairScan:
    """A scan of the benchmark.

    Attributes
    ----------
    name : str
        What its fit is called; no two are the same.
    path : Path
    subject : str
        Who was scanned.
    """

    name: str
    path: Path
    subject: str


@dataclass(frozen=True)
class Asked:
    """Places of a scan whose correspondences are asked for.

    Attributes
    ----------
    points : (n, 3) array
        In the scan's frame and unit.
    keys : object
        By which the truth knows them again.
    """

    points: np.ndarray
    keys: object


@dataclass(frozen=True)
class VertexOrder:
    """Vertex i of one scan is vertex i of every other.

    Attributes
    ----------
    n : int
        Vertices of each.
    """

    n: int

    what = "vertex order"

    def check(self, i, points):
        """Raise where scan i, with these points, does not fit the truth."""
        if len(points) != self.n:
            raise InputError(
                "truth",
                f"scans of {self.n} and {len(points)} vertices, and a table without truth for them",
                "scans with the same vertices in the same order, or columns that say which points correspond",
                "Add the columns (name, vertex), (name, x, y, z) or (registration).",
            )

    def off(self, i, points):
        """Places are the scan's own."""
        return 0.0

    def linked(self, a, b):
        """Whether anything is known of the pair."""
        return True

    def asked(self, i, points, most, rng):
        """At most so many random places of scan i."""
        rows = _some_rows(np.arange(self.n), most, rng)
        return Asked(points[rows], rows)

    def true(self, asked, b, on_b):
        """Which of the places are known on scan b, a PointIndex over its points, and where they are: rows (k,), (k, 3)."""
        return np.arange(len(asked.points)), on_b.points[asked.keys]


@dataclass(frozen=True)
class Landmarks:
    """Places with names: those of one name correspond.

    Attributes
    ----------
    places : tuple of dict
        For each scan name → vertex (int), or its place (three floats).
    lines : tuple of dict
        For each scan name → the line that says so, for errors.
    """

    places: tuple
    lines: tuple

    what = "named places"

    def check(self, i, points):
        """Raise where scan i, with these points, does not fit the truth."""
        from scipy.spatial import cKDTree

        given = {name: place for name, place in self.places[i].items() if not isinstance(place, int)}
        places = np.array(list(given.values())).reshape(-1, 3)
        if len(places) > 2 and _across(places) * _SMALL < _across(points):  # right where they all lie on it, as in a face
            far = cKDTree(points).query(places)[0] * _SMALL > _across(points)
        else:
            far = _beyond(places, points)
        if far.any():
            name = list(given)[np.argmax(far)]
            where = f"{name!r} at {_said(given[name])} in line {self.lines[i].get(name, '?')}"
            box = f"the scan goes from {_said(points.min(0))} to {_said(points.max(0))}"
            raise InputError("truth", f"{where}, while {box}", "places on the scan", _FRAME)
        for name, place in self.places[i].items():
            if isinstance(place, int) and place >= len(points):
                got = f"vertex {place} for {name!r} in line {self.lines[i][name]}"
                raise InputError("truth", got, f"vertices that the scan has, 0 to {len(points) - 1}", "Vertices count from 0.")

    def off(self, i, points):
        """How far places lie off scan i, the median in its extent; 0 where some lie on it, as where it shows a part."""
        from scipy.spatial import cKDTree

        places = np.array([place for place in self.places[i].values() if not isinstance(place, int)]).reshape(-1, 3)
        if not len(places) or not extent(points):
            return 0.0
        far = cKDTree(points).query(places)[0] / extent(points)
        return 0.0 if np.mean(far < _ON) > _SOME else float(np.median(far))

    def linked(self, a, b):
        """Whether anything is known of the pair."""
        return not self.places[a].keys().isdisjoint(self.places[b])

    def asked(self, i, points, most, rng):
        """At most so many random places of scan i, of those that another scan has, too."""
        alone = self.alone()
        names = [name for name in self.places[i] if name not in alone]
        names = [names[k] for k in _some_rows(np.arange(len(names)), most, rng)]
        return Asked(self._at(i, names, points), names)

    def true(self, asked, b, on_b):
        """Which of the places are known on scan b, and where they are."""
        rows = [k for k, name in enumerate(asked.keys) if name in self.places[b]]
        return np.array(rows, dtype=int), self._at(b, [asked.keys[k] for k in rows], on_b.points)

    def alone(self):
        """Names that one scan alone has, which no pair has therefore: name → that scan."""
        whose = {}
        for i, places in enumerate(self.places):
            for name in places:
                whose.setdefault(name, []).append(i)
        return {name: scans[0] for name, scans in whose.items() if len(scans) == 1}

    def _at(self, i, names, points):
        places = [self.places[i][name] for name in names]
        return np.array([points[p] if isinstance(p, int) else p for p in places]).reshape(-1, 3)


@dataclass(frozen=True)
class Registrations:
    """Each scan has a mesh registered to it, whose vertices mean the same on all: the truth is as ``correspondence.transfer``.

    Attributes
    ----------
    vertices : tuple of ((m, 3) array or None)
        For each scan its registration, in the scan's frame and unit; None where there is none.
    faces : (F, 3) int array
    reliable : tuple of ((n,) bool array or None), optional
        Points of each scan where the registration can be relied on; None for all.
    files : tuple of Path, optional
        Where the registrations were read.
    """

    vertices: tuple
    faces: np.ndarray
    reliable: tuple = ()
    files: tuple = ()

    what = "registrations"

    def check(self, i, points):
        """Raise where scan i, with these points, does not fit the truth."""
        known, V = self._reliable(i), self.vertices[i]
        # Half of the points may be of the floor, and most of the mesh where nothing was scanned.
        if V is not None and (np.mean(_beyond(points, V)) > 0.5 or _across(points) * _SMALL < _across(V)):
            box = f"the scan goes from {_said(points.min(0))} to {_said(points.max(0))}"
            got = f"a registration from {_said(V.min(0))} to {_said(V.max(0))}, while {box}"
            raise InputError("truth", got, "a mesh that lies on the scan", _FRAME)
        if known is not None and len(known) != len(points):
            raise InputError("truth", f"{len(known)} flags of reliable points", f"{len(points)}, one for each point of the scan")
        if known is not None and not known.any():
            raise InputError("truth", "no reliable point", "some points where the registration is reliable")

    def off(self, i, points):
        """How far the registration lies off scan i, in its extent: the median of the points, or of the mesh where that is less.

        Points may be of the floor, and most of the mesh where nothing was scanned.
        """
        from scipy.spatial import cKDTree

        known, V = self._reliable(i), self.vertices[i]
        if V is None or not extent(points):
            return 0.0
        own = points if known is None else points[known]
        own = own[:: -(-len(own) // _LOOKED_AT)]
        to_mesh = np.linalg.norm(at_places(*surface_places(own, V, self.faces), V) - own, axis=1)
        to_scan = cKDTree(points).query(V[:: -(-len(V) // _LOOKED_AT)])[0]
        return float(min(np.median(to_mesh), np.median(to_scan)) / extent(points))

    def linked(self, a, b):
        """Whether anything is known of the pair."""
        return self.vertices[a] is not None and self.vertices[b] is not None

    def asked(self, i, points, most, rng):
        """At most so many random places of scan i."""
        known = self._reliable(i)
        rows = _some_rows(np.arange(len(points)) if known is None else np.flatnonzero(known), most, rng)
        return Asked(points[rows], surface_places(points[rows], self.vertices[i], self.faces))

    def true(self, asked, b, on_b):
        """Which of the places are known on scan b, and where they are: where its registration, too, can be relied on."""
        places, known = at_places(*asked.keys, self.vertices[b]), self._reliable(b)
        rows = np.arange(len(places)) if known is None else np.flatnonzero(known[on_b.nearest(places)])
        return rows, places[rows]

    def _reliable(self, i):
        return self.reliable[i] if self.reliable else None


# What is to be done about a truth that lies elsewhere.
_FRAME = "Give it in the scan's own frame and unit."
# What is smaller by more than this factor is in another unit; so is what lies farther away than so many times its extent, as
# a scan may show a small part of what the truth tells of.
_SMALL, _FAR = 50, 10


# A truth further off its scan than this share of the extent is asked about: shifted along its length it is half on the scan …
_ASIDE = 0.05
# … unless more than the second share of the named places are nearer than the first: the scan may show a part.
_ON, _SOME = 0.02, 0.25
# Of points and vertices so many tell how far they are from each other.
_LOOKED_AT = 1000


def note_on_truth(what, off):
    """A note, in a list, where the truth lies beside its scans.

    Parameters
    ----------
    what : str
        Of the truth.
    off : dict of str to float
        By the scans' names, in their extents.
    """
    aside = {name: share for name, share in off.items() if share > _ASIDE}
    if not aside:
        return []
    far, their = f"{100 * np.median(list(aside.values())):.0f} % of the extent", "scan's" if len(aside) == 1 else "scans'"
    where = f"{what} of {listed(list(aside), 5)} lie {far} off the points (median)"
    return [f"{where}: are they in the {their} frame and unit? Errors are measured from them"]


def _beyond(places, points):
    """(k,) bool: places that are as far from the box of points as those in another unit are."""
    outside = places - np.clip(places, points.min(0), points.max(0))
    return np.linalg.norm(outside, axis=1) > _FAR * _across(points)


def _across(points):
    return np.linalg.norm(np.ptp(points, axis=0))


def _said(place):
    return "(" + ", ".join(f"{x:.4g}" for x in place) + ")"


def read_registrations(paths, what="registrations"):
    """Meshes of one topology.

    Parameters
    ----------
    paths : sequence of (Path or None)
        For each scan; one at least is there.
    what : str
        What errors call them.

    Returns
    -------
    tuple of ((m, 3) array or None), (F, 3) int array

    Raises
    ------
    FileError
        A mesh that cannot be read, or is not of the same triangles as the others.
    """
    from ..io.scans import load_mesh

    vertices, first, faces = [], None, None
    for path in paths:
        if path is None:
            vertices.append(None)
            continue
        v, f = load_mesh(path)
        if first is None:
            first, m, faces = path, len(v), f
        elif len(v) != m or not np.array_equal(f, faces):
            got = f"a mesh of {len(v)} vertices and {len(f)} triangles that are not those of {first} ({m} and {len(faces)})"
            raise FileError(str(path), got, f"{what} of one mesh, so that each vertex is the same place on all scans")
        vertices.append(v)
    return tuple(vertices), faces


def _some_rows(rows, most, rng):
    """At most so many of the rows, in their order."""
    return rows if len(rows) <= most else np.sort(rng.choice(rows, most, replace=False))
