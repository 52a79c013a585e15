"""Training pixels of all photos as bytes, on the device or beside it, and the rays through them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from ..geometry.cameras import Camera
from ..images.picture import cut_out, resized, with_alpha
from ..images.working import MASK_UNKNOWN, nearest, read_image, read_label
from ..progress import Reporter
from .box import box_poses
from .camera_rays import CameraRays
from .photo import photo_of
from .scene import Scene

VOID = 255  # class index of unlabelled pixels


def training_size(camera: Camera, longest: int) -> tuple[int, int]:
    """Width and height of an image limited to `longest` pixels a side, aspect kept."""
    scale = min(1.0, longest / max(camera.width, camera.height))
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


def _flat(values: np.ndarray) -> torch.Tensor:
    """Values of all pixels of a picture, one after the other."""
    return torch.from_numpy(np.ascontiguousarray(values)).reshape(-1)


def home_of(size: int, budget: float, device: torch.device) -> torch.device:
    """Where photos of `size` bytes stay: on the device if they are within the budget, else with the host."""
    return device if size <= budget else torch.device("cpu")


@dataclass(frozen=True)
class Batch:
    """R rays in the normalised frame with what their pixels hold.

    origins, directions (R, 3) float32, unit directions; rgb (R, 3) and alpha (R,) float32 in [0, 1] (sRGB, straight
    alpha); label (R,) int64 class index or VOID; image (R,) int64 index into the store; pixel (R,) int64 its place;
    confidence (R,) float32 in [0, 1], how sure the label is; weight (R,) float32, how much of a pixel drawn as often as
    any other the ray stands for; unknown (R,) bool, where a mask does not know whether something is there, alpha being 0;
    None: nowhere; sky (R,) bool, where the environment may be what the pixel shows; None: everywhere.
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
    unknown: torch.Tensor | None = None
    sky: torch.Tensor | None = None

    def part(self, rays: slice) -> Batch:
        """Some of the rays."""
        known = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: values[rays] for name, values in known.items() if values is not None})

    def before(self, background: torch.Tensor) -> torch.Tensor:
        """What rays end on, (R, 3), given a background (R, 3): where a mask does not know whether something is there, it is
        the photo's own colour, with which an opening explains the pixel as well as a surface does."""
        return background if self.unknown is None else torch.where(self.unknown[:, None], self.rgb, background)


