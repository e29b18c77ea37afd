"""The files of one scan, written together, and what the summary says of it."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import in_words
from ..interrupts import held
from ..io.columns import ODD_X

__all__ = ["Writer", "draw", "entry", "fitted_entry", "remove", "unfitted_entry", "with_reasons"]


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
        from ..io.write import atomic_path, write_mesh_ply, write_points_ply
        from ..report.colors import label_colors, part_colors

        files, rig = self.files[index], self.rig
        if result.status != "ok":  # in the fit's own file, too, for runs that keep it
            result = replace(result, message=with_reasons(result.message, scan.notes))
        colors = part_colors(len(rig.parts))
        # All three get their names only once all three are complete. The fit first (the last that is opened): of what is left
        # where the process is killed in between, --existing skip then knows whose it is, and makes it anew.
        with held(), atomic_path(files.labels) as labels, atomic_path(files.mesh) as mesh, atomic_path(files.fit) as fit:
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
            for path in files.beside():  # of an earlier fit, which would then pass for this one's; links stay
                Path(os.path.realpath(path)).unlink(missing_ok=True)
        undrawn = [] if files.picture is None else draw(files, rig, scan.points, result)
        return fitted_entry(files, result, notes=[*scan.notes, *undrawn])


def with_reasons(message, notes):
    """The message of a fit in doubt, after what was noted about its scan that spoils any fit."""
    return "; ".join([*(note.rstrip(".") for note in notes if note.startswith(ODD_X)), message])


def unfitted_entry(files, message, **facts):
    """The entry of a scan that could not be fitted now; removes what an earlier run has written of it, as if it were its fit."""
    return entry(files, "failed", message="; ".join([message, *remove([files.fit, *files.beside()])]), **facts)


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
    """Write the picture of a fit that is written already; notes, one where it cannot be drawn: no fit is lost for a picture."""
    from ..report.fit_picture import fit_picture
    from ..report.render import write_png

    try:
        write_png(files.picture, fit_picture(rig, points, result))
    except Exception as error:  # noqa: BLE001 (whatever is wrong with a picture, the fit is right)
        return [f"no picture: {in_words(error)}", *remove([files.picture])]
    return []


def fitted_entry(files, result, *, kept=False, notes=()):
    """The entry of a scan whose fit is there, with the fit's own status; ``kept``: an earlier run has made it."""
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
        files={kind: path.name for kind, path in files.paths.items() if path.is_file()},
        notes=list(notes),
    )
