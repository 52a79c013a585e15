"""The finer grid of a finished field, kept in the folder of its run."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ..errors import DiskError
from ..files import atomic_path
from ..sampling.render_grid import FineDensity

log = logging.getLogger("fieldwork")
VERSION = 1


def read_tensor(file: Any, name: str) -> torch.Tensor:
    """A tensor of an open safetensors file, in memory of its own: what is read for the CPU is the mapped file itself, which
    Windows does not let anybody replace while a tensor of it is left."""
    tensor: torch.Tensor = file.get_tensor(name)
    return tensor.clone() if tensor.device.type == "cpu" else tensor


@dataclass(frozen=True)
class KeptGrid:
    """A file with what `read_fine` found in the field of one checkpoint (`checkpoint_id`)."""

    path: Path
    checkpoint: str

    def _belongs_to(self, factor: int) -> dict[str, str]:
        return {"version": str(VERSION), "checkpoint": self.checkpoint, "factor": str(factor)}

    def load(self, factor: int, device: torch.device) -> FineDensity | None:
        """What is kept of cells cut into factor³; None where there is nothing, or of another field."""
        if not self.path.is_file():
            return None
        try:
            with safe_open(self.path, "pt", device=str(device)) as file:
                if file.metadata() != self._belongs_to(factor):
                    return None
                return FineDensity(read_tensor(file, "coarse"), read_tensor(file, "density"))
        except (SafetensorError, OSError) as error:
            log.info("%s is read anew: %s", self.path, error)
            return None

    def save(self, factor: int, fine: FineDensity) -> None:
        """Keep it; where that is not possible, the next picture reads the field again."""
        tensors = {"coarse": fine.coarse.cpu(), "density": fine.density.cpu()}
        try:
            with atomic_path(self.path) as temporary:
                save_file(tensors, temporary, metadata=self._belongs_to(factor))
        except (DiskError, SafetensorError) as error:
            log.info("%s is not kept: %s", self.path, error)
