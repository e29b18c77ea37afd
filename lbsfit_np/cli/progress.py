"""Progress for people: a bar on a terminal, plain lines elsewhere."""

import os
import re
import sys
import time

from ..errors import counted
from ..io.columns import ODD_X

__all__ = ["SILENCE", "LearningProgress", "Progress", "bar", "in_digits", "of_all", "percentage_bar", "say", "span"]

# What the stages of LBSFitter.fit do, in words; others are called by their names.
_STAGES = {
    "pretraining": "training on synthetic scans of the rig (once per rig and settings)",
    "first fits": "fitting each scan by itself",
    "templates": "fitting the subjects' templates",
    "segmenter": "training the segmenter on scans like these",
    "labels": "labelling the scans",
    "results": "computing the results",
}
# Seconds, at least, between lines about one stage where there is no bar.
SILENCE = 60
# Of a terminal that does not tell.
_COLUMNS, _ROWS = 80, 24


def say(text):
    """A line on standard output, at once."""
    print(text, flush=True)


def in_digits(probability, *bounds):
    """A probability in two digits, or in as many as show on which side of a status' bound, or another, it is."""
    from ..fitting.confidence import FAILED, SUSPECT

    digits = 2
    while any((probability < bound) != (round(probability, digits) < bound) for bound in (FAILED, SUSPECT, *bounds)):
        digits += 1
    return f"{probability:.{digits}f}"


def _of_doubt(entry):
    """The first reason why a fit that is there is in doubt, as the table at the end has all; why there is none, in full."""
    if "files" not in entry:
        return entry["message"]
    first, *more = entry["message"].split("; ")
    return f"{first}{'; …' if more else ''} (right with probability {in_digits(entry['probability'])})"


def _unsaid(notes, said):
    """One scan's notes of kinds that no scan had before, of which ``said`` keeps note: hundreds have the same to say.

    What spoils the fit of each scan that has it is always said.
    """
    # Counts do not tell kinds apart; digits in names, such as those of columns, do.
    kinds = [re.sub(r"(?<![\w'])\d+", "0", note) for note in notes]
    out = [note for note, kind in zip(notes, kinds) if kind not in said or note.startswith(ODD_X)]
    said.update(kinds)
    return out


