"""Small corrections of the training cameras, learned with the field.

Each image has a rotation vector ω (radians) and a translation τ (normalised units): its rays turn by exp([ω]×) about
the camera's centre, which moves by τ. The field would follow a common motion of all cameras without any change of the
loss, so the part of the corrections that is a similarity of the whole rig is taken out after every step; the refined
cameras stay in the frame of the given ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from ..config import TrainConfig
from ..data.camera_rays import CameraRays
from ..data.pixels import Batch
from ..files import write_json
from ..geometry.similarity import similarity_scale
from ..kernels.device import backend_of
from ..project.schema import PosedImage, Poses

BETAS = (0.9, 0.99)  # of Adam, as for the field: Müller et al., Instant Neural Graphics Primitives, 2022
# Not tuned: the next three.
LAST_RATE = 0.01  # of the first one, at the end of training
ALL_LEVELS = 0.5  # progress from which the finest level moves cameras too
FIRST_LEVELS = 0.375  # share of the levels that do so from the start


def skew(vector: torch.Tensor) -> torch.Tensor:
    """Cross-product matrices (N, 3, 3) of vectors (N, 3)."""
    x, y, z = vector.unbind(1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], 1).view(-1, 3, 3)


def turns(vector: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (N, 3, 3) exp([ω]×) of rotation vectors (N, 3) in radians, by Rodrigues' formula, without
    a singularity at 0."""
    squared = (vector * vector).sum(1)[:, None, None]
    angle = torch.sqrt(squared + 1e-20)
    cross = skew(vector)
    half = torch.sinc(angle / (2 * torch.pi))
    identity = torch.eye(3, device=vector.device, dtype=vector.dtype)
    return identity + torch.sinc(angle / torch.pi) * cross + 0.5 * half * half * (cross @ cross)


def rig_motions(centers: torch.Tensor) -> torch.Tensor:
    """Velocities (V·3, 7) of camera centres (V, 3) under the seven motions of a rigid, scalable rig."""
    middle = centers - centers.mean(0)
    turn = -skew(middle)  # ω × c = −[c]× ω
    shift = torch.eye(3, device=centers.device).expand(len(centers), 3, 3)
    return torch.cat([turn, shift, middle[:, :, None]], 2).reshape(-1, 7)


class PoseRefinement(nn.Module):
    """Corrections (V, 6) of the cameras behind some rays.

    Args:
        rays: the cameras; their poses are left as they are.
        keep_rig: take common motions out (training); a single camera against a fixed field keeps all of its motion.
    """

    def __init__(self, rays: CameraRays, config: TrainConfig, keep_rig: bool = True) -> None:
        super().__init__()
        self.config = config
        self.correction = nn.Parameter(torch.zeros(len(rays.center), 6, device=rays.center.device))
        fused = backend_of(self.correction.device).fused_optimizer
        self.optimizer = torch.optim.Adam([self.correction], config.pose_rate, betas=BETAS, eps=1e-15, fused=fused)
        motions = rig_motions(rays.center) if keep_rig else None
        self.motions = None if motions is None else (motions, torch.linalg.pinv(motions.cpu().double()).to(motions))
        self._moved: tuple[torch.Tensor, torch.Tensor] | None = None

    def move(self, batch: Batch) -> Batch:
        """The batch with corrected rays, which require gradients: `step` takes those up."""
        image = batch.image
        directions = torch.einsum("nij,nj->ni", turns(self.correction[:, :3])[image], batch.directions)
        origins = batch.origins + self.correction[image, 3:]
        self._moved = origins, directions
        return replace(
            batch,
            origins=origins.detach().contiguous().requires_grad_(),
            directions=directions.detach().contiguous().requires_grad_(),
        )

    def step(self, gradients: Sequence[Sequence[torch.Tensor]], progress: float) -> None:
        """One step along the loss's gradients of the origins and directions (R, 3) of `move`, which may come in parts
        of consecutive rays; `progress` of its own schedule."""
        assert self._moved is not None
        joined = [torch.cat(parts) for parts in zip(*gradients)]
        self.optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(self._moved, joined)  # type: ignore[arg-type]
        self._moved = None
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.pose_rate * LAST_RATE**progress
        self.optimizer.step()
        self._keep_rig()

    @torch.no_grad()
    def _keep_rig(self) -> None:
        if self.motions is None:
            return
        motions, inverse = self.motions
        common = inverse @ self.correction[:, 3:].reshape(-1)
        self.correction[:, 3:] -= (motions @ common).view(-1, 3)
        self.correction[:, :3] -= common[:3]

    @torch.no_grad()
    def poses(self, rays: CameraRays) -> torch.Tensor:
        """Corrected camera-to-box poses (V, 4, 4)."""
        result = torch.eye(4, device=rays.center.device).repeat(len(rays.center), 1, 1)
        result[:, :3, :3] = turns(self.correction[:, :3]) @ rays.rotation
        result[:, :3, 3] = rays.center + self.correction[:, 3:]
        return result

    def tensors(self) -> dict[str, torch.Tensor]:
        """What a checkpoint has to keep."""
        state = self.optimizer.state.get(self.correction, {})
        return {"correction": self.correction.detach(), **{f"optimizer.{name}": value for name, value in state.items()}}

    @torch.no_grad()
    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """Take up what `tensors` gave."""
        self.correction.copy_(tensors["correction"])
        state = {n.removeprefix("optimizer."): t for n, t in tensors.items() if n.startswith("optimizer.")}
        if state:
            self.optimizer.state[self.correction] = state

    def shift(self, world_from_box: np.ndarray) -> dict[str, float]:
        """Median and largest correction: degrees, and distance in units of the world."""
        values = self.correction.detach().cpu().double()
        degrees = torch.rad2deg(values[:, :3].norm(dim=1))
        units = values[:, 3:].norm(dim=1) * similarity_scale(world_from_box)
        return {
            "median_degrees": round(float(degrees.median()), 4),
            "median_units": round(float(units.median()), 6),
            "largest_degrees": round(float(degrees.max()), 4),
            "largest_units": round(float(units.max()), 6),
        }


def level_weights(levels: int, progress: float) -> list[float]:
    """Coarse-to-fine: how much each level of the grid moves the cameras."""
    first = FIRST_LEVELS * levels
    position = first + (levels - first) * min(1.0, progress / ALL_LEVELS)
    return [min(1.0, max(0.0, position - index)) for index in range(levels)]


def write_poses(path: Path, refinement: PoseRefinement, rays: CameraRays, names: list[str], sfm_from_box: np.ndarray):
    """The refined cameras in the SfM frame, in the form of a project's poses.json. Raises DiskError."""
    poses = refinement.poses(rays).cpu().double().numpy()
    moved = sfm_from_box @ poses
    moved[:, :3, :3] /= similarity_scale(sfm_from_box)
    cameras = list(dict.fromkeys(rays.cameras))
    images = [
        PosedImage(name=name, camera=cameras.index(camera), camera_to_world=pose.tolist())
        for name, camera, pose in zip(names, rays.cameras, moved)
    ]
    write_json(path, Poses(source="refined", cameras=cameras, images=images).model_dump(mode="json"))
