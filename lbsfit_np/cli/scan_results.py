"""The files of one scan, written together, and what the summary says of it."""

from dataclasses import dataclass, replace

from ..errors import in_words
from ..interrupts import held
from ..io.columns import ODD_X
from .earlier_results import is_fit

__all__ = ["Writer", "draw", "entry", "fitted_entry", "is_picture_of", "remove", "unfitted_entry", "with_reasons"]


def entry(scan, status, **facts):
    """What the summary says about one scan; file names are relative to its folder."""
    return {"name": scan.name, "input": scan.source, "status": status, **facts}


@dataclass(frozen=True)
class Writer:
    """``finish`` of ``fit_scans``: writes the files of a scan and returns its entry in the summary.

    Attributes
    ----------
    rig : Rig
    files : tuple of ScanFiles
    """

    rig: object
    files: tuple

    def __call__(self, index, scan, result):
        from ..io.write import atomic_paths, write_mesh_ply, write_points_ply
        from ..report.colors import label_colors, part_colors

        files, rig = self.files[index], self.rig
        if result.status != "ok":  # in the fit's own file, too, for runs that keep it
            result = replace(result, message=with_reasons(result.message, scan.notes))
        colors = part_colors(len(rig.parts))
        pictures = files.earlier_pictures()
        with held():
            # The fit first: of what is left where the process is killed among the names, --existing skip then knows whose it is,
            # and makes it anew.
            with atomic_paths(files.fit, files.mesh, files.labels) as (fit, mesh, labels):
                result.save(fit)
                write_mesh_ply(
                    mesh,
                    result.vertices,
                    rig.faces,
                    vertex_labels=rig.vertex_labels,
                    colors=colors[rig.vertex_labels],
                    part_names=rig.parts,
                )
                write_points_ply(
                    labels,
                    scan.points,
                    labels=result.labels,
                    confidence=result.confidence,
                    colors=label_colors(result.labels, result.confidence, len(rig.parts)),
                    normals=scan.normals,
                    part_names=rig.parts,
                )
            notes = remove(pictures)  # of an earlier fit, which would then pass for this one's
        notes += [] if files.picture is None else draw(files, rig, scan.points, result)
        return fitted_entry(files, result, notes=[*scan.notes, *notes])


def with_reasons(message, notes):
    """The message of a fit in doubt, after what was noted about its scan that spoils any fit."""
    return "; ".join([*(note.rstrip(".") for note in notes if note.startswith(ODD_X)), message])


def unfitted_entry(files, message, **facts):
    """The entry of a scan that could not be fitted now; a fit that an earlier run has left stays, and is named as such."""
    if is_fit(files.fit):
        message = f"{message.rstrip('.')}; an earlier fit is still there: {files.fit.name}"
        facts["earlier"] = files.fit.name
    return entry(files, "failed", message=message, **facts)


def remove(paths):
    """Remove what an earlier run has written, where it is there; notes on files that another program holds, say."""
    notes = []
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            notes.append(f"{path.name} of an earlier run cannot be removed ({error.strerror or error})")
    return notes


def draw(files, rig, points, result):
    """Write the picture of a fit that is written already; notes where it cannot be drawn: no fit is lost for a picture."""
    from ..report.fit_picture import fit_picture
    from ..report.render import write_png

    try:
        write_png(files.picture, fit_picture(rig, points, result))
    except Exception as error:  # noqa: BLE001 (whatever is wrong with a picture, the fit is right)
        note = f"no picture: {in_words(error)}"
        return [f"{note.rstrip('.')}; {files.picture.name} is not of this fit" if files.picture.exists() else note]
    return []


def is_picture_of(fit, picture):
    """Whether a picture is there and was drawn after the fit was written; an older one is of an earlier fit."""
    return picture.is_file() and picture.stat().st_mtime_ns >= fit.stat().st_mtime_ns


def fitted_entry(files, result, *, kept=False, notes=()):
    """The entry of a scan whose fit is there, with the fit's own status; ``kept``: an earlier run has made it."""
    there = {kind: path.name for kind, path in files.paths.items() if path.is_file()}
    if "picture" in there and not is_picture_of(files.fit, files.picture):
        del there["picture"]
    return entry(
        files,
        result.status,
        kept=kept,
        message=result.message,
        probability=round(result.probability, 4),
        evidence={name: round(value, 5) for name, value in result.evidence.items()},
        converged=result.converged,
        terms=result.terms,
        evaluations=result.evaluations,
        seconds=round(result.seconds, 3),
        scale=result.scale,
        unit=result.unit or None,
        subject=result.subject or None,
        points=len(result.labels),
        files=there,
        notes=list(notes),
    )
