"""Runs a task once, with the configuration that the check of the command line has composed. Imports no torch.

`hydra.main` composes it twice more, once to learn that there is one run and once for that, which takes a tenth of the time to the first iteration.
"""

from collections.abc import Callable
from typing import Any

from hydra import initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra._internal.utils import run_and_report
from hydra.core.global_hydra import GlobalHydra
from hydra.core.utils import configure_log, run_job
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig

from vlgs.known import CONF


def run_task(task: Callable[[DictConfig], Any], config: DictConfig) -> None:
    """What `hydra.main` does with a task after it has composed the configuration: logging, Hydra's callbacks and its report of errors.

    Args:
        task: Gets the configuration without Hydra's part; what `hydra.main` has made of a task passes it on.
        config: With Hydra's part, see `vlgs.command.check_command`.
    """
    hydra = config.hydra
    hydra.mode = RunMode.RUN

    def job() -> None:
        configure_log(hydra.hydra_logging, hydra.verbose)
        callbacks = Callbacks(config)
        context = HydraContext(GlobalHydra.instance().config_loader(), callbacks)
        callbacks.on_run_start(config=config, config_name=hydra.job.config_name)
        done = run_job(
            task, config, job_dir_key="hydra.run.dir", job_subdir_key=None, hydra_context=context
        )
        callbacks.on_run_end(config=config, config_name=hydra.job.config_name, job_return=done)
        _ = done.return_value  # raises what the task did

    with initialize_config_dir(str(CONF), job_name=hydra.job.name, version_base="1.3"):
        run_and_report(job)
