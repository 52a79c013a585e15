"""Training pixels of all photos, resident on the device as bytes, and the rays through them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch

from ..errors import InputError
from ..progress import Reporter
from .box import box_poses
from .cameras import Camera, pixel_centers, rays
from .scene import Scene

VOID = 255  # class index of unlabelled pixels


def read_image(path: Path) -> np.ndarray:
    """Pixels (H, W, C) uint8, C 1 to 4, of an image file. Raises InputError naming the file."""
    buffer = oiio.ImageBuf(str(path))
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.UINT8)
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    return pixels


def read_photo(path: Path) -> np.ndarray:
    """A photo as (H, W, 4) uint8 with straight alpha. Raises InputError naming the file."""
    buffer = oiio.ImageBuf()
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    buffer.reset(str(path), 0, 0, config)
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.UINT8)
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    if pixels.shape[2] <= 2:
        pixels = np.concatenate([np.repeat(pixels[..., :1], 3, 2), pixels[..., 1:]], 2)
    if pixels.shape[2] == 3:
        pixels = np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], 2)
    return pixels


def read_label(path: Path) -> np.ndarray:
    """A label map as class ids (H, W) int64. Raises InputError naming the file."""
    buffer = oiio.ImageBuf(str(path))
    pixels = (
        None if buffer.has_error else buffer.get_pixels(oiio.UINT16 if buffer.spec().format == "uint16" else oiio.UINT8)
    )
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    return pixels[..., 0].astype(np.int64)


def resize(pixels: np.ndarray, width: int, height: int, nearest: bool = False) -> np.ndarray:
    """Resample (H, W, C) uint8 to width × height; box-like filtering unless `nearest`."""
    if pixels.shape[1] == width and pixels.shape[0] == height:
        return pixels
    if nearest:
        y = ((np.arange(height) + 0.5) * pixels.shape[0] / height).astype(int)
        x = ((np.arange(width) + 0.5) * pixels.shape[1] / width).astype(int)
        return pixels[y][:, x]
    source = oiio.ImageBuf(np.ascontiguousarray(pixels))
    result = oiio.ImageBufAlgo.resize(source, roi=oiio.ROI(0, width, 0, height, 0, 1, 0, pixels.shape[2]))
    return np.asarray(result.get_pixels(oiio.UINT8))


def training_size(camera: Camera, longest: int) -> tuple[int, int]:
    """Width and height of an image limited to `longest` pixels a side, aspect kept."""
    scale = min(1.0, longest / max(camera.width, camera.height))
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


@dataclass(frozen=True)
class Batch:
    """R rays in the normalised frame with what their pixels hold.

    origins, directions (R, 3) float32, unit directions; rgb (R, 3) and alpha (R,) float32 in [0, 1] (sRGB, straight
    alpha); label (R,) int64 class index or VOID; image (R,) int64 index into the store; pixel (R,) int64 its place;
    confidence (R,) float32 in [0, 1], how sure the label is; weight (R,) float32, how much of a pixel drawn as often as
    any other the ray stands for.
    """

    origins: torch.Tensor
    directions: torch.Tensor
    rgb: torch.Tensor
    alpha: torch.Tensor
    label: torch.Tensor
    image: torch.Tensor
    pixel: torch.Tensor
    confidence: torch.Tensor
    weight: torch.Tensor

    def part(self, rays: slice) -> Batch:
        """Some of the rays."""
        return Batch(*(getattr(self, field.name)[rays] for field in fields(self)))


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


class PixelStore:
    """Photos, labels and masks of some views as flat byte tensors.

    rgba (P, 4) uint8; label (P,) uint8 class index (VOID where unlabelled); first (V+1,) int64 first pixel of a view.

    Args:
        scene: posed views in the world frame.
        indices: which views.
        class_ids: class id of each class index.
        box_from_world: similarity (4, 4) into the normalised frame.
        longest: limit of the image side in pixels.
    """

    def __init__(
        self,
        scene: Scene,
        indices: list[int],
        class_ids: list[int],
        box_from_world: np.ndarray,
        longest: int,
        device: torch.device,
        report: Reporter,
    ) -> None:
        self.views = [scene.views[i] for i in indices]
        self.device = device
        lookup = np.full(65536, VOID, np.uint8)
        for index, class_id in enumerate(class_ids):
            lookup[class_id] = index
        cameras, colours, labels, usable, sure = [], [], [], [], []
        self.transparent = False
        for number, view in enumerate(self.views):
            report.progress(number / len(self.views), view.name)
            width, height = training_size(view.camera, longest)
            photo = resize(read_photo(view.image), width, height)
            label = np.full((height, width), VOID, np.uint8)
            if view.label is not None:
                label = lookup[resize(read_label(view.label)[..., None], width, height, nearest=True)[..., 0]]
            confidence = np.full((height, width), 255, np.uint8)
            if view.confidence is not None:
                confidence = resize(read_image(view.confidence)[..., :1], width, height, nearest=True)[..., 0]
            sure.append(torch.from_numpy(np.ascontiguousarray(confidence)).reshape(-1))
            keep = np.ones((height, width), bool)
            if view.mask is not None:
                inside = resize(read_image(view.mask)[..., :1], width, height, nearest=True)[..., 0] > 127
                if scene.mask_mode == "empty":
                    photo = photo.copy()
                    photo[..., 3] = np.where(inside, photo[..., 3], 0)
                else:
                    keep = inside
            self.transparent |= bool((photo[..., 3] < 255).any())
            cameras.append(view.camera.resized(width, height))
            colours.append(torch.from_numpy(np.ascontiguousarray(photo)).reshape(-1, 4))
            labels.append(torch.from_numpy(label).reshape(-1))
            usable.append(torch.from_numpy(keep).reshape(-1))
        self.cameras = cameras
        self.rgba = torch.cat(colours).to(device)
        self.label = torch.cat(labels).to(device)
        known = any(view.confidence is not None for view in self.views)
        self.confidence = torch.cat(sure).to(device) if known else None
        sizes = torch.tensor([c.width * c.height for c in cameras])
        self.first = torch.cat([torch.zeros(1, dtype=torch.long), sizes.cumsum(0)]).to(device)
        self.rays = CameraRays(cameras, box_poses(self.views, box_from_world), device)
        keep = torch.cat(usable)
        if self.rays.table is not None:
            everywhere = torch.arange(len(keep))
            image = torch.bucketize(everywhere, self.first[1:].cpu(), right=True).to(device)
            directions = self.rays.camera_directions(image, everywhere.to(device) - self.first[image])
            keep &= ~directions[:, 0].isnan().cpu()
        # Positions of the pixels that count, only where not all do.
        self.usable = None if bool(keep.all()) else keep.nonzero()[:, 0].to(device)

    def __len__(self) -> int:
        return len(self.rgba)

    def batch(self, places: torch.Tensor) -> Batch:
        """Rays and values of pixels at flat positions (R,) int64."""
        image = torch.bucketize(places, self.first[1:], right=True)
        pixel = places - self.first[image]
        origins, directions = self.rays(image, pixel)
        value = self.rgba[places].float() / 255
        sure = torch.ones_like(value[:, 3]) if self.confidence is None else self.confidence[places].float() / 255
        rgb, alpha, label = value[:, :3], value[:, 3], self.label[places].long()
        return Batch(origins, directions, rgb, alpha, label, image, pixel, sure, torch.ones_like(sure))

    def labelled_share(self) -> float:
        """Share of the usable pixels with something in them that have a label; 1 where there are no labels at all."""
        places = slice(None) if self.usable is None else self.usable
        shows = self.rgba[places, 3] > 127
        labelled = (self.label[places] != VOID) & shows
        return float(labelled.sum() / shows.sum().clamp(min=1)) or 1.0

    def random_places(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """`count` flat positions of usable pixels, with repetition."""
        total = len(self) if self.usable is None else len(self.usable)
        chosen = torch.randint(0, total, (count,), device=self.device, generator=generator)
        return chosen if self.usable is None else self.usable[chosen]
