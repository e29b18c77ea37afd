"""``python hurried_program.py`` is ``lbsfit`` in a hurry, and so are its worker processes, which read this file first."""

import sys

import pytest
from learning_runs import learning_is_hurried

from lbsfit_np.cli import main

learning_is_hurried(pytest.MonkeyPatch())

if __name__ == "__main__":
    sys.exit(main())
