"""Sweeps give the same bits on one core, two, or a cluster that loses a worker; and they can be taken up again."""

import json
import os
import pickle
import re
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import joblib
import numpy as np
import pytest
import yaml
from distributed import Client

from studies.kit import sweeps
from studies.kit.experiments import linearity_curves
from tests.conftest import ROOT, code_of, heed_signals, wait_until
from zwfs import Arcsine, Dimple, Linear, PhaseShifted, Pupil, ZernikeSensor, zernike_basis
from zwfs.bench.model import Bench, BenchModel

NOTEBOOKS = ROOT / "notebooks"
AS_THE_PAGE_SAYS = os.environ | {"PYTHONPATH": str(NOTEBOOKS)}


@pytest.fixture(scope="module")
def pupil():
    return Pupil.circular(24)


@pytest.fixture(scope="module")
def modes(pupil):
    return zernike_basis(pupil, 12)


def test_blas_has_one_thread_in_every_task():
    # A process of its own, which may use two: the variables are read when NumPy is loaded.
    script = (
        "import joblib\nfrom threadpoolctl import threadpool_info\nfrom studies.kit import sweeps\n"
        "def n_threads(value):\n"
        "    return max(library['num_threads'] for library in threadpool_info())\n"
        "for n_jobs in (1, 2):\n"
        "    with joblib.parallel_config(backend='loky', n_jobs=n_jobs, inner_max_num_threads=2):\n"
        "        print(n_threads(0), *sweeps.run(n_threads, range(4), name='threads'))"
    )
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "2")
    run = {"cwd": NOTEBOOKS, "env": os.environ | limits, "check": True, "stdout": subprocess.PIPE, "text": True}
    assert subprocess.run([sys.executable, "-c", script], **run).stdout.splitlines() == ["2 1 1 1 1"] * 2


def process_after(seconds, *_):
    time.sleep(0.2)
    return os.getpid()


def test_a_sweep_within_a_task_is_done_there(tmp_path, monkeypatch):
    monkeypatch.setenv(sweeps.PROGRESS, str(tmp_path / "progress"))

    def outer(value):
        return {os.getpid(), *sweeps.run(process_after, range(2), name="inner")}

    with joblib.parallel_config(n_jobs=2):
        assert all(len(used) == 1 for used in sweeps.run(outer, range(3), name="outer"))
    assert "inner" not in (tmp_path / "progress").read_text()


def fails_at_three(value):
    if value == 3:
        raise ArithmeticError("no such thing")
    return value


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_an_error_names_the_task_and_its_input(n_jobs):
    with joblib.parallel_config(n_jobs=n_jobs), pytest.raises(ArithmeticError, match="no such thing") as failure:
        sweeps.run(fails_at_three, [5, 3, 4], name="broken")
    assert "in task 1 of the sweep broken, with the input 3" in failure.value.__notes__


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_progress_is_written_as_tasks_finish(n_jobs, tmp_path, monkeypatch):
    monkeypatch.setenv(sweeps.PROGRESS, str(tmp_path / "progress"))
    with joblib.parallel_config(n_jobs=n_jobs):
        sweeps.run(pow, range(3), 2, name="squares")
    lines = [json.loads(line) for line in (tmp_path / "progress").read_text().splitlines()]
    assert lines == [{"name": "squares", "done": done, "total": 3} for done in (1, 2, 3)]


SWEEP = """
import signal, sys, time
from studies.kit import sweeps

signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background SIGINT is ignored
def task(value, log):
    open(f"{log}/{value}", "w").close()
    time.sleep(0.4)
    return 2.0 * value
print(sweeps.run(task, range(8), sys.argv[1], name="stopped"))
"""


