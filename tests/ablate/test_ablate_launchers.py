"""The same ablation on every launcher, with a worker killed in the middle: no run is lost, none is there twice."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import ablate_fakes
import pytest

from vlgs.ablate import __main__ as runner
from vlgs.ablate import launch as launching
from vlgs.ablate.__main__ import Request, ablate
from vlgs.runs import STOPPED
from vlgs.tables.benchmark import Benchmark
from vlgs.tables.registry import load_table

pytestmark = pytest.mark.slow

ALL = {f"{row} glassware {seed}" for row in ("none", "self") for seed in (0, 1)}


@pytest.fixture(autouse=True)
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launching, "run_job", ablate_fakes.run_faked)
    monkeypatch.setattr(runner, "WAIT_SECONDS", 0.2)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # for workers


def request_of(folder: Path, *launcher: str) -> Request:
    path = folder / "tiny.yaml"
    path.write_text(ablate_fakes.TABLE)
    (folder / "r").mkdir()
    benchmark = Benchmark("synthetic", ("data=synthetic",), ("glassware",), (0, 1))
    return Request([load_table(path)], benchmark, folder / "r", launcher, False)


def check_complete(request: Request) -> None:
    metrics = [json.loads(p.read_text()) for p in request.results.glob("runs/*/metrics.json")]
    assert len(metrics) == len({(m["recipe"], m["seed"]) for m in metrics}) == len(ALL)
    assert (
        "Mean +- standard deviation over 2 seeds"
        in (request.results / "synthetic" / "tiny.md").read_text()
    )


def kill_one_worker(request: Request) -> None:
    acts = {"none glassware 1": ["orphan", "ok"]}
    (request.results / "behave.json").write_text(json.dumps(acts))


@pytest.mark.parametrize("killed", [False, True])
def test_joblib(tmp_path: Path, killed: bool):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    request = request_of(tmp_path, "hydra/launcher=processes", "hydra.launcher.n_jobs=2")
    if killed:
        kill_one_worker(request)
    assert ablate(request) == 0
    check_complete(request)


@pytest.mark.filterwarnings(
    "ignore:.*Popen.__del__"
)  # submitit leaves a process that it did not wait for
@pytest.mark.parametrize("killed", [False, True])
def test_submitit_local(tmp_path: Path, killed: bool):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    request = request_of(tmp_path, "hydra/launcher=slurm_local")
    if killed:
        kill_one_worker(request)
    assert ablate(request) == 0
    check_complete(request)


def test_slurm_preset_composes_without_slurm(tmp_path: Path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    request = request_of(tmp_path, "hydra/launcher=slurm", "threads=4")
    with pytest.raises(
        ValueError, match=r"the launcher must start jobs, got .*(srun|sbatch|slurm)"
    ):
        ablate(request)


@pytest.fixture
def ray_address(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A cluster of two nodes with one core each, on this machine."""
    pytest.importorskip("hydra_plugins.hydra_ray_launcher")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    head = {"num_cpus": 1, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    cluster.add_node(num_cpus=1)
    yield str(cluster.address)
    ray.shutdown()
    cluster.shutdown()


@pytest.mark.filterwarnings("ignore")  # Ray's own
@pytest.mark.parametrize("killed", [False, True])
def test_ray_cluster_of_two_nodes(tmp_path: Path, ray_address: str, killed: bool):
    request = request_of(
        tmp_path,
        "hydra/launcher=ray_cluster",
        f"hydra.launcher.ray.init.address={ray_address}",
        "threads=1",
    )
    if killed:
        kill_one_worker(request)
    assert ablate(request) == 0
    check_complete(request)


ABLATE = """
import sys
from pathlib import Path
import ablate_fakes
from vlgs.ablate import __main__ as runner, launch
from vlgs.tables.benchmark import Benchmark
from vlgs.tables.registry import load_table
launch.run_job = ablate_fakes.run_faked
runner.WAIT_SECONDS = 0.2
folder = Path(sys.argv[1])
benchmark = Benchmark("synthetic", ("data=synthetic",), ("glassware",), (0, 1))
table = load_table(folder / "tiny.yaml")
sys.exit(runner.ablate(runner.Request([table], benchmark, folder / "r", tuple(sys.argv[2:]), False)))
"""


def start(folder: Path, *launcher: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", ABLATE, str(folder), *launcher],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def test_two_ablations_at_once_share_the_work(tmp_path: Path):
    request = request_of(tmp_path)
    both = [start(tmp_path), start(tmp_path)]
    outputs = [process.communicate(timeout=300)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], outputs
    check_complete(request)


@pytest.mark.parametrize("launcher", ["basic", "processes"])
def test_ctrl_c_in_a_terminal(tmp_path: Path, launcher: str):
    if launcher == "processes":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    request = request_of(tmp_path)
    (request.results / "behave.json").write_text(json.dumps({"none glassware 0": ["wait"]}))
    process = start(tmp_path, f"hydra/launcher={launcher}")
    while not (request.results / "waiting").exists():
        assert process.poll() is None
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to every process of the group
    output, _ = process.communicate(timeout=60)
    assert process.returncode == STOPPED, output
    assert "the same command goes on from here" in output
    said = [
        json.loads(path.read_text())["status"] for path in request.results.glob("logs/*/0000.json")
    ]
    assert said == [STOPPED]  # the run was told, once, and saved
    assert ablate(request) == 0
    check_complete(request)
