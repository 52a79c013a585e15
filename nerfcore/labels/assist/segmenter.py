"""Things cut out by clicks and boxes: SAM and MobileSAM, SAM 2 (names of two exporters) and EfficientSAM.

Each has an encoder, run once for a photo, and a decoder, run for each click. Points are pixels of the photo.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ..models import Model, Wanted, load, normalised

SIDE = 1024  # pixels of the encoders' frame where the model does not say
LOW = 256  # side of the masks that decoders take
OUTSIDE, INSIDE, UPPER_LEFT, LOWER_RIGHT, PAD = 0, 1, 2, 3, -1  # what points mean
IGNORED = -10  # a point that the decoders of Hugging Face leave out


@dataclass(frozen=True)
class Prompt:
    """What is asked for: points (N, 2) inside and (M, 2) outside of the thing, and a box of left, top, right, bottom."""

    inside: list[tuple[float, float]]
    outside: list[tuple[float, float]]
    box: tuple[float, float, float, float] | None = None

    def points(self, with_box: bool = True, pad: int = PAD) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 2) and what each means (N,); at least one."""
        points = [*self.inside, *self.outside]
        labels = [INSIDE] * len(self.inside) + [OUTSIDE] * len(self.outside)
        if self.box is not None and with_box:
            points += [self.box[:2], self.box[2:]]
            labels += [UPPER_LEFT, LOWER_RIGHT]
        elif self.box is None or not points:
            points, labels = [*points, (0.0, 0.0)], [*labels, pad]
        return np.array(points, np.float64).reshape(-1, 2), np.array(labels)


