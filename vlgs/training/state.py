"""Saves the state of a module for a checkpoint, and restores it."""

from typing import Any

import torch
from torch import Tensor, nn

from vlgs.identity import RESULTS_VERSION
from vlgs.training.checkpoint import Checkpoint
from vlgs.training.lightning import VLGSModule


def capture(module: VLGSModule, meta: dict[str, Any]) -> Checkpoint:
    """Everything the next iteration depends on: parameters, weights, Adam's moments, densification statistics."""
    tensors: dict[str, Tensor] = {f"model.{k}": v for k, v in module.model.state_dict().items()}
    for name, part in _beside(module).items():
        tensors |= {f"{name}.{k}": v for k, v in part.state_dict().items()}
    for group in module.optimizer.param_groups:
        for index, parameter in enumerate(group["params"]):
            for key, value in module.optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{group['name']}.{index}.{key}"] = value
    tensors["densify.grad_sum"] = module.densifying.state.grad_sum
    tensors["densify.count"] = module.densifying.state.count
    tensors |= {f"mean.{name}": tensor for name, tensor in module.means.state().items()}
    if (left_out := module.views.left_out) is not None:
        tensors["left_out"] = left_out
    own = {
        "train_seconds": module.train_seconds,
        "results_version": RESULTS_VERSION,
        "sh_degree": module.model.sh_degree,
        "skips": module.skips.state(),
    }
    # safetensors shares no storage: views of one tensor are written twice rather than refused.
    return Checkpoint(module.next_step, {k: v.clone() for k, v in tensors.items()}, meta | own)


def restore(module: VLGSModule, checkpoint: Checkpoint) -> None:
    """Put a checkpoint back, whatever the number of Gaussians was before.

    Raises:
        ValueError: If the checkpoint belongs to another model.
    """
    version = checkpoint.meta.get("results_version")
    if version != RESULTS_VERSION:
        raise ValueError(f"resume: results version must be {RESULTS_VERSION}, got {version}")
    _restore_model(module, _below(checkpoint.tensors, "model."))
    for name, part in _beside(module).items():
        part.load_state_dict(_below(checkpoint.tensors, f"{name}."))
    adam = _below(checkpoint.tensors, "adam.")
    module.optimizer.state.clear()
    for group in module.optimizer.param_groups:
        for index, parameter in enumerate(group["params"]):
            state = _below(adam, f"{group['name']}.{index}.")
            if state:
                module.optimizer.state[parameter] = state
    module.densifying.state.grad_sum = checkpoint.tensors["densify.grad_sum"]
    module.densifying.state.count = checkpoint.tensors["densify.count"]
    module.means.restore(_below(checkpoint.tensors, "mean."))
    if "left_out" in checkpoint.tensors:
        module.step.leave_out(checkpoint.tensors["left_out"])
    module.next_step = checkpoint.step
    module.train_seconds = float(checkpoint.meta["train_seconds"])
    module.skips.restore(checkpoint.meta.get("skips", {}))
    module.model.sh_degree = int(checkpoint.meta["sh_degree"])


def _beside(module: VLGSModule) -> dict[str, nn.Module]:
    """What is trained and is no part of the model."""
    inside = ("fusion", "head")
    return {name: part for name, part in module.step.modules().items() if name not in inside}


def _restore_model(module: VLGSModule, tensors: dict[str, Tensor]) -> None:
    expected = set(module.model.state_dict())
    former = sorted(name for name in tensors if name.startswith("codec."))
    if former:
        raise ValueError(
            f"resume: checkpoint must hold its head as head.*, got {former[0]}, from when it was called codec; without the "
            "checkpoint folder the run starts anew"
        )
    if expected != set(tensors):
        odd = sorted(expected.symmetric_difference(tensors))
        raise ValueError(
            f"resume: checkpoint must hold the tensors of this model, got a difference in {odd}"
        )
    if not module.views.has_language:
        # Earlier checkpoints have zeros as wide as the head's codes where there is one number now.
        width = module.model.splats["features"].shape[1]
        tensors = {**tensors, "splats.features": tensors["splats.features"][:, :width]}
    for group in module.optimizer.param_groups:
        name = group["name"]
        if name in module.model.splats:
            parameter = nn.Parameter(torch.empty_like(tensors[f"splats.{name}"]))
            module.model.splats[name] = parameter
            group["params"] = [parameter]
    module.model.load_state_dict(tensors)


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
