"""``python -m lbsfit_np`` is ``lbsfit``."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