class Segmenter:
    """SAM and MobileSAM: photos in a square frame by their longer side, padded at the right and below."""

    name = "a SAM model"
    decoder_inputs = (
        Wanted(("image_embeddings", "image_embed"), (4,)),
        Wanted(("point_coords",), (3,)),
        Wanted(("point_labels",), (2,)),
        Wanted(("mask_input",), (4,), 1),
        Wanted(("has_mask_input",), (1,)),
        Wanted(("orig_im_size",), (1,)),
    )
    also: tuple[str, ...] = ()  # inputs that some decoders have
    encoder_outputs = (Wanted(("image_embeddings", "image_embed", "embeddings"), (4,)),)
    image = Wanted(("image", "input_image", "images", "x", "input"), (3, 4))
    masks = Wanted(("masks", "low_res_masks"), (4,))
    scores = Wanted(("iou_predictions",), (2,))

    def __init__(self, encoder: Model, decoder: Model) -> None:
        """Raises InputError where a model is of another kind."""
        self.encoder, self.decoder = encoder, decoder
        (self.input,) = encoder.bind(f"the encoder of {self.name}", [self.image])
        self.embeddings = encoder.bind(f"the encoder of {self.name}", self.encoder_outputs, outputs=True)
        self.prompts = decoder.bind(f"the decoder of {self.name}", self.decoder_inputs, also=self.also)
        self.results = decoder.bind(f"the decoder of {self.name}", [self.masks, self.scores], outputs=True)
        self.side = next((size for size in self.input.shape[-2:] if size and size > 3), SIDE)

    def encode(self, photo: np.ndarray) -> list[np.ndarray]:
        """What the decoder needs of a photo (H, W, 3) uint8."""
        return self.encoder.run(
            {self.input.name: self.input.array(self.frame(photo))}, [p.name for p in self.embeddings]
        )

    def frame(self, photo: np.ndarray) -> np.ndarray:
        """The photo as the encoder takes it: raw (h, w, 3), or normalised and padded (1, 3, side, side)."""
        height, width = photo.shape[:2]
        scale = self.side / max(height, width)
        small = resized(photo, max(1, round(width * scale)), max(1, round(height * scale)))
        if len(self.input.shape) == 3:
            return small
        padded = np.zeros((3, self.side, self.side))
        padded[:, : small.shape[0], : small.shape[1]] = normalised(small)
        return padded[None]

    def cut(self, embeddings: list[np.ndarray], size: tuple[int, int], prompt: Prompt) -> tuple[np.ndarray, float]:
        """The mask (H, W) bool of what was asked for in a photo of width and height, and how good it is said to be."""
        values = dict(zip((p.name for p in self.prompts), self.decoder_values(embeddings, size, prompt)))
        given = {port.name: port.array(values[port.name]) for port in self.prompts}
        masks, scores = self.decoder.run(given, [port.name for port in self.results])
        best = int(scores.reshape(-1).argmax())
        logits = masks.reshape(-1, *masks.shape[-2:])[best].astype(np.float32)
        return self.to_photo(logits, size) > 0, float(scores.reshape(-1)[best])

    def decoder_values(self, embeddings: list[np.ndarray], size: tuple[int, int], prompt: Prompt) -> list[np.ndarray]:
        points, labels = prompt.points()
        scale = self.side / max(size)
        empty = np.zeros((1, 1, LOW, LOW))
        original = np.array([size[1], size[0]])
        return [embeddings[0], (points * scale)[None], labels[None], empty, np.zeros(1), original]

    def to_photo(self, logits: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Logits (h, w) at the size of the photo; those of the square frame lose its padding."""
        width, height = size
        if logits.shape == (height, width):
            return logits
        scale = max(logits.shape) / max(size)
        part = logits[: max(1, round(height * scale)), : max(1, round(width * scale))]
        return resized(part, width, height)


class Sam2(Segmenter):
    """SAM 2 as most exporters name it: the photo fills the square frame."""

    name = "a SAM 2 model"
    decoder_inputs = (
        Wanted(("image_embed", "image_embeddings"), (4,)),
        Wanted(("high_res_feats_0",), (4,)),
        Wanted(("high_res_feats_1",), (4,)),
        Wanted(("point_coords",), (3,)),
        Wanted(("point_labels",), (2,)),
        Wanted(("mask_input",), (4,), 1),
        Wanted(("has_mask_input",), (1,)),
    )
    also = ("orig_im_size",)
    encoder_outputs = (
        Wanted(("image_embed", "image_embeddings"), (4,)),
        Wanted(("high_res_feats_0",), (4,)),
        Wanted(("high_res_feats_1",), (4,)),
    )

    def __init__(self, encoder: Model, decoder: Model) -> None:
        super().__init__(encoder, decoder)
        self.original = next((port for port in decoder.inputs if port.name == "orig_im_size"), None)
        if self.original is not None:
            self.prompts = [*self.prompts, self.original]

    def frame(self, photo: np.ndarray) -> np.ndarray:
        return normalised(resized(photo, self.side, self.side))[None]

    def scaled(self, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        return points * self.side / np.array(size)

    def decoder_values(self, embeddings: list[np.ndarray], size: tuple[int, int], prompt: Prompt) -> list[np.ndarray]:
        points, labels = prompt.points()
        places = self.scaled(points, size)[None]
        values = [*embeddings, places, labels[None], np.zeros((1, 1, LOW, LOW)), np.zeros(1)]
        return values if self.original is None else [*values, np.array([size[1], size[0]])]

    def to_photo(self, logits: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        return resized(logits, *size)


class HuggingSam2(Sam2):
    """SAM 2 as Hugging Face's tools export it: boxes by themselves, an object dimension more."""

    decoder_inputs = (
        *(Wanted((f"image_embeddings.{number}",), (4,)) for number in range(3)),
        Wanted(("input_points",), (4,)),
        Wanted(("input_labels",), (3,)),
        Wanted(("input_boxes",), (3,)),
    )
    encoder_outputs = tuple(Wanted((f"image_embeddings.{number}",), (4,)) for number in range(3))
    image = Wanted(("pixel_values",), (4,))
    masks = Wanted(("pred_masks",), (5,))
    scores = Wanted(("iou_scores",), (3,))

    def decoder_values(self, embeddings: list[np.ndarray], size: tuple[int, int], prompt: Prompt) -> list[np.ndarray]:
        points, labels = prompt.points(with_box=False, pad=IGNORED)
        corners = np.array([] if prompt.box is None else prompt.box, np.float64).reshape(-1, 2)
        boxes = self.scaled(corners, size).reshape(1, -1, 4)
        return [*embeddings, self.scaled(points, size)[None, None], labels[None, None], boxes]


class EfficientSam(Segmenter):
    """EfficientSAM: photos as they are, colours in [0, 1], points in pixels of the photo."""

    name = "an EfficientSAM model"
    decoder_inputs = (
        Wanted(("image_embeddings",), (4,)),
        Wanted(("batched_point_coords",), (4,)),
        Wanted(("batched_point_labels",), (3,)),
        Wanted(("orig_im_size",), (1,)),
    )
    image = Wanted(("batched_images",), (4,))
    masks = Wanted(("output_masks",), (5,))
    scores = Wanted(("iou_predictions",), (3,))

    def frame(self, photo: np.ndarray) -> np.ndarray:
        return photo.transpose(2, 0, 1)[None] / 255

    def decoder_values(self, embeddings: list[np.ndarray], size: tuple[int, int], prompt: Prompt) -> list[np.ndarray]:
        points, labels = prompt.points()
        return [embeddings[0], points[None, None], labels[None, None], np.array([size[1], size[0]])]


def segmenter(encoder: Path, decoder: Path) -> Segmenter:
    """The models in two files, of the kind that the decoder's inputs tell. Raises InputError."""
    model = load(decoder)
    kinds = {"batched_point_coords": EfficientSam, "high_res_feats_0": Sam2, "image_embeddings.0": HuggingSam2}
    kind = next((kind for name, kind in kinds.items() if model.has_input(name)), Segmenter)
    return kind(load(encoder), model)


def resized(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """A picture (H, W, 3) uint8, or values (H, W) float32, at another size, between the pixels."""
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BILINEAR))
