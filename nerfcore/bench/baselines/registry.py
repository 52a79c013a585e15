"""The baselines by name."""

from __future__ import annotations

import torch

from ...errors import SettingError
from .instant_ngp import InstantNGP
from .method import Baseline, Setup
from .mip_nerf import MipNeRF
from .nerf import NeRF
from .nerf_w import NeRFW
from .s_nerf_pp import SNeRFPP
from .semantic_nerf import SemanticNeRF

BASELINES: dict[str, type[Baseline]] = {
    "nerf": NeRF,
    "mip-nerf": MipNeRF,
    "instant-ngp": InstantNGP,
    "semantic-nerf": SemanticNeRF,
    "s-nerf++ field": SNeRFPP,
    "nerf-w codes": NeRFW,
}
SEMANTIC = ("semantic-nerf", "s-nerf++ field")


def make_baseline(name: str, setup: Setup, seed: int) -> Baseline:
    """An untrained method with initial values from a seed.

    Raises:
        SettingError: no such method, or one of classes on a scene without labels.
    """
    if name not in BASELINES:
        raise SettingError(f"There is no method “{name}”.", f"Choose one of {', '.join(BASELINES)}.")
    if name in SEMANTIC and setup.classes == 0:
        raise SettingError(f"{name} learns classes, and the scene has no labels.", "Leave it out, or label the photos.")
    torch.manual_seed(seed)
    return BASELINES[name](setup)
