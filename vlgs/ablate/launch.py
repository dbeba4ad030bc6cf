"""Start the missing runs through the chosen Hydra launcher."""

import logging
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

from vlgs.ablate.job import (
    JobOutcome,
    StoppedJobs,
    leave_parent,
    read_outcome,
    run_job,
    run_warm_job,
)
from vlgs.config import CONF, quote_override

log = logging.getLogger(__name__)

_LOCAL = ("BasicLauncher", "JoblibLauncher")
"""Launchers whose workers are processes of this machine."""


def launch(
    commands: Sequence[Sequence[str]],
    results: Path,
    options: Sequence[str],
    folder: Path,
    first: int,
    warm: bool = False,
) -> list[JobOutcome]:
    """Run every command on the launcher; a failure is an outcome, not an exception.

    Args:
        commands: Arguments of `vlgs.run`, one sequence per run.
        results: Where runs go.
        options: Overrides of `hydra` itself: ``hydra/launcher=processes``, ``hydra.launcher.n_jobs=2``.
        folder: Where jobs say how they go; on a disk that every worker sees.
        first: Number of the first job; numbers are not used twice in a folder.
        warm: Whether workers on this machine fork runs from a parent that has done their imports (`vlgs.ablate.warm`).

    Returns:
        One outcome per command, in their order.

    Raises:
        ValueError: If the launcher does not exist, is not installed, or could not start a single job.
    """
    # Literal absolute folders: workers resolve what they are given again, in a folder and an environment of their own.
    place = quote_override("results", str(results.resolve()))
    own = [quote_override("hydra.sweep.dir", str(folder.resolve())), "hydra.sweep.subdir=."]
    quiet = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
    jobs = [[*command, place] for command in commands]
    trouble: Exception | None = None
    with initialize_config_dir(str(CONF), version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        try:
            config = hydra.compose_config(
                "config",
                [place, *quiet, *options, *own],
                RunMode.MULTIRUN,
                with_log_configuration=False,
            )
            local = str(config.hydra.launcher._target_).endswith(_LOCAL)
            launcher = Plugins.instance().instantiate_launcher(
                hydra_context=HydraContext(hydra.config_loader, Callbacks()),
                task_function=run_warm_job if warm and local else run_job,
                config=config,
            )
        except HydraException as error:
            raise ValueError(
                "ablate: hydra/launcher must exist and be installed (pip install 'vlgs[cluster]' or 'vlgs[ray]'), "
                f"got: {error}"
            ) from error
        state = Singleton.get_state()
        try:
            for done in launcher.launch(jobs, initial_job_idx=first):
                if done.status == JobStatus.FAILED:  # before its run began: no disk, no module
                    trouble = done._return_value
        except StoppedJobs:
            log.debug("stopped")
        except Exception as error:  # launchers are other people's code: every one has errors of its own for a lost worker
            trouble = error
        finally:
            Singleton.set_state(state)
            leave_parent()
    outcomes = [read_outcome(folder, first + index) for index in range(len(jobs))]
    said = f"{type(trouble).__name__}: {str(trouble).strip().partition(chr(10))[0]}"
    if not any(outcome.log for outcome in outcomes):
        raise ValueError(f"ablate: the launcher must start jobs, got {said}") from trouble
    if trouble is not None:
        log.warning("the launcher lost a worker (%s)", said)
    return outcomes
