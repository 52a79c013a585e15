"""The rays through the pixels of posed cameras, on the device."""

from __future__ import annotations

import numpy as np
import torch

from ..geometry.cameras import Camera
from .lenses import Lenses

BYTES = 12  # of a direction in the table


class CameraRays:
    """Viewing directions of pixels for a list of cameras, on the device.

    Pinhole directions are computed. Other lenses are inverted once for each pixel of each distinct camera and kept as a
    table of directions, one row a pixel, if it takes at most `budget` bytes (None: however large); else for the pixels
    of each batch.
    """

    def __init__(
        self, cameras: list[Camera], camera_to_box: np.ndarray, device: torch.device, budget: float | None = None
    ) -> None:
        self.device = device
        self.cameras = cameras
        pose = torch.from_numpy(camera_to_box.astype(np.float32)).to(device)
        self.rotation, self.center = pose[:, :3, :3].contiguous(), pose[:, :3, 3].contiguous()
        self.width = torch.tensor([c.width for c in cameras], device=device)
        self.lens = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float32, device=device)
        # Cameras with the same lens share its directions.
        self.distinct = list(dict.fromkeys(c for c in cameras if c.model != "PINHOLE"))
        number = {camera: index for index, camera in enumerate(self.distinct)}
        self.number = torch.tensor([number.get(c, -1) for c in cameras], device=device)
        self.lenses = Lenses(self.distinct, device) if self.distinct else None
        self.table: torch.Tensor | None = None
        sizes = np.array([c.width * c.height for c in self.distinct], np.int64)
        self.table_start = torch.from_numpy(sizes.cumsum() - sizes).to(device)
        if self.distinct and (budget is None or BYTES * int(sizes.sum()) <= budget):
            self.table = torch.cat([self.lens_directions(index) for index in range(len(self.distinct))])

    def lens_directions(self, number: int) -> torch.Tensor:
        """Directions (H · W, 3) of all pixels of a distinct lens; NaN where it cannot be inverted."""
        assert self.lenses is not None
        camera = self.distinct[number]
        if self.table is not None:
            first = int(self.table_start[number])
            return self.table[first : first + camera.width * camera.height]
        pixel = torch.arange(camera.width * camera.height, device=self.device)
        return self.lenses.directions(torch.full_like(pixel, number), _centers(pixel, camera.width))

    def camera_directions(self, image: torch.Tensor, pixel: torch.Tensor) -> torch.Tensor:
        """Unit directions (N, 3) in camera axes of pixels y · width + x; NaN where the lens cannot be inverted."""
        centers = _centers(pixel, self._of(self.width, image))
        fx, fy, cx, cy = self._of(self.lens, image).unbind(1)
        x, y = centers.unbind(1)
        directions = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], 1)
        directions = directions / directions.norm(dim=1, keepdim=True)
        if self.lenses is None:
            return directions
        number = self._of(self.number, image)
        lens = number.clamp(min=0)
        if self.table is None:
            others = self.lenses.directions(lens, centers)
        else:
            others = self.table[(self.table_start[lens] + pixel).clamp(max=len(self.table) - 1)]
        return torch.where((number >= 0)[:, None], others, directions)

    def __call__(self, image: torch.Tensor, pixel: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Origins and unit directions (N, 3), normalised frame."""
        directions = self.camera_directions(image, pixel)
        if len(self.cameras) == 1:
            turned = directions @ self.rotation[0].T
        else:
            turned = torch.einsum("nij,nj->ni", self.rotation[image], directions)
        return self._of(self.center, image).contiguous(), turned.contiguous()

    def _of(self, table: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """Rows (N, …) of the cameras (K, …) of `image` (N,), none of which is looked up where there is one camera."""
        return table.expand(len(image), *table.shape[1:]) if len(self.cameras) == 1 else table[image]


def _centers(pixel: torch.Tensor, width: torch.Tensor | int) -> torch.Tensor:
    """Coordinates (N, 2) float32 of the centres of pixels y · width + x."""
    return torch.stack([(pixel % width).float(), torch.div(pixel, width, rounding_mode="floor").float()], 1) + 0.5
