"""The rays through the pixels of posed cameras, on the device."""

from __future__ import annotations

import numpy as np
import torch

from ..geometry.cameras import Camera, pixel_centers, rays


class CameraRays:
    """Viewing directions of pixels for a list of cameras, on the device.

    Pinhole directions are computed; other models are inverted once per distinct camera and kept as a table of
    directions, one row a pixel (12 bytes).
    """

    def __init__(self, cameras: list[Camera], camera_to_box: np.ndarray, device: torch.device) -> None:
        self.device = device
        self.cameras = cameras
        pose = torch.from_numpy(camera_to_box.astype(np.float32)).to(device)
        self.rotation, self.center = pose[:, :3, :3].contiguous(), pose[:, :3, 3].contiguous()
        self.width = torch.tensor([c.width for c in cameras], device=device)
        self.lens = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float32, device=device)
        distinct = list(dict.fromkeys(c for c in cameras if c.model != "PINHOLE"))
        tables, begin, first = [], 0, {}
        for camera in distinct:
            directions, valid = rays(camera, pixel_centers(camera.width, camera.height).reshape(-1, 2))
            directions[~valid] = np.nan
            first[camera] = begin
            begin += len(directions)
            tables.append(torch.from_numpy(directions.astype(np.float32)))
        self.table = torch.cat(tables).to(device) if tables else None
        self.table_start = torch.tensor([first.get(c, -1) for c in cameras], device=device)

    def camera_directions(self, image: torch.Tensor, pixel: torch.Tensor) -> torch.Tensor:
        """Unit directions (N, 3) in camera axes of pixels y · width + x; NaN where the lens cannot be inverted."""
        x = (pixel % self.width[image]).float() + 0.5
        y = torch.div(pixel, self.width[image], rounding_mode="floor").float() + 0.5
        fx, fy, cx, cy = self.lens[image].unbind(1)
        directions = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], 1)
        directions = directions / directions.norm(dim=1, keepdim=True)
        if self.table is None:
            return directions
        start = self.table_start[image]
        known = self.table[(start.clamp(min=0) + pixel).clamp(max=len(self.table) - 1)]
        return torch.where((start >= 0)[:, None], known, directions)

    def __call__(self, image: torch.Tensor, pixel: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Origins and unit directions (N, 3), normalised frame."""
        directions = torch.einsum("nij,nj->ni", self.rotation[image], self.camera_directions(image, pixel))
        return self.center[image].contiguous(), directions.contiguous()
