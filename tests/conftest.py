"""Fixtures shared by all tests."""

import copy
import os
import signal
import time
from pathlib import Path

import pytest
from slow_tests import leave_out_slow_tests, pytest_addoption, pytest_collection_modifyitems  # noqa: F401 (hooks)


def pytest_configure(config):
    """Ctrl-C is tested, also where the tests run in a shell's background, which has its processes ignore it."""
    leave_out_slow_tests(config)
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def kept_processes():
    """Processes that have done a test's work wait for the next test's: to start them takes as long as much of that work."""
    from lbsfit_np.processes import kept_processes

    with kept_processes():
        yield


@pytest.fixture
def own_processes(monkeypatch):
    """For a test of what becomes of processes: none are there from other tests, and its own end as they do for users."""
    from lbsfit_np import processes

    while processes._SPARE:
        processes._SPARE.pop().end()
    monkeypatch.setattr(processes, "_SPARE", None)


@pytest.fixture(scope="session")
def shared_rigs():
    """The folder of real rigs, poses and motion; absent on a user's machine."""
    named = os.environ.get("LBSFIT_SHARED_RIGS")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "rigs"
    if not folder.is_dir():
        pytest.skip("the folder of real rigs is not here (set LBSFIT_SHARED_RIGS to where it is)")
    return folder


@pytest.fixture(scope="session")
def tube_rig():
    """A small watertight rig of four joints; see ``small_rigs.py``. Rigs are immutable, so that all tests share it."""
    from small_rigs import make_tube_rig

    return make_tube_rig()


@pytest.fixture(scope="session")
def tube_fitter(tube_rig, tmp_path_factory):
    """A fitter of the tube rig with a segmenter of its own, trained for a few seconds."""
    from shared_by_workers import found_once

    from lbsfit_np import LBSFitter

    given = {"rig": tube_rig, "training_scans": 300, "random_state": 0}
    return found_once(tmp_path_factory, "tube_fitter", lambda: LBSFitter(**given).pretrain()).set_params(rig=tube_rig)


@pytest.fixture(scope="session")
def quick_fitter(tube_fitter):
    """The same fitter, content with few starts."""
    return copy.copy(tube_fitter).set_params(effort="fast")


@pytest.fixture(scope="session")
def tube_scan(tube_rig):
    """A scan of the tube rig with all its flaws, and its truth."""
    from lbsfit_np import synthesize

    return synthesize(tube_rig, 1, random_state=31, n_points=1000)[0]


@pytest.fixture(scope="session")
def tube_result(tube_fitter, tube_scan):
    """The fit of ``tube_scan``."""
    from learning_runs import assert_nothing_is_hurried

    assert_nothing_is_hurried()
    return tube_fitter.fit_scan(tube_scan.points)


@pytest.fixture(scope="session")
def small_segmenter(tube_rig):
    """A segmenter that knows little and trains fast."""
    from segmenter_training import train_small

    return train_small(tube_rig)


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    """The folder of a cache that holds nothing, on disk or in memory."""
    from lbsfit_np.segmentation import cache

    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "_MEMORY", {})
    return tmp_path / "cache"


@pytest.fixture
def fitter(tube_rig):
    """A fitter without a segmenter, for scans whose labels are known; training would take no time worth a word."""
    from lbsfit_np import LBSFitter

    return LBSFitter(tube_rig, effort="fast", training_scans=2, training={"n_points": 100}, random_state=0)