class Progress:
    """Shows how a run goes on.

    Parameters
    ----------
    total : int
        Scans to fit.
    terminal : bool, optional
        Whether to draw bars; default: whether standard error is a terminal.
    clock : callable, optional
        Seconds, for tests.
    """

    def __init__(self, total, terminal=None, clock=time.monotonic):
        self.total, self.done = total, 0
        self.terminal = sys.stderr.isatty() if terminal is None else terminal
        self._bar, self._said = None, set()
        self._stages = LearningProgress(0, self.terminal, clock)

    def training(self, share):
        """Pretraining is done to this share, in [0, 1]; shown as ``lbsfit learn`` shows it."""
        self._stages("pretraining", share)
        if share >= 1 and self.terminal:
            self._stages.close()

    def fitting(self):
        """What fits need is there; the first may take a while."""
        if self.terminal:
            self._stages.close()
            if self._bar is None:
                self._draw(self.done)
        else:
            self.line(f"fitting {counted(self.total - self.done, 'scan')}")

    def scan(self, entry):
        """One more scan is done: ``entry`` of the summary."""
        self.done += 1
        if entry["status"] in ("failed", "suspect"):
            text = f"{entry['name']}: {entry['status']}: {_of_doubt(entry)}"
            where = sys.stderr if entry["status"] == "failed" else sys.stdout
        else:
            how = f"fitted in {entry['seconds']:.1f} s, recon {entry['terms']['recon']:.4f}"
            if entry.get("evidence"):
                how += f", right with probability {in_digits(entry['probability'])}"
            text = f"{entry['name']}: {how}, {entry['message']}"
            where = sys.stdout
        if not self.terminal:
            print(f"[{self.done}/{self.total}] {text}", file=where, flush=True)
            return
        if entry["status"] in ("failed", "suspect"):
            self.line(text)
            if self._bar is None:  # before the training, whose bar comes first
                return
        if self._bar is None:
            self._draw(self.done - 1)
        self._bar.set_postfix_str(entry["name"], refresh=False)
        self._bar.update()
        if entry["status"] in ("failed", "suspect"):  # its line stands above a bar that has not counted it yet
            self._bar.refresh()

    def _draw(self, done):
        self._bar = bar(total=self.total, initial=done, desc="scans", unit="scan")

    def notes(self, name, notes):
        """What was noted about a scan, each a line that stays; of each kind, counts aside, those of the first scan."""
        for note in _unsaid(notes, self._said):
            self.line(f"note: {name}: {note}")

    def line(self, text):
        """A line that stays."""
        if self._bar is not None:
            self._bar.write(text, file=sys.stderr)
        else:
            print(text, file=sys.stderr if self.terminal else sys.stdout, flush=True)

    def close(self):
        """Leave the terminal in order."""
        self._stages.close()
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class LearningProgress:
    """Shows how learning goes on: the ``progress`` of ``LBSFitter.fit``, and failures of single scans.

    Parameters
    ----------
    rounds : int
        At most.
    terminal, clock
        As for :class:`Progress`.
    """

    def __init__(self, rounds, terminal=None, clock=time.monotonic):
        self.rounds, self.round = rounds, 0
        self.terminal = sys.stderr.isatty() if terminal is None else terminal
        self._clock = clock
        self._stage, self._bar, self._said = None, None, set()
        self._began, self._took, self._went_on = None, [], False
        self._share, self._stage_began, self._first, self._told = 0.0, None, 0.0, None

    def __call__(self, stage, share, figures=None):
        """``stage`` is done to ``share``; ``figures`` at the end of a round."""
        if figures is not None:
            self._end_of_round(figures)
            return
        if stage != self._stage:
            self._begin(stage, share)
        elif share < self._share:
            self._stage_began, self._first = self._clock(), share  # the same once more
        self._share = share
        if self._bar is None:
            self._tell()
        else:
            self._bar.set_postfix_str(self._left_in_words(), refresh=False)
            self._bar.update(100 * share - self._bar.n)

    def failed(self, name, message):
        """A scan that cannot be used."""
        if self.terminal:  # a line of a stage need not be said again
            self.close()
        print(f"{name}: failed: {message}", file=sys.stderr, flush=True)

    def notes(self, name, notes):
        """What was noted about a scan; of each kind, counts aside, those of the first scan."""
        notes = _unsaid(notes, self._said)
        if notes and self.terminal:
            self.close()
        for note in notes:
            print(f"note: {name}: {note}", file=sys.stderr if self.terminal else sys.stdout, flush=True)

    def close(self):
        """Leave the terminal in order."""
        if self._bar is not None:
            self._bar.close()
        self._bar, self._stage = None, None

    def _begin(self, stage, share):
        self.close()
        self._stage, self._share, self._first = stage, share, share  # what an earlier run has done takes no time
        self._went_on |= share >= 1
        self._stage_began = self._told = self._clock()
        words = _STAGES.get(stage, stage)
        if stage in ("results", "smoothing"):
            self.round = 0  # all rounds are over, perhaps before their number
        if self.round:
            words = f"round {self.round} of at most {self.rounds}: {words}"
        if self.terminal:
            self._bar = percentage_bar(words, postfix=self._left_in_words())
        else:
            print(words, flush=True)

    def _end_of_round(self, figures):
        self.close()
        now, k = self._clock(), figures["round"]
        # Of a round that went on with an earlier run's steps, the seconds are of the rest; of one that was all done, of all.
        rest = self._went_on and self._began is not None and figures["seconds"] < now - self._began + 1
        if k and not rest:
            self._took.append(figures["seconds"])
        self._began, self.round, self._went_on = now, k + 1, False
        of = {"recon": "on the scans learned from", "recon_held_out": "on those held out"}
        told = [f"{figures[name]:.4f} {whose}" for name, whose in of.items() if figures[name] is not None]
        words = [f"recon {', '.join(told)}"]
        if "new_starts_won" in figures:
            n = figures["new_starts_won"]
            words.append(f"{counted(n, 'scan')} got a better pose from a new start")
        if n := figures.get("beyond"):
            words.append(f"points beyond the rig left out in {counted(n, 'scan')}")
        if n := figures.get("failed"):
            words.append(f"{counted(n, 'fit')} all but certainly wrong")
        words.append(f"took {span(figures['seconds'])}")
        if k < self.rounds and self._took:
            words.append(self._left_in_words())
        name = f"round {k} of at most {self.rounds}" if k else "each scan by itself, with its own proportions"
        print(f"{name}: {'; '.join(words)}", file=sys.stderr if self.terminal else sys.stdout, flush=True)

    def _tell(self):
        """Where there is no bar, a line now and then in a stage that takes long."""
        left = self._left_in_words()
        if left and self._share < 1 and self._clock() - self._told >= SILENCE:
            self._told = self._clock()
            print(f"{_STAGES.get(self._stage, self._stage)}: {self._share:.0%}, {left}", flush=True)

    def _left_in_words(self):
        """How long it is until the last round would end, once one has shown how long they take; rounds may end before.

        Until then, and after the rounds, how long it is until the stage ends, by the share of it that is done.
        """
        if not self._took or not self.round:
            took, done = 0.0 if self._stage is None else self._clock() - self._stage_began, self._share - self._first
            return f"about {span(took / done * (1 - self._share))} left in this step" if took and done else ""
        mean = sum(self._took) / len(self._took)
        left = (self.rounds - self.round + 1) * mean - (self._clock() - self._began)
        return f"at most about {span(max(left, 0))} left for the rounds"


def of_all(k, n, what="scan"):
    """So many of all: "1 of 1 scan", "1 of 2 scans"."""
    return f"{k} of {counted(n, what)}"


def span(seconds):
    """A length of time in words."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


def percentage_bar(words, **options):
    """A bar on standard error that goes to 100: of what, comes last, as narrow terminals cut the end of the line."""
    form = "{percentage:3.0f}%|{bar:10}| {elapsed}{postfix}: {desc}"
    return bar(total=100, leave=False, desc=words, bar_format=form, **options)


def bar(**options):
    """A bar on standard error, with tqdm's options."""
    from tqdm import tqdm

    try:
        columns, rows = os.get_terminal_size(sys.stderr.fileno())
    except (OSError, ValueError):  # no terminal
        columns = rows = None
    if columns == 0 or rows == 0:  # those without a window, such as scripts have, in which tqdm shows nothing
        options |= {"ncols": columns or _COLUMNS, "nrows": rows or _ROWS}
    return tqdm(file=sys.stderr, **options)