def start_sweep(folder, store):
    return subprocess.Popen(
        [sys.executable, "-c", SWEEP, str(folder)], cwd=NOTEBOOKS, env=os.environ | {sweeps.STORE: str(store)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=heed_signals,
    )  # fmt: skip


@pytest.mark.slow
def test_an_interrupted_sweep_is_taken_up_again(tmp_path):
    log, store = tmp_path / "log", tmp_path / "store"
    log.mkdir()
    with start_sweep(log, store) as stopped:
        while len(list(store.rglob("output.pkl"))) < 3:
            assert stopped.poll() is None, stopped.communicate()
            time.sleep(0.02)
        os.killpg(stopped.pid, signal.SIGINT)  # as Ctrl-C does: to the workers as well
        assert "KeyboardInterrupt" in stopped.communicate()[1]
    times = {file: file.stat().st_mtime_ns for file in store.rglob("output.pkl")}
    assert 3 <= len(times) < 8
    for file in log.iterdir():
        file.unlink()
    with start_sweep(log, store) as again:
        printed, errors = again.communicate()
    assert again.returncode == 0, errors
    assert len(list(log.iterdir())) == 8 - len(times)
    assert {file: file.stat().st_mtime_ns for file in times} == times
    assert json.loads(printed) == [2.0 * value for value in range(8)]


def square(value, offset):
    square.calls.append(value)
    return np.array([value**2 + offset])


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setenv(sweeps.STORE, str(tmp_path))
    monkeypatch.setattr(square, "calls", [], raising=False)
    with joblib.parallel_config(n_jobs=1):
        yield tmp_path


@pytest.mark.parametrize("damage", [lambda content: content[:-1], lambda content: b"", lambda content: b"x" * 99])
def test_a_damaged_file_is_made_again(store, damage):
    first = sweeps.run(square, range(4), 1, name="squares")
    file = sorted(store.rglob("output.pkl"))[2]
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    square.calls.clear()
    assert sweeps.run(square, range(4), 1, name="squares") == first
    assert len(square.calls) == 1
    assert file.read_bytes() == whole


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o720, 0o1777])
def test_a_folder_that_others_can_write_to_is_refused(store, monkeypatch, mode):
    folder = store / "finished"
    monkeypatch.setenv(sweeps.STORE, str(folder))
    store.chmod(0o1777)  # the parent may be one like /tmp
    sweeps.run(square, range(4), 1, name="squares")
    assert folder.stat().st_mode & 0o777 == 0o700
    square.calls.clear()
    folder.chmod(mode)
    with pytest.raises(PermissionError, match=rf"ZWFS_SWEEPS: other users can write to {folder}, "):
        sweeps.run(square, range(4), 1, name="squares")
    assert square.calls == []


def test_results_of_other_code_are_not_taken(store, tmp_path, monkeypatch):
    """Other code is a changed module of the user or of zwfs, and a lambda that does or holds something else."""

    def is_new(task):
        before = set(store.rglob("output.pkl"))
        sweeps.run(task, [1], name="tasks")
        return set(store.rglob("output.pkl")) != before

    module = tmp_path / "users_module.py"
    module.write_text("def task(value):\n    return value\n")
    monkeypatch.syspath_prepend(tmp_path)
    task = __import__("users_module").task
    assert is_new(task)
    assert not is_new(task)
    module.write_text("def task(value):\n    return helper(value)\n")
    assert is_new(task)

    def adder(step):
        return lambda value: value + step

    assert [is_new(adder(step)) for step in (1, 1, 2)] == [True, False, True]
    assert is_new(lambda value: value - 1)
    assert [is_new(abs) for _ in range(2)] == [True, False]


def test_what_was_looked_at_does_not_change_a_pickle(modes):
    pupil = Pupil.circular(24)  # at which nobody has looked
    bench = Bench(n_pixels=40)
    sensor, model = ZernikeSensor(pupil, Dimple(1.06, 1.5)), BenchModel.from_images(bench, 1)
    method, classic = PhaseShifted(model.shifted), Arcsine(sensor)
    before = [pickle.dumps(thing) for thing in (sensor, model, method, classic)]
    frames = sensor.measure(modes[0])
    phase = classic(frames).phase
    model.pistons(method(model.normalise(bench.frames())).phase)
    assert pupil.points.size
    assert model.modes.size
    assert [pickle.dumps(thing) for thing in (sensor, model, method, classic)] == before
    copy = pickle.loads(pickle.dumps(sensor))
    np.testing.assert_array_equal(copy.measure(modes[0]), frames)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(classic))(frames).phase, phase)
    np.testing.assert_array_equal(copy.pupil.points, pupil.points)


def on_the_page(text, language="python"):
    """The block of code on the page about sweeps that holds a text."""
    [block] = [block for block in code_of("sweeps.md", language) if text in block]
    return block