@pytest.fixture(scope="module")
def one_thread():
    """As all fits have it: more threads on arrays this small only take time."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        yield


# ---- first looks at the tube rig ----


@pytest.fixture(scope="session")
def clean_scans(tube_rig):
    """Four scans without any flaw."""
    from turned_scans import CLEAN

    from lbsfit_np import synthesize

    return synthesize(tube_rig, 4, random_state=40, **CLEAN)


@pytest.fixture(scope="session")
def make_scout(tube_rig, tube_fitter):
    """(orientation, settings, other parameters) → a Scout of the tube."""
    from lbsfit_np.fitting.scan_fit import FitSettings
    from lbsfit_np.fitting.scout import Scout
    from lbsfit_np.optimize.model import Model
    from lbsfit_np.starts.turns import facing_of

    model, trained = Model(tube_rig), (tube_fitter.regressor_, tube_fitter.segmenter_)

    def made(orientation="upright", settings=None, *, segmenter=True, **more):
        library, s = trained
        settings = settings or FitSettings(effort="fast")
        return Scout(model, library, facing_of(tube_rig, orientation), s if segmenter else None, settings, **more)

    return made


# ---- learning from the tube rig ----


@pytest.fixture(scope="session")
def people(tube_rig):
    """Two people."""
    return {"ann": tube_rig.subject(3, amount=1.5), "bob": tube_rig.subject(4, amount=1.5)}


@pytest.fixture(scope="session")
def people_scans(tube_rig, people):
    """Scans of the two in turn."""
    from learning_runs import SCANS

    from lbsfit_np import synthesize

    templates = [(s.vertices, s.joints) for s in people.values()]
    return synthesize(tube_rig, 16, templates=templates, random_state=5, **SCANS)


@pytest.fixture(scope="session")
def few_scans(people_scans):
    """Five scans of one subject."""
    return people_scans[:10:2]


@pytest.fixture(scope="session")
def unlearned(tube_rig, tmp_path_factory):
    """A pretrained fitter that has not learned."""
    from learning_runs import SMALL
    from shared_by_workers import found_once

    from lbsfit_np import LBSFitter

    found = found_once(tmp_path_factory, "unlearned", lambda: LBSFitter(tube_rig, **SMALL).pretrain())
    return found.set_params(rig=tube_rig)


@pytest.fixture(scope="session")
def make_learner(tube_rig, unlearned):
    """(parameters) → a fitter whose pretraining is done; with fewer scans its rounds train on."""
    from learning_runs import SMALL

    from lbsfit_np import LBSFitter

    def made(**parameters):
        fitter = LBSFitter(tube_rig, **(SMALL | {"training_scans": 100} | parameters))
        fitter._pretrained = unlearned._pretrained
        return fitter

    return made


@pytest.fixture
def hurried(monkeypatch):
    """For a test that asks whether fits are the same, or whose they are, not how good."""
    from learning_runs import learning_is_hurried

    learning_is_hurried(monkeypatch)


@pytest.fixture(scope="module")
def hurried_learning():
    """For a module whose tests ask what becomes of fits, right or not: learning takes half the time."""
    from learning_runs import learning_is_hurried

    with pytest.MonkeyPatch.context() as patch:
        learning_is_hurried(patch)
        yield


@pytest.fixture(scope="session")
def learned_people(tube_rig, make_learner, people_scans, tmp_path_factory):
    """A fitter that has learned from ten scans of two subjects and met a broken one; and what progress said."""
    from learning_runs import GIVEN, IDS, NAN, assert_nothing_is_hurried
    from shared_by_workers import found_once

    def learned():
        assert_nothing_is_hurried()
        told = []
        fitter = make_learner()
        scans = [NAN if i == "broken" else people_scans[i].points for i in GIVEN]
        with pytest.warns(UserWarning, match="1 of 11 scans cannot be used; scan 3: points: got 50 of 50"):
            found = fitter.fit(scans, IDS, progress=lambda *a: told.append(a))
        assert found is fitter
        return fitter, told

    fitter, told = found_once(tmp_path_factory, "learned_people", learned)
    fitter.told = told
    return fitter.set_params(rig=tube_rig)


# ---- the command line ----


@pytest.fixture(scope="session")
def cli_cache(tmp_path_factory):
    """A folder that all tests of the command line keep their segmenters in."""
    from shared_by_workers import made_once

    return made_once(tmp_path_factory, "cache")


@pytest.fixture
def own_cache(cli_cache, monkeypatch):
    """Nothing is read from or written to the user's own cache."""
    monkeypatch.setenv("LBSFIT_CACHE", str(cli_cache))


@pytest.fixture
def run(capsys):
    """Run the program in this process; returns its exit code, output and errors."""
    from lbsfit_np.cli import main

    def run(*arguments):
        capsys.readouterr()
        code = main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return run


@pytest.fixture(scope="session")
def made(tube_rig, tmp_path_factory):
    """A folder with tube.npz and the scans one.ply, two.xyz and three.npy."""
    import numpy as np

    from lbsfit_np import synthesize
    from lbsfit_np.io.write import write_points_ply

    folder = tmp_path_factory.mktemp("made")
    tube_rig.save(folder / "tube.npz")
    one, two, three = (s.points for s in synthesize(tube_rig, 3, random_state=5, n_points=400))
    write_points_ply(folder / "one.ply", one)
    np.savetxt(folder / "two.xyz", two)
    np.save(folder / "three.npy", three)
    return folder


@pytest.fixture(scope="session")
def fitted(made, cli_cache, tmp_path_factory):
    """A folder with the fits of two scans, made in a hurry by a program of its own."""
    from cli_runs import QUICK, program

    out = tmp_path_factory.mktemp("fitted") / "fits"
    done = program("fit", made / "tube.npz", made / "one.ply", made / "two.xyz", "-o", out, *QUICK, cache=cli_cache, hurried=True)
    assert (done.returncode, done.stderr) == (0, "")
    return out, done.stdout


@pytest.fixture(scope="session")
def pair_meshes(tube_rig):
    """The true meshes of ``pair_scans``."""
    from registered_sets import posed_meshes

    return posed_meshes(tube_rig, 4)


@pytest.fixture(scope="session")
def pair_folder(tube_rig, pair_meshes, tmp_path_factory):
    """A folder with the scans s0 … s3 of two people, their truth.csv, and tube.npz."""
    from registered_sets import WHO, write_meshes

    folder = write_meshes(tmp_path_factory.mktemp("pairs"), tube_rig, pair_meshes)
    (folder / "truth.csv").write_text("\n".join(["scan,subject", *(f"s{i},{who}" for i, who in enumerate(WHO))]))
    tube_rig.save(folder / "tube.npz")
    return folder


