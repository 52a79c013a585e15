"""The state in which a training begins, for those that find out that they must start over."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from ..render.model import Model
from .trainer import Trainer


class InitialState:
    """A copy, in the host's memory, of all that the first step of a trainer depends on; made before that step."""

    def __init__(self, trainer: Trainer) -> None:
        self.values = {name: value.to("cpu", copy=True) for name, value in _values(trainer.model)}
        self.generator = trainer.generator.get_state()

    def restarted(self, trainer: Trainer) -> Trainer:
        """A trainer of the same model, which is put back into this state; the one given must not be used again. What it
        found out about the sky stays known."""
        model = trainer.model
        again = Trainer(model, trainer.store, trainer.config, trainer.background, trainer.check)
        again.space, again.depths, again.sky = trainer.space, trainer.depths, trainer.sky
        again.largest_batch = trainer.largest_batch
        with torch.no_grad():
            for name, value in _values(model):
                value.copy_(self.values[name])
        model.refresh()
        again.generator.set_state(self.generator)
        return again


def _values(model: Model) -> Iterator[tuple[str, torch.Tensor]]:
    """Parameters and buffers by name, also those that no checkpoint keeps."""
    for name, value in [*model.named_parameters(), *model.named_buffers()]:
        yield name, value.detach()
