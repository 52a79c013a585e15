"""When a model is rendered by the fused kernel, and how its field is packed for it."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cache

import torch

from ..field.environment import EnvironmentRays
from ..field.hybrid import HybridField
from ..field.mlp import MLP
from ..kernels.device import backend_of
from ..kernels.fused import MOST_CLASSES, CoarseRays, FusedField, FusedRays, coarse_march, render_coarse
from ..kernels.fused_network import GAP, padded
from ..kernels.fused_shape import FusedShape
from ..kernels.runtime import small_tensor
from .model import Model, Rendered

log = logging.getLogger("fieldwork")
OLDEST = (7, 5)  # GPUs that multiply halves as the kernel does
# Not tuned.
LEAST_RAYS = 1 << 17  # of a picture that "auto" renders fused: previews are not worth seconds of compilation


def _capability(device: torch.device) -> tuple[int, int] | None:
    """The compute capability of a CUDA device."""
    return torch.cuda.get_device_capability(device) if device.type == "cuda" else None


def unsupported(model: Model) -> str | None:
    """Why the fused kernel cannot render this model; None when it can."""
    field = model.field
    if not backend_of(model.priorities.device).warp:
        return "the torch backend has no such kernel"
    if not isinstance(field, HybridField):
        return f"the field is a {type(field).__name__}"
    capability = _capability(model.priorities.device)
    if capability is not None and capability < OLDEST:
        return "the GPU is of compute capability {}.{}, below {}.{}".format(*capability, *OLDEST)
    c = field.config
    if c.branch == "implicit":
        return "field.branch is “implicit”"
    if c.width % 16 or c.width > 64:
        return f"field.width is {c.width}, not 16, 32, 48 or 64"
    if c.levels > 16:
        return f"field.levels is {c.levels}, more than 16"
    if c.octaves > 10:
        return f"field.octaves is {c.octaves}, more than 10"
    if c.geometry_features > 31:
        return f"field.geometry_features is {c.geometry_features}, more than 31"
    if c.appearance > 16:
        return f"field.appearance is {c.appearance}, more than 16"
    if c.branch == "hybrid" and c.implicit_layers != 2:
        return f"field.implicit_layers is {c.implicit_layers}, not 2"
    if c.color_layers not in (2, 3):
        return f"field.color_layers is {c.color_layers}, not 2 or 3"
    if field.classes and c.semantic_layers != 2:
        return f"field.semantic_layers is {c.semantic_layers}, not 2"
    if field.classes > MOST_CLASSES:
        return f"there are {field.classes} classes, more than {MOST_CLASSES}"
    return None


def wants_fused(model: Model, rays: int) -> bool:
    """Whether to render `rays` rays with the fused kernel: `render.fused` is on, or auto on CUDA for a picture large
    enough to be worth its compilation; and the model is one it supports."""
    wanted, backend = model.config.render.fused, backend_of(model.priorities.device)
    if wanted == "off" or (wanted == "auto" and (not backend.fused or rays < LEAST_RAYS)):
        return False
    reason = unsupported(model)
    if reason is not None:
        _log_once(f"Rendering without the fused kernel: {reason}.")
    return reason is None


@cache
def _log_once(message: str) -> None:
    log.warning(message)


def shape_of(field: HybridField, semantics: bool, logits: bool) -> FusedShape:
    """The kernel a field needs."""
    c = field.config
    return FusedShape(
        levels=c.levels,
        octaves=c.octaves if field.implicit is not None else 0,
        concat=field.concat,
        width=c.width,
        geometry=1 + c.geometry_features,
        color_layers=c.color_layers,
        appearance=c.appearance,
        classes=padded(field.classes) if semantics else 0,
        logits=logits and semantics,
    )


def _spread(matrix: torch.Tensor, parts: list[tuple[int, int]], columns: int) -> torch.Tensor:
    """A first layer (out, in) with its inputs moved: each (width, padded width) part keeps its order and gets zero
    columns behind it; the whole is `columns` wide."""
    pieces, begin = [], 0
    for width, padded_width in parts:
        pieces.append(torch.nn.functional.pad(matrix[:, begin : begin + width], (0, padded_width - width)))
        begin += width
    joined = torch.cat(pieces, 1)
    return torch.nn.functional.pad(joined, (0, columns - joined.shape[1]))


def _flat(network: MLP, first: list[tuple[int, int]], sizes: tuple[int, ...]) -> list[torch.Tensor]:
    """The weights of a network's layers, padded to `sizes`, row by row with a gap behind each, float16."""
    layers = []
    for index, weight in enumerate(network.weights):
        value = weight.detach().float()
        value = _spread(value, first if index == 0 else [(value.shape[1], value.shape[1])], sizes[index])
        layers.append(torch.nn.functional.pad(value, (0, GAP, 0, sizes[index + 1] - len(value))).half().flatten())
    return layers


