"""Where figures come from: versions, the machine, and the commit of the code."""

import platform
import subprocess
from pathlib import Path

from ..workers import processors

__all__ = ["commits", "environment", "installed", "libraries", "several"]

_LIBRARIES = ("numpy", "scipy", "scikit-learn")


def environment():
    """A dict of versions, the platform, the CPUs that may be used, the commit (None outside a checkout), the code's digest."""
    from .. import __version__
    from ..learning.checkpoint import state_of_the_code

    return {
        "lbsfit_np": __version__,
        **{name: installed(name) for name in _LIBRARIES},
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cpus": processors(),
        "commit": _commit(),
        "code": state_of_the_code(),
    }


def installed(name):
    """The version of an installed package, None where it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return None


def libraries(env):
    """The versions of the libraries of an environment, in words."""
    return ", ".join(f"{name} {env[name]}" for name in _LIBRARIES)


def commits(made):
    """Each state of the code, by the first letters of its commit → what was made in it; "": not known.

    Where no commit is known, or the checkout differs from it, states are told by their digests as well if these differ.

    Parameters
    ----------
    made : iterable of (str, dict)
        What each row is called, and the environment that made it.

    Returns
    -------
    dict of str to list of str
    """
    of = {}
    for called, env in made:
        commit, *changes = (env.get("commit") or "").partition("+")
        of.setdefault("".join((commit[:12], *changes)), []).append((called, (env.get("code") or "")[:8] or "not known"))
    states = {}
    for commit, rows in of.items():
        by_code = (not commit or "+" in commit) and len({code for _, code in rows}) > 1
        for called, code in rows:
            state = f"{commit or 'unknown'} (code {code})" if by_code else commit
            states.setdefault(state, []).append(called)
    return states


def several(states):
    """What to say of rows of several states, as by :func:`commits`: they are not to be compared as if they were of one."""
    listed = "; ".join(f"{commit or 'unknown'}: {', '.join(called)}" for commit, called in states.items())
    return f"Rows are of several states of the code, by commit: {listed}."


def _processor():
    """The processor's name, where the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or None
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or None


def _commit():
    """The commit that this file belongs to, with "+changes" where the checkout differs from it."""
    here = Path(__file__).resolve()

    def git(*arguments):
        done = subprocess.run(["git", "-C", str(here.parent), *arguments], capture_output=True, text=True, timeout=10, check=True)
        return done.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", here.name)  # an installed package may stand within somebody else's repository
        package = str(here.parents[1])
        return git("rev-parse", "HEAD") + ("+changes" if git("status", "--porcelain", "--", package) else "")
    except (OSError, subprocess.SubprocessError):
        return None
