"""Features of photos by a model such as DINOv2 that the user brings: one vector for each patch of a picture."""

from __future__ import annotations

import math

import numpy as np
from PIL import Image

from ..errors import InputError
from .models import Model, Wanted, normalised

SIDE = 518  # longest side of pictures where the model takes any size: what DINOv2 was trained with
PATCHES = (14, 16, 8, 32)  # sides of patches, the usual first
MOST_OTHERS = 16  # class and register tokens
KIND = "a model of features such as DINOv2"
IMAGE = Wanted(("pixel_values", "input", "image", "images", "x"), (4,), 3)
TOKENS = Wanted(
    ("last_hidden_state", "x_norm_patchtokens", "patch_tokens", "tokens", "features", "feature_map", "output"), (3, 4)
)


class TokenModel:
    """A model from pictures (1, 3, h, w) to tokens (1, T, C), of which the last h·w / patch² are those of the patches, row by
    row, after class and register tokens; or to a map (1, C, h / patch, w / patch)."""

    def __init__(self, model: Model) -> None:
        """Raises InputError where it is of another kind."""
        self.model = model
        (self.input,) = model.bind(KIND, [IMAGE])
        (self.output,) = model.bind(KIND, [TOKENS], outputs=True)

    def features(self, photo: np.ndarray) -> np.ndarray:
        """Features (h, w, C) float32 of the patches of a photo (H, W, 3) uint8.

        Raises:
            InputError: the model's tokens are of no known patches.
        """
        for patch in PATCHES:
            height, width = self._size(photo, patch)
            small = Image.fromarray(photo).resize((width, height), Image.Resampling.BICUBIC)
            values = normalised(np.asarray(small))[None]
            try:
                (found,) = self.model.run({self.input.name: self.input.array(values)}, [self.output.name])
            except InputError:
                if patch == PATCHES[-1]:
                    raise
                continue  # the model refuses sides that are no multiple of its patches
            rows, columns = height // patch, width // patch
            if found.ndim == 4 and found.shape[2:] == (rows, columns):
                return found[0].transpose(1, 2, 0).astype(np.float32)
            before = found.shape[1] - rows * columns if found.ndim == 3 else -1
            if 0 <= before <= MOST_OTHERS:
                return found[0, before:].reshape(rows, columns, -1).astype(np.float32)
        raise InputError(
            f"{self.model.path.name} is not {KIND}: its output {self.output.name} has no token for each patch of "
            f"{', '.join(map(str, sorted(PATCHES)))} pixels.",
            "Export the model once more, with the tokens of its last layer.",
        )

    def _size(self, photo: np.ndarray, patch: int) -> tuple[int, int]:
        """Height and width at which the model sees a photo: its own, or as large as the usual, in whole patches."""
        scale = SIDE / max(photo.shape[:2])
        sides = (fixed or math.ceil(n * scale / patch) * patch for fixed, n in zip(self.input.shape[2:], photo.shape))
        height, width = (max(patch, side) for side in sides)
        return height, width
