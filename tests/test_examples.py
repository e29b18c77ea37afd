"""Every example runs as it stands."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import lbsfit_np

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.name)
def test_example(example, tmp_path):
    environment = os.environ | {
        "PYTHONPATH": str(Path(lbsfit_np.__file__).resolve().parents[1]),
        "LBSFIT_CACHE": os.environ.get("LBSFIT_CACHE", str(tmp_path / "cache")),  # as the run of all tests has it
        "OMP_NUM_THREADS": "1",  # quicker where other things run beside it
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONIOENCODING": "utf-8",
    }
    done = subprocess.run([sys.executable, example], capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout and not done.stderr
