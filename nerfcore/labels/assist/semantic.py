"""A first guess of the classes of photos by a model such as SegFormer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import scipy
from PIL import Image

from ...errors import InputError
from ..models import Model, Wanted, normalised
from .segmenter import resized

SIDE, STEP = 512, 32  # shorter side of the pictures where the model does not say, and what sides are a multiple of
IMAGE = Wanted(("pixel_values", "input", "image", "images", "x"), (4,), 3)
LOGITS = Wanted(("logits", "output", "out"), (4,))


class Semantic:
    """A model from pictures to logits (1, classes, h, w)."""

    def __init__(self, model: Model) -> None:
        """Raises InputError where it is of another kind."""
        self.model = model
        (self.input,) = model.bind("a model of classes such as SegFormer", [IMAGE])
        (self.output,) = model.bind("a model of classes such as SegFormer", [LOGITS], outputs=True)

    def probabilities(self, photo: np.ndarray) -> np.ndarray:
        """Probabilities (C, h, w) of the model's classes for a photo (H, W, 3) uint8, as fine as the model has them."""
        height, width = photo.shape[:2]
        scale = SIDE / min(height, width)
        size = [
            fixed or max(STEP, round(n * scale / STEP) * STEP)
            for fixed, n in zip(self.input.shape[2:], (height, width))
        ]
        values = normalised(resized(photo, size[1], size[0]))[None]
        (logits,) = self.model.run({self.input.name: self.input.array(values)}, [self.output.name])
        return scipy.special.softmax(logits[0].astype(np.float32), axis=0)


def read_mapping(path: Path, names: list[str]) -> dict[int, str]:
    """What the model's classes are called here: {"3": "wall", …} by their numbers; several may be one class.

    Raises:
        InputError: the file cannot be read, is of another form, or names a class that the project lacks.
    """
    hint = 'Write {"0": "wall", "3": "floor"}: the number of a class of the model, and the class of the project.'
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8-sig"))
        mapping = {int(number): str(name) for number, name in value.items()}
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.", hint) from error
    except (ValueError, AttributeError) as error:
        raise InputError(f"{path} has another form ({error}).", hint) from error
    strange = [name for name in mapping.values() if name not in names]
    if strange or not mapping:
        what = f"names the class “{strange[0]}”, which the project has not" if strange else "names no class"
        raise InputError(f"{path} {what}.", f"The classes are {', '.join(names) or 'none'}.")
    return mapping


def guessed(
    probabilities: np.ndarray, mapping: dict[int, int], size: tuple[int, int], least: float, void: int, path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Class ids (H, W) uint16 and how sure they are (H, W) float32 for a photo of width and height.

    Args:
        probabilities: (C, h, w). mapping: class id by the model's number. least: probability below which it stays `void`.
    Raises:
        InputError: the mapping of `path` has a class that the model lacks.
    """
    if max(mapping) >= len(probabilities):
        raise InputError(
            f"{path} names class {max(mapping)}; the model has {len(probabilities)}.", "They are counted from 0."
        )
    ids = sorted(set(mapping.values()))
    together = np.zeros((len(ids), size[1], size[0]), np.float32)
    for number, class_id in mapping.items():
        layer = Image.fromarray(probabilities[number]).resize(size, Image.Resampling.BILINEAR)
        together[ids.index(class_id)] += np.asarray(layer)
    sure = together.max(0)
    return np.where(sure >= least, np.array(ids)[together.argmax(0)], void).astype(np.uint16), sure.clip(0, 1)
