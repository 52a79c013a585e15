"""Settings of trainings small enough for tests."""

from __future__ import annotations

from pathlib import Path

import torch
from fieldwork.nerfcore.config import RunConfig, make_config
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.train.prepare import make_trainer, plan_run
from fieldwork.nerfcore.train.trainer import Trainer

from .ball import SMALL


def config_of(**settings: str) -> RunConfig:
    """The draft preset, small, with some settings changed."""
    return make_config("draft", {**SMALL, **settings})


def trainer_of(project: Path, **settings: str) -> Trainer:
    """The trainer of a new run on the CPU."""
    info, scene = plan_run(project, "draft", config_of(**settings), torch.device("cpu"))
    return make_trainer(project, info, scene, torch.device("cpu"), Reporter())