@pytest.mark.slow
def test_the_script_on_the_page_runs(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(on_the_page(" LocalCluster("))
    said = subprocess.run([sys.executable, script], env=AS_THE_PAGE_SAYS, stdout=-1, text=True, check=True).stdout
    lines = said.splitlines()
    assert lines[0] == "0.1 rad rms: 100% of the screens recovered"
    assert len(lines) == 10


def test_one_process_needs_no_joblib(pupil, modes, monkeypatch):
    methods = {"linear": Linear(ZernikeSensor(pupil, Dimple(1.06, np.pi / 2)), modes)}
    with joblib.parallel_config(n_jobs=1):
        with_it = linearity_curves(methods, modes, [0.1, 0.2], 2)
    for package in ("joblib", "cloudpickle", "threadpoolctl", "distributed"):
        monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    without = linearity_curves(methods, modes, [0.1, 0.2], 2)
    np.testing.assert_allclose(without.errors["linear"], with_it.errors["linear"], rtol=1e-9)


def containers_on_the_page():
    """The containers in the recipe for Kubernetes: those of the scheduler and of a worker."""
    recipe = yaml.safe_load_all(on_the_page("kind: Deployment", "yaml"))
    parts = [part for part in recipe if part["kind"] == "Deployment"]
    return [part["spec"]["template"]["spec"]["containers"][0] for part in parts]


@pytest.fixture(scope="module")
def foreign_cluster(tmp_path_factory):
    """A cluster by the recipe for Kubernetes, in this environment and folder, and at another port."""
    home = re.search(r"(?m)^WORKDIR (.*)$", (ROOT / "environment" / "Dockerfile").read_text())[1]
    elsewhere, processes = tmp_path_factory.mktemp("elsewhere"), []
    try:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = str(free.getsockname()[1])
        for container in containers_on_the_page():
            assert container["command"][0] == f"{home}/.venv/bin/dask"
            own = " ".join(container["command"][1:]).replace("8786", port).replace("//zwfs:", "//127.0.0.1:")
            run = [str(Path(sys.executable).parent / "dask"), *own.split()]
            variables = {item["name"]: item["value"].replace(home, str(ROOT)) for item in container["env"]}
            start = {"cwd": elsewhere, "env": os.environ | variables, "stderr": subprocess.DEVNULL}
            processes.append(subprocess.Popen(run, **start))
        processes.append(subprocess.Popen(run, **start))
        with Client(f"tcp://127.0.0.1:{port}", timeout=60, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)
        yield f"tcp://127.0.0.1:{port}"
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(30)


def test_one_core_two_cores_and_a_cluster_by_the_recipe_for_kubernetes_agree_to_the_last_bit(
    pupil, modes, foreign_cluster, monkeypatch
):
    methods = {
        "Linear": Linear(ZernikeSensor(pupil, Dimple(1.06, np.pi / 2)), modes),
        "PhaseShifted": PhaseShifted(ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))),
    }

    def errors():
        curves = linearity_curves(methods, modes, [0.1, 0.5, 1.0], 4, seed=3)
        return [array.tobytes() for array in curves.errors.values()]

    with joblib.parallel_config(n_jobs=1):
        expected = errors()
    with joblib.parallel_config(n_jobs=2):
        assert errors() == expected
    monkeypatch.setenv(sweeps.CLUSTER, foreign_cluster)
    assert errors() == expected
    assert os.getpid() not in sweeps.run(lambda value: os.getpid(), range(6), name="where")


def test_a_cluster_that_loses_a_worker_gives_the_full_result(foreign_cluster, tmp_path, monkeypatch):
    monkeypatch.setenv(sweeps.CLUSTER, foreign_cluster)
    table, folder = np.linspace(0, 1, 300_000), str(tmp_path)

    def task(value, table):
        with open(os.path.join(folder, str(value)), "w") as log:
            log.write(str(os.getpid()))
        time.sleep(0.4)
        return value + float(table.sum())

    def kill_in_the_middle():
        wait_until(lambda: len(os.listdir(tmp_path)) >= 6, 60)
        os.kill(int((tmp_path / os.listdir(tmp_path)[0]).read_text()), signal.SIGKILL)

    killer = threading.Thread(target=kill_in_the_middle)
    killer.start()
    results = sweeps.run(task, range(16), table, name="survivor")
    killer.join()
    assert results == [value + float(table.sum()) for value in range(16)]


@pytest.mark.slow
def test_the_grid_on_the_page_runs(tmp_path):
    smaller = textwrap.indent(on_the_page("grid(").replace("make_pupil(64), 100", "make_pupil(24), 20"), "    ")
    (tmp_path / "script.py").write_text(f'if __name__ == "__main__":\n{smaller}')
    subprocess.run([sys.executable, "script.py"], cwd=tmp_path, env=AS_THE_PAGE_SAYS, check=True)
    assert len((tmp_path / "grid.csv").read_text().splitlines()) == 1 + 4 * 3 * 4 * 20
