"""Progress for people: a bar on a terminal, plain lines elsewhere."""

import sys

__all__ = ["Progress", "say"]


def say(text):
    """A line on standard output, at once."""
    print(text, flush=True)


class Progress:
    """Shows how a run goes on.

    Parameters
    ----------
    total : int
        Scans to fit.
    terminal : bool, optional
        Whether to draw bars; default: whether standard error is a terminal.
    """

    def __init__(self, total, terminal=None):
        self.total, self.done = total, 0
        self.terminal = sys.stderr.isatty() if terminal is None else terminal
        self._bar = None
        self._training = False

    def training(self, share):
        """The segmenter is trained to this share, in [0, 1]."""
        if not self._training:
            self._training = True
            self.line("training the segmenter on synthetic scans of the rig; it is kept for the next time")
            if self.terminal:
                self._bar = _bar(total=100, leave=False, bar_format="training: {percentage:3.0f}%|{bar}| {elapsed}")
        if self._bar is not None:
            self._bar.update(100 * share - self._bar.n)
            if share >= 1:
                self.close()

    def scan(self, entry):
        """One more scan is done: ``entry`` of the summary."""
        self.done += 1
        if entry["status"] == "failed":
            text, where = f"{entry['name']}: failed: {entry['message']}", sys.stderr
        else:
            text = f"{entry['name']}: fitted in {entry['seconds']:.1f} s, recon {entry['terms']['recon']:.4f}, {entry['message']}"
            where = sys.stdout
        if not self.terminal:
            print(f"[{self.done}/{self.total}] {text}", file=where, flush=True)
            return
        if entry["status"] == "failed":
            self.line(text)
            if self._bar is None:  # before the training: the bar starts after it
                return
        if self._bar is None:
            self._bar = _bar(total=self.total, initial=self.done - 1, desc="scans", unit="scan")
        self._bar.set_postfix_str(entry["name"], refresh=False)
        self._bar.update()

    def line(self, text):
        """A line that stays."""
        if self._bar is not None:
            self._bar.write(text, file=sys.stderr)
        else:
            print(text, file=sys.stderr if self.terminal else sys.stdout, flush=True)

    def close(self):
        """Leave the terminal in order."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _bar(**options):
    from tqdm import tqdm

    return tqdm(file=sys.stderr, **options)
