"""Points and pixels of depth maps and photos: what the kernels of surfaces share.

Cameras are pinholes with OpenCV axes; a pixel's centre lies at half coordinates. Depths are along the optical axis.
"""

from __future__ import annotations

import warp as wp

from .depth_arrays import FREE, MapArrays
from .runtime import array

NEAREST = wp.constant(1.0e-4)  # depth in front of a camera from which points are projected
FARTHEST = wp.constant(0.1 * FREE)  # depths beyond it mean that a ray meets nothing


@wp.struct
class Maps:
    """V depth maps, see `depth_arrays.MapArrays`."""

    depth: wp.array(dtype=float)
    cosine: wp.array(dtype=float)
    spread: wp.array(dtype=float)
    certain: wp.array(dtype=float)
    first: wp.array(dtype=int)
    size: wp.array(dtype=int, ndim=2)
    lens: wp.array(dtype=wp.vec4)
    rotation: wp.array(dtype=wp.mat33)
    translation: wp.array(dtype=wp.vec3)


def map_struct(maps: MapArrays) -> Maps:
    """The maps as kernels take them."""
    out = Maps()
    out.depth, out.cosine, out.spread = array(maps.depth), array(maps.cosine), array(maps.spread)
    out.certain = array(maps.certain)
    out.first, out.size, out.lens = array(maps.first), array(maps.size), array(maps.lens, wp.vec4)
    out.rotation, out.translation = array(maps.rotation, wp.mat33), array(maps.translation, wp.vec3)
    return out


@wp.func
def project(lens: wp.vec4, q: wp.vec3):
    """Pixel coordinates of a point in camera axes."""
    return wp.vec2(lens[0] * q[0] / q[2] + lens[2], lens[1] * q[1] / q[2] + lens[3])


@wp.func
def pixel_ray(lens: wp.vec4, x: float, y: float):
    """Direction of a pixel in camera axes, with z = 1."""
    return wp.vec3((x - lens[2]) / lens[0], (y - lens[3]) / lens[1], 1.0)


@wp.func
def seen_at(maps: Maps, view: int, p: wp.vec3):
    """A point of the frame in the axes of a view's camera, its pixel, and whether that lies in the picture."""
    q = maps.rotation[view] * p + maps.translation[view]
    pixel = wp.vec2(0.0, 0.0)
    inside = bool(False)
    if q[2] > NEAREST:
        pixel = project(maps.lens[view], q)
        inside = pixel[0] >= 0.0 and pixel[1] >= 0.0
        inside = inside and pixel[0] < float(maps.size[view, 0]) and pixel[1] < float(maps.size[view, 1])
    return q, pixel, inside


@wp.func
def read_depth(maps: Maps, view: int, pixel: wp.vec2, gap: float):
    """Depth at pixel coordinates: interpolated (in 1/z, in which planes are linear) where the four pixels around lie
    within the share `gap` of each other; at an outline the nearest pixel's if it is in front, else unknown: half a pixel
    beside an outline nobody knows what is behind. Beside what lies outside of the photo (below 0) the nearest pixel's, as at
    the picture's border. And the nearest pixel's place."""
    width = maps.size[view, 0]
    height = maps.size[view, 1]
    x = pixel[0]
    y = pixel[1]
    column = wp.clamp(int(wp.floor(x)), 0, width - 1)
    row = wp.clamp(int(wp.floor(y)), 0, height - 1)
    place = maps.first[view] + row * width + column
    value = maps.depth[place]
    x0 = int(wp.floor(x - 0.5))
    y0 = int(wp.floor(y - 0.5))
    if x0 >= 0 and y0 >= 0 and x0 + 1 < width and y0 + 1 < height and value > 0.0:
        corner = maps.first[view] + y0 * width + x0
        a = maps.depth[corner]
        b = maps.depth[corner + 1]
        c = maps.depth[corner + width]
        d = maps.depth[corner + width + 1]
        low = wp.min(wp.min(a, b), wp.min(c, d))
        high = wp.max(wp.max(a, b), wp.max(c, d))
        if low >= 0.0 and value - low >= gap * low:
            value = 0.0
        elif low > 0.0 and high - low < gap * low:
            fx = x - 0.5 - float(x0)
            fy = y - 0.5 - float(y0)
            upper = (1.0 - fx) / a + fx / b
            lower = (1.0 - fx) / c + fx / d
            value = 1.0 / ((1.0 - fy) * upper + fy * lower)
    return value, place