@torch.no_grad()
def pack(field: HybridField, semantics: bool = True, logits: bool = False) -> FusedField:
    """A field's present state as the fused kernel reads it, in half precision (31 MB for the standard preset)."""
    assert field.grid is not None
    c, device = field.config, field.grid.table.device
    semantics = semantics and field.semantic_head is not None
    shape = shape_of(field, semantics, logits)
    geometry = shape.geometry
    explicit = [(field.features, shape.features)]
    firsts = {
        "implicit": [(3 + 6 * c.octaves, shape.implicit[0])],
        "density": explicit * (2 if shape.concat else 1),
        "color": [(geometry + 16 + c.appearance, shape.color[0])],
        "semantic": [(geometry, padded(geometry)), *explicit * (2 if shape.octaves else 1)],
    }
    networks = {
        "implicit": field.implicit,
        "density": field.density_head,
        "color": field.color_head,
        "semantic": field.semantic_head,
    }
    weights: list[torch.Tensor] = []
    for name, sizes in shape.networks().items():
        network = networks[name]
        assert network is not None
        weights += _flat(network, firsts[name], sizes)
    code = torch.zeros(max(c.appearance, 1), device=device)
    if field.appearance is not None:
        code = field.appearance.detach().mean(0).float().contiguous()
    blend = field.blend if field.blend is not None and not field.blend.warming_up else None
    evidence = blend.evidence if blend is not None else torch.zeros(1, device=device)
    return FusedField(
        shape=shape,
        table=field.grid.table.half(),
        layout=small_tensor(field.grid.levels, torch.int32, device),
        gains=small_tensor(field.gains, torch.float32, device),
        weights=torch.cat(weights),
        code=code,
        evidence=evidence,
        evidence_side=round(len(evidence) ** (1 / 3)) if blend is not None else 0,
        blend_floor=blend.floor if blend is not None else 1.0,
        blend_rate=blend.rate if blend is not None else 0.0,
        density_shift=c.density_shift,
        thinning=field.thinning,
        class_count=field.classes if semantics else 0,
    )


@dataclass(frozen=True)
class FusedRendered(FusedRays):
    """The same with what is behind the field, which the kernel does not know of."""

    environment: EnvironmentRays | None


class FusedRenderer:
    """A model packed for one picture or more; stale as soon as the model is trained further."""

    rays = 1 << 20  # rendered at once

    def __init__(self, model: Model, semantics: bool = True) -> None:
        self.model, self.config, self.grid = model, model.config, model.render_grid()
        self.semantics = semantics
        self.field = pack(model.field, semantics, self.config.render.accumulate == "logits")

    def coarse(self, origins: torch.Tensor, directions: torch.Tensor) -> CoarseRays:
        """The coarse march of rays (R, 3), on the grid alone."""
        g = self.grid
        return coarse_march(origins, directions, g.cells, g.skip_distance, g.settings)

    def fine(self, rays: CoarseRays, count: int) -> FusedRendered:
        """Samples, field and compositing of rays after their coarse march."""
        g = self.grid
        out = render_coarse(self.field, rays, g.cells, g.skip_distance, g.settings, count, self.config.render.cull)
        if out.probabilities is not None and self.config.render.accumulate == "logits":
            # Summed logits become probabilities of the ray once it is complete.
            out = replace(out, probabilities=torch.softmax(out.probabilities, 1) * out.opacity[:, None])
        field, environment, behind = self.model.field, self.model.environment, None
        if environment is not None:
            cull = self.config.render.cull
            behind = environment.visible_rays(field, rays.directions, out.opacity, cull, self.semantics)
        return FusedRendered(**vars(out), environment=behind)

    def __call__(self, origins: torch.Tensor, directions: torch.Tensor, samples_per_ray: int) -> FusedRendered:
        """Render rays (R, 3) of the normalised frame with at most `samples_per_ray` samples where they meet something."""
        return self.fine(self.coarse(origins, directions), samples_per_ray)


class UnfusedRenderer:
    """The same for any model, in separate kernels."""

    rays = 1 << 15

    def __init__(self, model: Model, semantics: bool = True) -> None:
        self.model, self.semantics, self.grid = model, semantics, model.render_grid()

    def __call__(self, origins: torch.Tensor, directions: torch.Tensor, samples_per_ray: int) -> Rendered:
        return self.model.render(origins, directions, samples_per_ray, semantics=self.semantics, grid=self.grid)


def ray_renderer(model: Model, rays: int, semantics: bool = True) -> FusedRenderer | UnfusedRenderer:
    """What renders a picture of `rays` rays: called with (origins, directions, samples_per_ray) it gives color,
    opacity, depth, probabilities and environment of up to its `rays` rays at once."""
    return FusedRenderer(model, semantics) if wants_fused(model, rays) else UnfusedRenderer(model, semantics)
