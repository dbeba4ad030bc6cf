"""The mean of the last iterations in place of the last one.

Codes that keep their rate do not come to rest: they follow what the last views say, the faults of their masks included, while their mean over
many iterations follows what all views say (Polyak and Juditsky, 1992, on averages of stochastic approximation).
"""

import torch

from vlgs.training.after_step import AfterStep, TrainedModule
from vlgs.training.lightning import VLGSModule

EVERY = 4
"""Iterations between two that count: neighbours differ by little. A pass over all parameters takes 0.1 ms for 10k Gaussians, 3 ms for 100k."""


class Average(AfterStep):
    """After the last iteration, set what is trained to its mean over the last share of the iterations (`TrainerConfig.average`).

    None counts before densification has ended: the mean of Gaussians that come and go means nothing.
    """

    @torch.no_grad()
    def after_step(self, module: TrainedModule) -> None:
        """Add the parameters when it is time, and set them after the last iteration."""
        assert isinstance(module, VLGSModule)
        settings, means = module.settings, module.means
        left = settings.iterations - module.next_step
        if left % EVERY or module.next_step <= module.densifying.config.densify.stop:
            return
        for name, parameter in module.step.trained():
            if parameter.requires_grad and left < settings.average(name) * settings.iterations:
                means.add(name, parameter)
        if left == 0:
            for name, parameter in module.step.trained():
                if name in means.sums:
                    parameter.copy_(means[name])
