"""A shot's pixels: samples of every pixel, gathered into the passes of Blender."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from ..kernels.raycast import FirstHits
from ..kernels.runtime import run_parallel
from ..progress import Reporter
from ..render.sparse_rays import sparse_pixels, stride_of
from .cryptomatte import Coverage, id_of, manifest
from .fields import FAR, FieldStore, PlacedField, light_left
from .instances import InstanceNames
from .lens_rays import axis_cosine, scene_rays
from .shot import CRYPTOMATTES, FieldItem, Shot

EMPTY_DEPTH = 1e10  # as Blender has it
TILE = 1 << 13  # rays at once on the CPU
GPU_TILE = 1 << 17
# Steps of a low-discrepancy sequence in two and three dimensions (Roberts, 2018): powers of 1 / the generalised golden ratio.
PLASTIC = 1.32471795724474602596
STEPS2 = (1 / PLASTIC, 1 / PLASTIC**2)
STEPS3 = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)


@dataclass(frozen=True)
class Exposure:
    """A rendered shot: its passes by name, (H, W, channels) float32, bottom row first as Blender has them; the manifests of
    its Cryptomattes by name, and the revision of the marks that the classes of a field are from by its name, of those that are
    from any."""

    passes: dict[str, np.ndarray]
    manifests: dict[str, str]
    label_revisions: dict[str, int]


class Seen:
    """What one sample of N pixels shows, numpy: color (N, 4) linear with associated alpha (with what is behind, where that
    is shown); opacity, distance (N,) of the fields alone; origins, directions (N, 3); item (N,) number of the field in the
    shot, −1 for none; best (N,) its class index, −1 for void; share (N,) the probability; hit (N,) bool: an object is
    met; held (N,) bool: it is a holdout; behind (N, 4): what is behind another one; times (N,) while the shutter is open."""

    def __init__(self, parts: list[dict[str, torch.Tensor]]) -> None:
        for name in parts[0]:
            setattr(self, name, torch.cat([part[name] for part in parts]).cpu().numpy())

    color: np.ndarray
    opacity: np.ndarray
    distance: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    item: np.ndarray
    best: np.ndarray
    share: np.ndarray
    hit: np.ndarray
    held: np.ndarray
    behind: np.ndarray
    times: np.ndarray


def expose(
    shot: Shot, store: FieldStore, report: Reporter, show: Callable[[np.ndarray], None] | None = None
) -> Exposure:
    """Render a shot.

    Args:
        show: is given the colours (H, W, 4) so far, bottom row first, after every sample but the last.
    Raises:
        ProjectError: a field cannot be read. Cancelled.
    """
    report.stage("Preparing")
    store.expect(shot.fields)
    fields = [_placed(shot, item, store, report) for item in shot.fields]
    film = _Film(shot, fields)
    report.stage("Rendering")
    samples = list(_samples(shot))
    with torch.no_grad():
        for number, (offset, chance, counts) in enumerate(samples):
            begin = number / len(samples)
            film.add(film.look(offset, chance, report, begin, 1 / len(samples)), counts)
            if show is not None and number + 1 < len(samples):
                show(film.combined())
    revisions = {f.item.name: f.field.label_revision for f in fields if f.field.label_revision is not None}
    return Exposure(film.passes(), film.manifests(), revisions)


def _placed(shot: Shot, item: FieldItem, store: FieldStore, report: Reporter) -> PlacedField:
    """A field of the shot, read as finely as the shot is worth where its rays meet it. Raises ProjectError."""
    x0, y0, x1, y1 = shot.border
    width, height = shot.size
    placed = PlacedField(store.field(item, report), item, width * height)
    pixels = (x1 - x0) * (y1 - y0)
    corner = torch.tensor([x0, y0], device=placed.device)
    place = sparse_pixels(x1 - x0, y1 - y0, stride_of(pixels), placed.device) + corner + 0.5
    placed.refine(*scene_rays(shot.lens, place), pixels * shot.samples, report.check)
    return placed


def _samples(shot: Shot) -> Iterator[tuple[tuple[float, float], int | None, str]]:
    """(place in the pixel, number of the chance or None, what it counts for) of all samples of a pixel.

    Geometry is that of the middle of the pixel and of the lens, as Cycles' is of one sample.
    """
    blurred = shot.blurred
    if blurred:
        yield (0.5, 0.5), None, "geometry"
    for number in range(shot.samples):
        x, y = (in_filter((0.5 + number * step) % 1, shot.filter_width) for step in STEPS2)
        first = number == 0 and not blurred
        yield (x, y), (number if blurred else None), "both" if first else "color"


def in_filter(chance: float, width: float) -> float:
    """Where in a pixel a sample goes, for an even chance in [0, 1): below 0 or above 1 it is in a neighbour."""
    if width <= 0:
        return chance
    # The integral of the Blackman-Harris window (Harris, 1978).
    x = np.linspace(0, 1, 257)
    terms = zip((1, 2, 3), (-0.48829, 0.14128, -0.01168))
    total = 0.35875 * x + sum(weight * np.sin(2 * np.pi * n * x) / (2 * np.pi * n) for n, weight in terms)
    return 0.5 + (float(np.interp(chance, total / total[-1], x)) - 0.5) * width


class _Film:
    def __init__(self, shot: Shot, fields: list[PlacedField]) -> None:
        self.shot, self.fields, self.device = shot, fields, fields[0].device
        x0, y0, x1, y1 = shot.border
        self.count = (x1 - x0) * (y1 - y0)
        # Blender's rows go up.
        rows = torch.arange(y1 - 1, y0 - 1, -1, device=self.device)
        y, x = torch.meshgrid(rows, torch.arange(x0, x1, device=self.device), indexing="ij")
        self.corners = torch.stack([x.reshape(-1), y.reshape(-1)], 1).float()
        generator = torch.Generator().manual_seed(0)
        self.turns = torch.rand(self.count, 3, generator=generator).to(self.device)
        self.occluders = self.holdouts = None
        if shot.occluders is not None:
            with np.load(shot.occluders) as data:
                self.occluders = FirstHits(data["vertices"], data["faces"])
                if "holdout" in data and data["holdout"].any():
                    self.holdouts = FirstHits(data["vertices"], data["faces"][data["holdout"]])
        self.sum = np.zeros((self.count, 4))
        self.class_sum = np.zeros((self.count, 4))
        # Colour before objects, behind them, beside them; and how many samples met one, and a holdout.
        self.front, self.behind, self.beside = (np.zeros((self.count, 4)) for _ in range(3))
        self.hits, self.held = np.zeros(self.count), np.zeros(self.count)
        self.colored = 0
        self.geometry: Seen | None = None
        wanted = {name[:-2] for name in shot.passes}
        self.coverage = {name: Coverage(self.count) for name in CRYPTOMATTES if name in wanted}
        self.ids = self._ids()
        self.instances = [
            InstanceNames(field.field, field.item) if "CryptoObject" in self.coverage else None for field in fields
        ]

    def _ids(self) -> list[np.ndarray]:
        """For each field, the Cryptomatte ids of its classes; the last is void's."""
        return [np.array([*map(id_of, field.field.class_names), 0.0], np.float32) for field in self.fields]

    # Seeing

    def look(
        self, offset: tuple[float, float], chance: int | None, report: Reporter, begin: float, part: float
    ) -> Seen:
        """One sample of every pixel."""
        place = self.corners + torch.tensor(offset, device=self.device)
        chances = None
        if chance is not None:
            chances = (self.turns + chance * torch.tensor(STEPS3, device=self.device)) % 1
        size = TILE if self.device.type == "cpu" else GPU_TILE
        tiles = list(torch.arange(self.count, device=self.device).split(size))
        done = [0]

        @torch.no_grad()
        def tile(pixels: torch.Tensor) -> dict[str, torch.Tensor]:
            report.check()
            found = self._tile(place[pixels], None if chances is None else chances[pixels])
            done[0] += 1
            report.progress(begin + part * done[0] / len(tiles))
            return found

        return Seen(run_parallel([partial(tile, pixels) for pixels in tiles], self.device))

    def _tile(self, place: torch.Tensor, chances: torch.Tensor | None) -> dict[str, torch.Tensor]:
        shot = self.shot
        origins, directions = scene_rays(shot.lens, place, chances)
        valid = ~directions[:, 0].isnan()
        directions = torch.where(valid[:, None], directions, directions.new_tensor([[0.0, 0.0, 1.0]]))
        origins = torch.where(valid[:, None], origins, 0.0)
        cosine = axis_cosine(shot.lens, directions).clamp(min=1e-3)
        begin, end = shot.lens.clip[0] / cosine, shot.lens.clip[1] / cosine
        far, met = end, torch.full_like(begin, FAR)
        near = origins + directions * begin[:, None]  # what the clip plane cuts away hides nothing
        if self.occluders is not None:
            met = self.occluders.distances(near, directions).to(self.device) + begin
            met = torch.where(met < end, met, FAR)
            far = torch.minimum(end, met)
        hit = met < FAR
        held = torch.zeros_like(hit)
        if self.holdouts is not None:
            held = hit & (self.holdouts.distances(near, directions).to(self.device) + begin <= met)
        times = None if chances is None else chances[:, 2]
        color, facts = self._merged(origins, directions, begin, far, ~hit, times)
        behind = torch.zeros_like(color)
        rows = (hit & ~held).nonzero()[:, 0]
        if "FieldBehind" in shot.passes and len(rows):
            then = None if times is None else times[rows]
            hidden, _ = self._merged(origins[rows], directions[rows], met[rows], end[rows], hit[rows], then)
            behind = behind.index_copy(0, rows, hidden)
        found = {"color": color, "behind": behind, "hit": hit & valid, "held": held & valid, **facts}
        found = {name: value * valid.view(-1, *[1] * (value.ndim - 1)) for name, value in found.items()}
        found["item"] = torch.where(valid, facts["item"], -1)
        moments = torch.full_like(begin, 0.5) if times is None else times
        return {**found, "origins": origins, "directions": directions, "times": moments}

    def _merged(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        begin: torch.Tensor,
        end: torch.Tensor,
        open_: torch.Tensor,
        times: torch.Tensor | None,
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Linear colour (N, 4) of all fields, the nearest over the others, on what is behind them where rays are open
        (N,); and the facts of the field that shows most."""
        seen = [field.rays(origins, directions, begin, end, times) for field in self.fields]
        before = light_left(seen)
        shares = before * torch.stack([rays.opacity for rays in seen])
        total = (before[..., None] * torch.stack([rays.color for rays in seen])).sum(0)
        left = (1 - torch.stack([rays.opacity for rays in seen])).prod(0)
        strongest = shares.argmax(0)[None]
        pick = lambda name: torch.stack([getattr(rays, name) for rays in seen]).gather(0, strongest)[0]  # noqa: E731
        alpha = 1 - left
        facts = {
            "opacity": alpha,
            "distance": pick("distance"),
            "best": pick("best"),
            "share": pick("share"),
            "item": torch.where(alpha > 0, strongest[0], -1),
        }
        sky = next((rays.sky for rays in seen if rays.sky is not None), None)
        if sky is not None and self.shot.sky:
            gap = left * open_
            total, alpha = total + gap[:, None] * sky, alpha + gap
        linear = to_linear(total / alpha.clamp(min=1e-6)[:, None]) * alpha[:, None]
        if self.shot.world is not None:
            gap = (1 - alpha) * open_
            linear, alpha = linear + gap[:, None] * linear.new_tensor(self.shot.world), alpha + gap
        return torch.cat([linear, alpha[:, None]], 1), facts

    # Gathering

    def add(self, seen: Seen, counts: str) -> None:
        """Take in a sample of every pixel: its colour, its geometry, or both."""
        if counts != "color":
            self.geometry = seen
        if counts == "geometry":
            return
        self.colored += 1
        self.sum += seen.color
        hit = seen.hit[:, None]
        self.front += seen.color * hit
        self.beside += seen.color * ~hit
        self.behind += seen.behind
        self.hits += seen.hit
        self.held += seen.held
        for number, field in enumerate(self.fields):
            mine = (seen.item == number) & (seen.best >= 0)
            colors = np.asarray(to_linear(field.colors.cpu()))
            if len(colors):
                rgb = colors[seen.best.clip(0)] * seen.opacity[:, None]
                self.class_sum += np.where(mine[:, None], np.concatenate([rgb, seen.opacity[:, None]], 1), 0)
        for name, coverage in self.coverage.items():
            coverage.add(self._sample_ids(name, seen), seen.opacity.astype(np.float32))

    def _sample_ids(self, name: str, seen: Seen) -> np.ndarray:
        ids = np.zeros(self.count, np.float32)
        for number, field in enumerate(self.fields):
            mine = seen.item == number
            if name == "CryptoAsset":
                ids[mine] = id_of(field.item.name)
            elif name == "CryptoMaterial":
                ids[mine] = self.ids[number][seen.best[mine]]
            else:
                names = self.instances[number]
                assert names is not None
                points = seen.origins[mine] + seen.directions[mine] * seen.distance[mine, None]
                still = field.still(
                    *(torch.from_numpy(values).to(field.device) for values in (points, seen.times[mine]))
                )
                ids[mine] = names.ids(still.cpu().numpy(), seen.best[mine])
        return ids

    # Passes

    def _image(self, values: np.ndarray) -> np.ndarray:
        width, height = self.shot.size
        return np.ascontiguousarray(values.reshape(height, width, -1), np.float32)

    def combined(self) -> np.ndarray:
        """Colours (H, W, 4) so far."""
        return self._image(self.sum / max(self.colored, 1))

    def passes(self) -> dict[str, np.ndarray]:
        """All passes that were asked for."""
        seen, made = self.geometry, {}
        assert seen is not None
        met = np.isfinite(seen.distance) & (seen.opacity > 0)
        distance = np.where(met, seen.distance, 0)
        position = np.where(met[:, None], seen.origins + seen.directions * distance[:, None], np.nan)
        cosine = axis_cosine(self.shot.lens, torch.from_numpy(seen.directions)).numpy()
        labelled = met & (seen.best >= 0)
        index = np.zeros(self.count)
        for number, field in enumerate(self.fields):
            table = np.array([*field.field.class_ids, field.field.void])
            mine = seen.item == number
            index[mine] = table[np.where(labelled, seen.best, -1)[mine]]
        front, behind = self._around_objects()
        plain = {
            "Combined": lambda: self.sum / self.colored,
            "Depth": lambda: np.where(met, distance * cosine, EMPTY_DEPTH),
            "Position": lambda: np.nan_to_num(position),
            "Normal": lambda: surface_normals(self._image(position), self._image(seen.directions)),
            "Class Index": lambda: index,
            "Class Color": lambda: self.class_sum / self.colored,
            "Confidence": lambda: np.where(labelled, seen.share, 0),
            "FieldFront": lambda: front,
            "FieldBehind": lambda: behind,
        }
        ranked = {name: coverage_.ranked(self.shot.levels) for name, coverage_ in self.coverage.items()}
        for name in self.shot.passes:
            if name in plain:
                made[name] = self._image(plain[name]())
            else:
                values = ranked[name[:-2]][int(name[-2:])].copy()
                values[:, 1::2] /= self.colored
                made[name] = self._image(values)
        return made

    def manifests(self) -> dict[str, str]:
        """The names of the ids that may occur."""
        classes = {name for field in self.fields for name in field.field.class_names}
        objects = {name for names in self.instances if names is not None for name in names.names}
        assets = {field.item.name for field in self.fields}
        names = {"CryptoObject": objects, "CryptoMaterial": classes, "CryptoAsset": assets}
        return {name: manifest(sorted(names[name])) for name in self.coverage}

    def _around_objects(self) -> tuple[np.ndarray, np.ndarray]:
        """What is composited before and behind Blender's objects, so that Front over (Objects over Behind) is the mean over
        the samples also where an edge of an object crosses a pixel: with a share `a` of it covered, f what is before the
        object and b what is beside it, Front = a f + (1 − a) f.alpha b with f's alpha, Behind = b. Where part of it is a holdout, of
        which the objects' picture has nothing, Behind is as much less than b as what the objects leave is more than 1 − a;
        the alpha of the whole is then too large by (1 − a) f.alpha (1 − b.alpha) where the field ends in the same pixel."""
        hits, held = self.hits[:, None], self.held[:, None]
        solid, rest = hits - held, self.colored - hits
        before = self.front / np.maximum(hits, 1)
        alpha = before[:, 3:]
        front = (hits * before + alpha * self.beside) / self.colored
        behind = np.where(rest + held > 0, self.beside / np.maximum(rest + held, 1), self.behind / np.maximum(solid, 1))
        return np.concatenate([front[:, :3], alpha], 1), behind


def to_linear(srgb: torch.Tensor) -> torch.Tensor:
    """sRGB in [0, 1] as linear light (IEC 61966-2-1)."""
    srgb = srgb.clamp(0, 1)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def surface_normals(position: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Unit normals (H, W, 3) towards the camera from points (H, W, 3), NaN where nothing is; at a border of a surface from
    the neighbours on it: of the two differences along an axis the shorter one. 0 where there are none."""

    def difference(axis: int) -> np.ndarray:
        step = np.diff(position, axis=axis)
        void = np.full_like(np.take(position, [0], axis), np.nan)
        after, before = np.concatenate([step, void], axis), np.concatenate([void, step], axis)
        lengths = [np.nan_to_num((d**2).sum(-1, keepdims=True), nan=np.inf) for d in (after, before)]
        return np.where(lengths[0] <= lengths[1], after, before)

    normal = np.nan_to_num(np.cross(difference(1), difference(0)))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.maximum(length, 1e-20)
    return np.where((normal * directions).sum(-1, keepdims=True) > 0, -normal, normal) * (length > 1e-20)
