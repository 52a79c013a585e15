"""What `kernels/warping.py` computes, pixel by pixel in plain numpy."""

from __future__ import annotations

import numpy as np
from fieldwork.nerfcore.kernels import warping
from fieldwork.nerfcore.kernels.depth_arrays import FREE, MapArrays


def photo_forces(
    grey: np.ndarray, facing: np.ndarray, nearest: np.ndarray, maps: MapArrays, view: int, near: list[int]
) -> np.ndarray:
    """As `warping.photo_forces`."""
    width, height = maps.size[view].tolist()
    first = int(maps.first[view])
    mine = grey[first : first + width * height, 0].reshape(height, width)
    total = np.zeros((height, width, 3))
    for other in near:
        value, slope = warped(grey, facing, nearest, maps, view, other)
        total += compared(mine, value.reshape(height, width), slope.reshape(height, width))
    return total.reshape(-1, 3)


def warped(
    grey: np.ndarray, facing: np.ndarray, nearest: np.ndarray, maps: MapArrays, view: int, other: int
) -> tuple[np.ndarray, np.ndarray]:
    """What photo `other` shows of the places that the pixels of `view` do, NaN for nothing, and how that changes with the
    surface."""
    width, height = maps.size[view].tolist()
    fx, fy, cx, cy = maps.lens[view].tolist()
    lens, size = maps.lens[other].tolist(), maps.size[other].tolist()
    to_own, to_other = maps.rotation[view].double().numpy(), maps.rotation[other].double().numpy()
    shift_own, shift_other = maps.translation[view].double().numpy(), maps.translation[other].double().numpy()
    value, slope = np.full(width * height, np.nan), np.zeros(width * height)
    for i in range(width * height):
        depth = float(maps.depth[int(maps.first[view]) + i])
        if not 0 < depth < FREE or grey[int(maps.first[view]) + i, 0] < 0:
            continue
        ray = np.array([(i % width + 0.5 - cx) / fx, (i // width + 0.5 - cy) / fy, 1.0])
        point, along = to_own.T @ (depth * ray - shift_own), to_own.T @ ray

        def pixel_of(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            q = to_other @ place + shift_other
            return q, np.array([lens[0] * q[0] / q[2] + lens[2], lens[1] * q[1] / q[2] + lens[3]])

        q, pixel = pixel_of(point)
        if q[2] <= 1e-4 or (pixel < 0).any() or (pixel >= size).any():
            continue
        cosine = -(q @ (to_other @ facing[i])) / np.linalg.norm(q)
        steep = np.sqrt(max(1 - cosine**2, 0)) / max(cosine, warping.GRAZING)
        slack = q[2] / lens[0] * (warping.SLACK + warping.SLACK_SLOPE * steep)
        at = int(maps.first[other]) + int(pixel[1]) * size[0] + int(pixel[0])
        if cosine <= warping.FLATTEST or nearest[at] <= q[2] - slack:
            continue
        read = interpolated(grey, int(maps.first[other]), size, pixel)
        if read is None:
            continue
        moved = along / min(along @ facing[i], -1e-6)
        step = 1e-6
        motion = (pixel_of(point + step * moved)[1] - pixel_of(point - step * moved)[1]) / (2 * step)
        value[i], slope[i] = read[0], read[1] * motion[0] + read[2] * motion[1]
    return value, slope


def interpolated(grey: np.ndarray, first: int, size: list[int], pixel: np.ndarray) -> np.ndarray | None:
    """Value and slopes (3,) at pixel coordinates; None beside what is unknown."""
    x, y = (min(max(p - 0.5, 0.0), n - 1.001) for p, n in zip(pixel, size))
    column, row = int(x), int(y)
    four = [grey[first + (row + b) * size[0] + column + a] for b in (0, 1) for a in (0, 1)]
    if min(f[0] for f in four) < 0:
        return None
    shares = [(1 - x + column) * (1 - y + row), (x - column) * (1 - y + row)]
    shares += [(1 - x + column) * (y - row), (x - column) * (y - row)]
    return sum(share * f for share, f in zip(shares, four))  # type: ignore[return-value]


def compared(mine: np.ndarray, theirs: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Force, its slope and the misfit (H, W, 3) of two pictures (H, W) of the same places."""
    height, width = mine.shape
    reach = np.arange(-warping.RADIUS, warping.RADIUS + 1)
    bell = np.exp(-(reach**2) / (2 * warping.SIGMA**2))
    weights, out = bell[:, None] * bell, np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            if np.isnan(theirs[row, column]):
                continue
            rows, columns = row + reach, column + reach
            inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
            place = np.ix_(rows.clip(0, height - 1), columns.clip(0, width - 1))
            used = inside & ~np.isnan(theirs[place])
            w, a, b = weights[used], mine[place][used], theirs[place][used]
            mean_a, mean_b = np.average(a, weights=w), np.average(b, weights=w)
            var_a = np.average((a - mean_a) ** 2, weights=w) + warping.NOISE
            var_b = np.average((b - mean_b) ** 2, weights=w) + warping.NOISE
            alike = np.average((a - mean_a) * (b - mean_b), weights=w) / np.sqrt(var_a * var_b)
            if alike <= warping.ALIKE or w.sum() <= warping.HALF * weights.sum():
                continue
            off = (mine[row, column] - mean_a) / np.sqrt(var_a) - (theirs[row, column] - mean_b) / np.sqrt(var_b)
            steep = slope[row, column] / np.sqrt(var_b)
            sure = min((alike - warping.ALIKE) / (warping.SURE - warping.ALIKE), 1) / (1 + off**2)
            out[row, column] = sure * np.array([steep * off, steep**2, off**2])
    return out
