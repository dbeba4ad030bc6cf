"""Hand the missing runs to the Hydra launcher that was chosen."""

from collections.abc import Sequence
from pathlib import Path

from hydra import initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.core.utils import JobStatus
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode

from vlgs.ablate.job import Outcome, log_path, run_job
from vlgs.config import CONF


def launch(
    commands: Sequence[Sequence[str]], results: Path, options: Sequence[str]
) -> list[Outcome]:
    """Run every command on the launcher; a failure is an outcome, not an exception.

    Args:
        commands: Arguments of `vlgs.run`, one sequence per run.
        results: Where runs and logs go.
        options: Overrides of `hydra` itself: ``hydra/launcher=joblib``, ``hydra.launcher.n_jobs=2``.

    Returns:
        One outcome per command, in their order.

    Raises:
        ValueError: If the launcher does not exist or is not installed.
    """
    folder = f"results={results.resolve()}"
    jobs = [[*command, folder] for command in commands]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        try:
            config = hydra.compose_config(
                "config", [folder, *options], RunMode.MULTIRUN, with_log_configuration=False
            )
            launcher = Plugins.instance().instantiate_launcher(
                hydra_context=HydraContext(hydra.config_loader, Callbacks()),
                task_function=run_job,
                config=config,
            )
        except HydraException as error:
            raise ValueError(
                f"ablate: launcher must exist and be installed (pip install 'vlgs[cluster]' or 'vlgs[ray]'), got: {error}"
            ) from error
        state = Singleton.get_state()
        try:
            returns = launcher.launch(jobs, initial_job_idx=0)
        finally:
            Singleton.set_state(state)
    outcomes = []
    for job, done in zip(jobs, returns, strict=True):
        if done.status == JobStatus.COMPLETED:
            outcomes.append(done.return_value)
        else:  # the launcher itself lost it: a worker died
            log = log_path(results, job)
            outcomes.append(Outcome(log.stem, -1, 0.0, log))
    return outcomes
