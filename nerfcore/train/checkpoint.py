"""Checkpoints: one safetensors file with every tensor of the trainer, its numbers as JSON in the header.

One file, so that tensors and numbers can never be from different moments; written atomically.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file

from ..files import atomic_path
from .trainer import Trainer


def trainer_tensors(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Every tensor that training depends on."""
    tensors = {f"model.{name}": value for name, value in trainer.model.state_dict().items()}
    for index, parameter in enumerate(trainer.model.parameters()):
        for name, value in trainer.optimizer.state.get(parameter, {}).items():
            tensors[f"optimizer.{index}.{name}"] = value
    if trainer.sky is not None:
        tensors["sky_share"] = trainer.sky.share
    tensors["generator"] = trainer.generator.get_state()
    if trainer.guard.scaling:
        tensors["loss_scale"], tensors["loss_scale_steps"] = trainer.guard.scale, trainer.guard.good_steps
    if trainer.model.has_fixed_capacity():
        tensors["counted"] = trainer.counted
    if trainer.cache.hit is not None:
        tensors["cache.hit"] = trainer.cache.hit
    if trainer.poses is not None:
        tensors.update({f"poses.{name}": value for name, value in trainer.poses.tensors().items()})
    return tensors


def trainer_numbers(trainer: Trainer) -> dict[str, Any]:
    """Every number of the host that training depends on."""
    numbers: dict[str, Any] = {"steps": trainer.steps, "rays": trainer.rays}
    if trainer.sky is not None:
        numbers["sky_masks"] = trainer.sky.needed
    if trainer.model.has_fixed_capacity():
        numbers["visible_share"], numbers["drawn"] = trainer.model.host_visible_share, trainer.drawn
    return numbers


def save_checkpoint(path: Path, trainer: Trainer, state: dict[str, Any]) -> None:
    """Atomically write the trainer with `state` (progress, seconds, …).

    Raises:
        DiskError: the disk is full or the folder is not writable; an older checkpoint stays as it was.
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in trainer_tensors(trainer).items()}
    write_checkpoint(path, tensors, {**state, **trainer_numbers(trainer)})


def write_checkpoint(path: Path, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> None:
    """Atomically write tensors of the host and the state that belongs to them.

    Raises:
        DiskError: the disk is full or the folder is not writable; an older checkpoint stays as it was.
    """
    with atomic_path(path) as temporary:
        try:
            save_file(tensors, temporary, metadata={"fieldwork": json.dumps(state)})
        except SafetensorError as error:
            raise _disk_error(error) from error


def _disk_error(error: Exception) -> OSError:
    """safetensors reports a full disk as text; give it back its number."""
    import errno
    import re

    found = re.search(r"os error (\d+)", str(error))
    return OSError(int(found[1]) if found else errno.EIO, str(error))


def is_finite(trainer: Trainer) -> bool:
    """Whether all that was learned is a number. What is not stays so, as steps without finite gradients are left out."""
    grid = trainer.model.field.grid
    learned = [*trainer.model.parameters(), *([] if grid is None else [grid.table])]
    return all(bool(torch.isfinite(values).all()) for values in learned)


def restore(trainer: Trainer, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> None:
    """Put a checkpoint back into a trainer of the same configuration."""
    model = {name.removeprefix("model."): value for name, value in tensors.items() if name.startswith("model.")}
    trainer.model.load_state_dict(model)
    for index, parameter in enumerate(trainer.model.parameters()):
        prefix = f"optimizer.{index}."
        saved = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
        if saved:
            # Adam keeps its step count on the CPU unless it is fused on a GPU.
            trainer.optimizer.state[parameter] = saved
    if trainer.poses is not None:
        trainer.poses.restore({n.removeprefix("poses."): t for n, t in tensors.items() if n.startswith("poses.")})
    if trainer.sky is not None:
        trainer.sky.share.copy_(tensors.get("sky_share", trainer.sky.share))
        trainer.sky.needed = state.get("sky_masks", True)  # older trainings had them from the first step on
    _restore_generator(trainer, tensors["generator"].cpu(), state["steps"])
    trainer.guard.scale = tensors.get("loss_scale", trainer.guard.scale)
    trainer.guard.good_steps = tensors.get("loss_scale_steps", trainer.guard.good_steps)
    trainer.cache.hit = tensors.get("cache.hit")
    trainer.steps, trainer.rays = state["steps"], state["rays"]
    # What the host last read of the device, and what it will read next.
    trainer.model.host_visible_share = state.get("visible_share", float(trainer.model.visible_share))
    if "counted" in tensors:
        trainer.counted.copy_(tensors["counted"])
        trainer.drawn = state["drawn"]


def _restore_generator(trainer: Trainer, saved: torch.Tensor, steps: int) -> None:
    """Let random numbers go on as they would have; after another kind of device, whose generators have states of another size,
    with other ones than those of the first steps."""
    if len(saved) == len(trainer.generator.get_state()):
        trainer.generator.set_state(saved)
    else:
        trainer.generator.manual_seed(trainer.config.train.seed + steps)