class PixelStore:
    """Photos, labels and masks of some views as flat byte tensors.

    rgba (P, 4) uint8; label (P,) uint8 class index (VOID where unlabelled); usable: int64 positions of the pixels that
    count, None where all do; unknown (P,) bool, see `Batch`, or None; first (V+1,) int64 first pixel of a view. All but `first` are at `home`: the device, or
    the host's memory where they are larger than `budget` bytes; `at` reads them wherever they are.

    Args:
        scene: posed views in the world frame.
        indices: which views.
        class_ids: class id of each class index.
        box_from_world: similarity (4, 4) into the normalised frame.
        longest: limit of the image side in pixels.
        budget: bytes on the device for the photos, and for what tells their rays.
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
        budget: float = math.inf,
    ) -> None:
        self.views = [scene.views[i] for i in indices]
        self.device = device
        lookup = np.full(65536, VOID, np.uint8)
        for index, class_id in enumerate(class_ids):
            lookup[class_id] = index
        self.cameras = [view.camera.resized(*training_size(view.camera, longest)) for view in self.views]
        first = np.cumsum([0, *(camera.width * camera.height for camera in self.cameras)])
        total = int(first[-1])
        has_confidence = any(view.confidence is not None for view in self.views)
        cut = scene.mask_mode == "empty" and any(view.mask is not None for view in self.views)
        rgba, labels = torch.empty(total, 4, dtype=torch.uint8), torch.empty(total, dtype=torch.uint8)
        confidences = torch.empty(total if has_confidence else 0, dtype=torch.uint8)
        keep, left_open = torch.ones(total, dtype=torch.bool), torch.zeros(total if cut else 0, dtype=torch.bool)
        for number, (view, camera) in enumerate(zip(self.views, self.cameras)):
            report.progress(number / len(self.views), view.name)
            width, height, pixels = camera.width, camera.height, slice(int(first[number]), int(first[number + 1]))
            photo = resized(photo_of(view), width, height)
            label = VOID if view.label is None else _flat(lookup[nearest(read_label(view.label), width, height)])
            labels[pixels] = label
            if view.confidence is not None:
                confidences[pixels] = _flat(nearest(read_image(view.confidence)[..., 0], width, height))
            elif has_confidence:
                confidences[pixels] = 255
            if view.mask is not None:
                mask = nearest(read_image(view.mask)[..., 0], width, height)
                inside = mask > 127
                if cut:
                    photo = cut_out(photo, inside)
                    left_open[pixels] = _flat(mask == MASK_UNKNOWN)
                else:
                    keep[pixels] = _flat(inside)
            rgba[pixels] = _flat(with_alpha(photo).pixels).reshape(-1, 4)
        size = len(keep) * (5 + has_confidence + bool(left_open.any()) + (0 if bool(keep.all()) else 8))
        self.home = home_of(size, budget, device)
        left = budget - size if size <= budget else budget
        self.rgba = self._keep(rgba)
        self.label = self._keep(labels)
        self.confidence = self._keep(confidences) if has_confidence else None
        self.unknown = self._keep(left_open) if bool(left_open.any()) else None
        self.first = torch.from_numpy(first.astype(np.int64)).to(device)
        self.rays = CameraRays(self.cameras, box_poses(self.views, box_from_world), device, left)
        for number in range(len(self.rays.distinct)):
            report.check()
            sees = ~self.rays.lens_directions(number)[:, 0].isnan().cpu()
            for view in (self.rays.number == number).nonzero()[:, 0].tolist() if not bool(sees.all()) else []:
                keep[int(self.first[view]) : int(self.first[view + 1])] &= sees
        self.usable = None if bool(keep.all()) else self._keep(keep.nonzero()[:, 0])

    def _keep(self, values: torch.Tensor) -> torch.Tensor:
        """Values of pixels where they stay: on the device, or in memory that it copies from quickly."""
        return values.to(self.home) if self.home == self.device or self.device.type != "cuda" else values.pin_memory()

    def at(self, values: torch.Tensor, pixel_indices: torch.Tensor) -> torch.Tensor:
        """`values` that are at `home`, at `pixel_indices` (N,) int64 on the device: on the device."""
        return values[pixel_indices.to(values.device)].to(pixel_indices.device)

    def __len__(self) -> int:
        return len(self.rgba)

    def batch(self, pixel_indices: torch.Tensor) -> Batch:
        """Rays and values of pixels at flat indices (R,) int64."""
        image = torch.bucketize(pixel_indices, self.first[1:], right=True)
        pixel = pixel_indices - self.first[image]
        origins, directions = self.rays(image, pixel)
        home_indices = pixel_indices.to(self.home)  # once: the host waits for it where the photos are there

        def read(values: torch.Tensor) -> torch.Tensor:
            return values[home_indices].to(self.device)

        value = read(self.rgba).float() / 255
        confidences = torch.ones_like(value[:, 3]) if self.confidence is None else read(self.confidence).float() / 255
        rgb, alpha, label = value[:, :3], value[:, 3], read(self.label).long()
        unknown, ones = None if self.unknown is None else read(self.unknown), torch.ones_like(confidences)
        return Batch(origins, directions, rgb, alpha, label, image, pixel, confidences, ones, unknown)

    def labelled_share(self) -> float:
        """Share of the usable pixels with something in them that have a label; 1 where there are no labels at all."""
        usable = slice(None) if self.usable is None else self.usable
        opaque = self.rgba[usable, 3] > 127
        labelled = (self.label[usable] != VOID) & opaque
        return float(labelled.sum() / opaque.sum().clamp(min=1)) or 1.0

    def random_pixels(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """`count` flat indices of usable pixels, with repetition."""
        total = len(self) if self.usable is None else len(self.usable)
        chosen = torch.randint(0, total, (count,), device=self.device, generator=generator)
        return chosen if self.usable is None else self.at(self.usable, chosen)
