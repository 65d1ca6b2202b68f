"""Sweeps give the same bits on one core, two, or a cluster that loses a worker; and they can be taken up again."""

import json
import os
import pickle
import re
import shutil
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
from distributed import Client, LocalCluster

from studies.kit import sweeps
from studies.kit.bench import bench_curves, bench_reconstructors
from studies.kit.experiments import linearity_curves
from studies.kit.grids import Recovery, grid
from studies.kit.setups import make_screens
from tests.conftest import ROOT, code_of, heed_signals
from zwfs import Arcsine, Dimple, GradientDescent, Linear, PhaseShifted, Pupil, ZernikeSensor, zernike_basis
from zwfs.bench.model import Bench, BenchModel

NOTEBOOKS = ROOT / "notebooks"
AS_THE_PAGE_SAYS = os.environ | {"PYTHONPATH": str(NOTEBOOKS)}


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes, each watched by a nanny that starts another one when it dies."""
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0") as cluster,
        Client(cluster) as client,
    ):
        client.wait_for_workers(2, timeout=120)
        yield client


@pytest.fixture(scope="module")
def pupil():
    return Pupil.circular(24)


@pytest.fixture(scope="module")
def modes(pupil):
    return zernike_basis(pupil, 12)


def figure_3(pupil, modes):
    plus, minus = Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2)
    classic, shifted = ZernikeSensor(pupil, plus), ZernikeSensor(pupil, plus, minus)
    methods = {
        "Linear": Linear(classic, modes),
        "Arcsine": Arcsine(classic),
        "GradientDescent": GradientDescent(shifted, modes),
        "PhaseShifted": PhaseShifted(shifted),
    }
    curves = linearity_curves(methods, modes, [0.1, 0.5, 1.0], 4, seed=3)
    return [curves.rms, *curves.errors.values(), *curves.converged.values(), curves.wrapped, curves.strehl]


def figure_9(pupil, modes):
    bench = Bench(n_pixels=40)
    model = BenchModel.from_images(bench, 1)
    methods = bench_reconstructors(bench, model, n_iterations=2)
    curves = bench_curves(bench, model, methods, [0, 0.3, 0.6], 1, seed=1)
    return [curves.commanded, *curves.residuals.values()]


def recovery(pupil, modes):
    source = make_screens(pupil, 12, -2.0)
    return [*grid(Recovery(source), diameter=[1.06, 2.0], rms=[0.1, 0.5], n_screens=2).columns.values()]


def test_large_arrays_are_shared_and_change_no_bit():
    pupil = Pupil.circular(80)
    modes = zernike_basis(pupil, 60)  # 3 MB: joblib maps it into the memory of the workers
    method = Linear(ZernikeSensor(pupil, Dimple(1.06, np.pi / 2)), modes)
    found = []
    for n_jobs in (1, 2):
        with joblib.parallel_config(n_jobs=n_jobs):
            found.append(linearity_curves({"Linear": method}, modes, [0.1, 0.5], 2, seed=3).errors["Linear"])
    assert found[0].tobytes() == found[1].tobytes()


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


@pytest.mark.parametrize(("limit", "expected"), [("1", 1), ("2", 2)])
def test_all_cores_by_default_and_fewer_if_told(limit, expected, monkeypatch):
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", limit)
    used = set(sweeps.run(process_after, range(6), name="default"))
    assert len(used) == min(expected, os.cpu_count())
    assert (os.getpid() in used) == (expected == 1)
    assert sweeps.run(process_after, [0], name="single") == [os.getpid()]


def test_results_are_in_the_order_of_the_inputs():
    def late_first(value):
        time.sleep(0.3 if value == 0 else 0)
        return value

    with joblib.parallel_config(n_jobs=2):
        assert sweeps.run(late_first, range(5), name="order") == [0, 1, 2, 3, 4]
    assert sweeps.run(late_first, [], name="order") == []


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


@pytest.mark.parametrize("where", [{"n_jobs": 1}, {"n_jobs": 2}, {"backend": "dask"}])
def test_an_error_names_the_task_and_its_input(where, cluster):
    with joblib.parallel_config(**where), pytest.raises(ArithmeticError, match="no such thing") as failure:
        sweeps.run(fails_at_three, [5, 3, 4], name="broken")
    assert "in task 1 of the sweep broken, with the input 3" in failure.value.__notes__


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_progress_is_written_as_tasks_finish(n_jobs, tmp_path, monkeypatch):
    monkeypatch.setenv(sweeps.PROGRESS, str(tmp_path / "progress"))
    with joblib.parallel_config(n_jobs=n_jobs):
        sweeps.run(pow, range(3), 2, name="squares")
    lines = [json.loads(line) for line in (tmp_path / "progress").read_text().splitlines()]
    assert lines == [{"name": "squares", "done": done, "total": 3} for done in (1, 2, 3)]


def slow(value, folder, table):
    """Say that this task began, take a while, and give something that depends on both arguments."""
    (Path(folder) / str(value)).touch()
    time.sleep(0.4)
    return value + float(table.sum())


def test_a_cluster_that_loses_all_workers_gives_the_full_result(cluster, tmp_path):
    table = np.linspace(0, 1, 300_000)
    lost = set(cluster.run(os.getpid).values())
    done_by_now = []

    def kill_in_the_middle():
        while len(os.listdir(tmp_path)) < 4:
            time.sleep(0.02)
        for pid in lost:
            os.kill(pid, signal.SIGKILL)
        # New workers join: on a busy machine a nanny may fail to start its worker again.
        cluster.cluster.scale(2 + len(lost))
        done_by_now.append(len(os.listdir(tmp_path)))

    killer = threading.Thread(target=kill_in_the_middle)
    killer.start()
    with joblib.parallel_config(backend="dask"):
        found = sweeps.run(slow, range(16), str(tmp_path), table, name="survivor")
    killer.join()
    assert found == [value + float(table.sum()) for value in range(16)]
    assert done_by_now[0] < 16
    cluster.wait_for_workers(2, timeout=120)
    assert not lost & set(cluster.run(os.getpid).values())


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
    kept = {file: file.stat().st_mtime_ns for file in store.rglob("output.pkl")}
    assert 3 <= len(kept) < 8
    for file in log.iterdir():
        file.unlink()
    with start_sweep(log, store) as again:
        found, errors = again.communicate()
    assert again.returncode == 0, errors
    assert len(list(log.iterdir())) == 8 - len(kept)
    assert {file: file.stat().st_mtime_ns for file in kept} == kept
    assert json.loads(found) == [2.0 * value for value in range(8)]


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


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder to another user")
def test_a_folder_of_another_user_is_refused(store):
    os.chown(store, 12345, -1)
    with pytest.raises(PermissionError, match="expected a folder of your own"):
        sweeps.run(square, range(4), 1, name="squares")


def test_other_inputs_are_other_tasks(store):
    sweeps.run(square, range(4), 1, name="squares")
    sweeps.run(square, range(5), 1, name="squares")
    assert square.calls == [0, 1, 2, 3, 4]
    sweeps.run(square, range(4), 2, name="squares")
    assert len(square.calls) == 9


def test_nothing_is_kept_unless_asked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(square, "calls", [], raising=False)
    sweeps.run(square, [1], 1, name="squares")
    assert not list(tmp_path.iterdir())


def test_results_of_other_code_are_not_taken(store, tmp_path, monkeypatch):
    """Other code is a changed module of the user or of zwfs, and a lambda that does or holds something else."""

    def is_new(task):
        known = set(store.rglob("output.pkl"))
        sweeps.run(task, [1], name="tasks")
        return set(store.rglob("output.pkl")) != known

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


def test_an_edit_of_what_a_study_imports_makes_its_results_new(tmp_path):
    """The store belongs to a copy of the project, of which some files are edited."""
    for folder in ("zwfs", "notebooks/studies"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    place = f"{tmp_path}{os.pathsep}{tmp_path / 'notebooks'}"
    script = "from studies import bandwidth, kit\nkit.sweeps.run(pow, [3], 2, name='squares')"

    def n_computed(*edited):
        for name in edited:
            with (tmp_path / name).open("a") as file:
                file.write("# changed\n")
        environment = os.environ | {"PYTHONPATH": place, sweeps.STORE: str(tmp_path / "store")}
        subprocess.run([sys.executable, "-c", script], cwd=tmp_path, env=environment, check=True)
        return len(list((tmp_path / "store").rglob("output.pkl")))

    assert [n_computed(), n_computed()] == [1, 1]
    assert n_computed("zwfs/frames/files.py", "notebooks/studies/design.py") == 1  # that are not imported
    assert n_computed("zwfs/reconstructors/phase_shifted.py") == 2
    assert n_computed("notebooks/studies/kit/style.py") == 3
    assert n_computed("notebooks/studies/bandwidth.py") == 4


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


def test_the_recipe_for_kubernetes_starts_a_cluster(foreign_cluster, monkeypatch):
    monkeypatch.setenv(sweeps.CLUSTER, foreign_cluster)
    found = sweeps.run(lambda value: os.getpid(), range(6), name="where")
    assert os.getpid() not in found


@pytest.mark.parametrize("experiment", [figure_3, figure_9, recovery])
def test_one_core_two_cores_and_a_cluster_agree_to_the_last_bit(
    experiment, pupil, modes, foreign_cluster, monkeypatch
):
    found = []
    for n_jobs in (1, 2):
        with joblib.parallel_config(n_jobs=n_jobs):
            found.append([array.tobytes() for array in experiment(pupil, modes)])
    monkeypatch.setenv(sweeps.CLUSTER, foreign_cluster)
    assert found[0] == found[1] == [array.tobytes() for array in experiment(pupil, modes)]


def test_the_recipe_for_slurm_submits_workers():
    made = {}
    exec(on_the_page("SLURMCluster(").replace("cluster.scale(jobs=10)", ""), made)
    with made["cluster"] as cluster:
        script = cluster.job_script()
    parts = "#SBATCH -p short", "/shared/zwfs/.venv/bin/python -m distributed", "--nthreads 1", "--nworkers 16"
    parts = *parts, "export PYTHONPATH=/shared/zwfs/notebooks"
    assert [part for part in parts if part not in script] == []


@pytest.mark.slow
def test_the_grid_on_the_page_runs(tmp_path):
    smaller = textwrap.indent(on_the_page("grid(").replace("make_pupil(64), 100", "make_pupil(24), 20"), "    ")
    (tmp_path / "script.py").write_text(f'if __name__ == "__main__":\n{smaller}')
    subprocess.run([sys.executable, "script.py"], cwd=tmp_path, env=AS_THE_PAGE_SAYS, check=True)
    assert len((tmp_path / "grid.csv").read_text().splitlines()) == 1 + 4 * 3 * 4 * 20
