"""Language maps for your own photographs: `python -m vlgs.features data=colmap data.root=SCENE`. `--help` is the manual."""

import sys

import hydra
import torch
from omegaconf import DictConfig
from rich.console import Console

from vlgs.arguments import take_command_line
from vlgs.command import check_command
from vlgs.config import CONF, check_targets, require_given
from vlgs.features import job as work

STOPPED = 130
"""Exit status after Ctrl-C, as shells have it."""


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="features")
def main(config: DictConfig) -> None:
    """Make the language maps that a scene lacks."""
    try:
        require_given(config)
        check_targets(config, "features")
        torch.set_num_threads(config.threads)
        extract(config)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from there", file=sys.stderr)
        sys.exit(STOPPED)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")


def extract(config: DictConfig) -> None:
    """Do the job, or with `dry_run` say what it would take.

    Raises:
        OSError: If the scene or weights are not there, or a file cannot be written.
        ValueError: If scene, options or the folder's settings are at fault.
    """
    console = Console(
        soft_wrap=True, highlight=False, markup=False, emoji=False, quiet=not config.progress
    )
    job = work.plan(config)
    if config.dry_run:
        for line in work.estimate(job):
            console.print(line)
        return
    made = sum(1 for _ in work.run(job, console))
    console.print(f"{made} made, {len(job.views) - made} were there: {job.folder.path}")


if __name__ == "__main__":
    # Hydra takes no flags of ours.
    sys.argv = ["dry_run=true" if word == "--dry-run" else word for word in sys.argv]
    take_command_line()
    try:
        check_command(sys.argv[1:], "features")
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    main()
