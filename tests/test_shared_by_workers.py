"""What the processes of a test run have in common is made by one; the others wait for it, unless it has failed or died."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

# Asks for a folder; if it is the one to make it, does as it is told.
ASK = """
import os, sys
from pathlib import Path
from types import SimpleNamespace
from shared_by_workers import made_once

def make(folder):
    (folder / "one").touch()
    print("makes", flush=True)
    match input():
        case "fill":
            (folder / "other").touch()
        case "fail":
            raise ValueError("no more room")
        case "die":
            os._exit(9)

print("asks", flush=True)
folder = made_once(SimpleNamespace(getbasetemp=lambda: Path(sys.argv[1])), "it", make)
print("has", *sorted(p.name for p in folder.iterdir()), flush=True)
"""


@pytest.fixture
def ask(tmp_path):
    """Start a process, number k of pytest-xdist or one by itself, that asks for the folder "it"."""
    started = []

    def ask(k=None):
        own = tmp_path if k is None else tmp_path / f"gw{k}"
        own.mkdir(exist_ok=True)
        environment = {name: value for name, value in os.environ.items() if name != "PYTEST_XDIST_WORKER"}
        environment |= {"PYTHONPATH": str(Path(__file__).parent)} | ({} if k is None else {"PYTEST_XDIST_WORKER": own.name})
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        # Without buffers, as a line that is read may take the next one with it, which communicate() would miss.
        started.append(subprocess.Popen([sys.executable, "-c", ASK, own], env=environment, bufsize=0, **pipes))
        assert started[-1].stdout.readline().split() == [b"asks"]
        return started[-1]

    yield ask
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    "told, says, errors",
    [
        ("fill", b"has one other", b""),
        ("fail", b"", b"another process could not make 'it', see its error"),
        ("die", b"", b"the process that was to make 'it' has died"),
    ],
)
def test_one_process_makes_what_all_have(ask, told, says, errors):
    first = ask(0)
    assert first.stdout.readline().split() == [b"makes"]
    second = ask(1)
    time.sleep(0.2)
    assert second.poll() is None  # waits
    first.stdin.write(f"{told}\n".encode())
    # The first, which nobody asks how it ended, is still among the processes, as one of pytest-xdist's would be.
    for other in (second, ask(2)):
        out, err = other.communicate(timeout=20)
        assert out.strip() == says and errors in err and (other.returncode == 0) == (told == "fill") == (not err)
    out, err = first.communicate(timeout=20)
    assert out.strip() == says and first.returncode == {"fill": 0, "fail": 1, "die": 9}[told]
    assert (b"ValueError: no more room" in err) == (told == "fail")


def test_a_process_by_itself_makes_it_in_its_own_folder(ask, tmp_path):
    for says in ([b"makes", b"has one other"], [b"has one other"]):
        assert ask().communicate(b"fill\n", timeout=20)[0].splitlines() == says
    assert sorted(p.name for p in (tmp_path / "it").iterdir()) == ["one", "other"]
