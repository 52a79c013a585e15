"""ONNX models that users bring: loaded for the CPU, their inputs and outputs found by name, rank and shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError

KINDS = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(bool)": np.bool_,
    "tensor(uint8)": np.uint8,
}
MEAN, DEVIATION = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])  # ImageNet's, of sRGB in [0, 1]
KEPT = 3  # models in memory


@dataclass(frozen=True)
class Port:
    """An input or output: its name, its sizes (None: any), what it holds."""

    name: str
    shape: tuple[int | None, ...]
    kind: str

    def __str__(self) -> str:
        sizes = "×".join("?" if size is None else str(size) for size in self.shape)
        return f"{self.name} {sizes or 'scalar'}"

    def array(self, values: Any) -> np.ndarray:
        """Values in the kind of the port."""
        return np.asarray(values).astype(KINDS[self.kind])


@dataclass(frozen=True)
class Wanted:
    """A port that a model of some kind has: names that exporters give it, and numbers of dimensions; channels: size of the
    second dimension where that is known."""

    names: tuple[str, ...]
    ranks: tuple[int, ...]
    channels: int | None = None

    def __str__(self) -> str:
        ranks = " or ".join(str(rank) for rank in self.ranks)
        return f"{' / '.join(self.names)} of {ranks} dimensions"

    def fits(self, port: Port) -> bool:
        known = port.shape[1] if len(port.shape) > 1 else None
        return len(port.shape) in self.ranks and (None in (self.channels, known) or self.channels == known)


class Model:
    """A loaded ONNX file."""

    def __init__(self, path: Path) -> None:
        """Raises InputError where it is no ONNX file that can be run here."""
        self.path = path
        import onnxruntime  # only who brings a model waits for it

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        try:
            self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            first = _first_line(error)
            raise InputError(
                f"{path} is no ONNX model that can be run: {first}.", "Export the model once more."
            ) from error
        self.inputs = [_port(entry) for entry in self.session.get_inputs()]
        self.outputs = [_port(entry) for entry in self.session.get_outputs()]

    def has_input(self, name: str) -> bool:
        return any(port.name == name for port in self.inputs)

    def bind(self, what: str, wanted: Sequence[Wanted], outputs: bool = False, also: Sequence[str] = ()) -> list[Port]:
        """The port of each wanted one: by name, else the only one left that fits by rank and channels.

        Args:
            also: inputs that there may be.
        Raises:
            InputError: a port is missing or of another shape, or there are inputs more. It names what was expected and
            what was found.
        """
        ports = self.outputs if outputs else self.inputs
        found: list[Port | None] = [next((p for p in ports if p.name in w.names), None) for w in wanted]
        for number, (port, want) in enumerate(zip(found, wanted)):
            if port is None:
                left = [p for p in ports if p not in found and want.fits(p)]
                found[number] = left[0] if len(left) == 1 else None
        bound = [port for port, want in zip(found, wanted) if port is not None and want.fits(port)]
        more = [] if outputs else [port for port in ports if port not in bound and port.name not in also]
        if len(bound) < len(wanted) or more:
            side = "outputs" if outputs else "inputs"
            raise InputError(
                f"{self.path.name} is not {what}: expected {side} are {'; '.join(str(w) for w in wanted)}; found "
                f"{'; '.join(str(p) for p in ports) or 'none'}.",
                "Choose another file, or export the model with these names.",
            )
        return bound

    def run(self, values: dict[str, np.ndarray], outputs: Sequence[str] | None = None) -> list[np.ndarray]:
        """Outputs of the model. Raises InputError where it cannot be run with these."""
        try:
            return [np.asarray(value) for value in self.session.run(list(outputs) if outputs else None, values)]
        except Exception as error:
            given = "; ".join(f"{name} {'×'.join(map(str, value.shape))}" for name, value in values.items())
            first = str(error).strip().splitlines()[0]
            raise InputError(
                f"{self.path.name} failed with {given}: {first}.", "Export the model once more."
            ) from error


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__).rstrip(".")


def _port(entry: Any) -> Port:
    shape = tuple(size if isinstance(size, int) and size > 0 else None for size in entry.shape)
    return Port(entry.name, shape, entry.type)


def load(path: Path) -> Model:
    """The model in a file; it stays loaded as long as the file is the same. Raises InputError."""
    path = Path(path)
    try:
        stat = path.stat()
    except OSError as error:
        raise InputError(f"There is no model at {path}.", "Choose an .onnx file.") from error
    return _loaded(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(KEPT)
def _loaded(path: Path, changed: int, size: int) -> Model:
    return Model(path)


def normalised(photo: np.ndarray) -> np.ndarray:
    """A photo (H, W, 3) uint8 as networks take it: (3, H, W), of mean 0 and deviation 1."""
    return ((photo / 255 - MEAN) / DEVIATION).transpose(2, 0, 1)