@pytest.fixture
def pair_scans(pair_folder):
    """Of that folder, as the benchmark has them."""
    from registered_sets import WHO

    from lbsfit_np.bench.truth import PairScan

    return [PairScan(f"s{i}", pair_folder / f"s{i}.ply", who) for i, who in enumerate(WHO)]


@pytest.fixture(scope="session")
def scans_of_two(tube_rig, people, tmp_path_factory):
    """A folder of scans of two people and their truth: anna0 … anna3, ben0 … ben2 (.ply), who.csv, broken.ply, tube.npz."""
    from shared_by_workers import made_once

    from lbsfit_np import synthesize
    from lbsfit_np.io.write import write_points_ply

    truth, clean = {}, {"noise": 0.0, "holes": 0, "density": 0.0, "n_points": 400}  # few starts find the poses of these
    for k, (name, n, person) in enumerate((("anna", 4, people["ann"]), ("ben", 3, people["bob"]))):
        scans = synthesize(tube_rig, n, templates=[(person.vertices, person.joints)], random_state=k, **clean)
        truth |= {f"{name}{i}": s for i, s in enumerate(scans)}

    def make(folder):
        tube_rig.save(folder / "tube.npz")
        for name, s in truth.items():
            write_points_ply(folder / f"{name}.ply", s.points)
        lines = [f"{name}.ply,{name[:-1]}" for name in truth]
        (folder / "who.csv").write_text("\n".join(["scan,subject", *lines, "broken.ply,ben"]) + "\n")
        (folder / "broken.ply").write_text("ply\nformat ascii 1.0\nelement vertex 9\n")

    return made_once(tmp_path_factory, "scans of two", make), truth


@pytest.fixture(scope="session")
def learned_two(scans_of_two, tmp_path_factory):
    """A model of the two, made by a program of its own in a hurry: path, folder of results, output, errors, truth."""
    from cli_runs import program
    from shared_by_workers import made_once

    folder, truth = scans_of_two

    def make(out):
        scans = [*sorted(folder.glob("anna*.ply")), folder / "broken.ply", *sorted(folder.glob("ben*.ply"))]
        options = ("--training-scans", 100, "--effort", "fast", "--rounds", 1, "--subjects", folder / "who.csv")
        outputs = ("-o", out / "new" / "model.npz", "--results", out / "fits")
        done = program("learn", folder / "tube.npz", *scans, *outputs, *options, cache=out / "cache", hurried=True)
        assert done.returncode == 1, done.stderr
        (out / "output").write_text(done.stdout)
        (out / "errors").write_text(done.stderr)

    out = made_once(tmp_path_factory, "learned", make)
    return out / "new" / "model.npz", out / "fits", (out / "output").read_text(), (out / "errors").read_text(), truth


@pytest.fixture(scope="session")
def tubes(tube_rig, tmp_path_factory):
    """A folder with tube.npz and the scans t0.ply … t3.ply."""
    from lbsfit_np import synthesize
    from lbsfit_np.io.write import write_points_ply

    folder = tmp_path_factory.mktemp("tubes")
    tube_rig.save(folder / "tube.npz")
    for i, s in enumerate(synthesize(tube_rig, 4, random_state=5, n_points=400, shape=0.0)):  # one person
        write_points_ply(folder / f"t{i}.ply", s.points)
    return folder


@pytest.fixture(scope="session")
def tube_model(tubes, cli_cache, tmp_path_factory):
    """A model of the tubes, learned in a hurry, and the folder of results."""
    from cli_runs import QUICK_LEARNING
    from learning_runs import learning_is_hurried

    from lbsfit_np.cli import main

    out = tmp_path_factory.mktemp("tube model")
    with pytest.MonkeyPatch.context() as patch:
        learning_is_hurried(patch)
        patch.setenv("LBSFIT_CACHE", str(cli_cache))
        scans = sorted(map(str, tubes.glob("*.ply")))
        arguments = ["learn", tubes / "tube.npz", *scans, "-o", out / "m.npz", "--results", out / "fits", *QUICK_LEARNING]
        assert main([str(a) for a in arguments]) == 0
    return out / "m.npz", out / "fits"


@pytest.fixture(scope="session")
def coarse_hand():
    """A bundled rig of few vertices."""
    from lbsfit_np import load_rig

    return load_rig("hand-coarse")


@pytest.fixture(scope="session")
def tiny_study(coarse_hand):
    """The study's scans of that hand, a few."""
    from study_sizes import TINY

    from lbsfit_np.bench.study.data import study_set

    return study_set(coarse_hand, TINY, 300)


@pytest.fixture
def patient(monkeypatch):
    """Workers are stopped once each process at work has something to say, and some time to say the rest."""
    from lbsfit_np.processes import Workers

    stop = Workers.stop

    def patient(self):
        for worker in self._workers:
            if worker.task is not None and worker.connection.poll(60):
                time.sleep(0.5)
        return stop(self)

    monkeypatch.setattr(Workers, "stop", patient)
