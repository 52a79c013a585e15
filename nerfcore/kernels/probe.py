"""A tiny Warp kernel with a known answer. Apart, because a kernel needs its source in a module of its own."""

import numpy as np
import warp as wp


@wp.kernel
def _square(values: wp.array(dtype=float)):  # pyright: ignore[reportInvalidTypeForm]
    i = wp.tid()
    values[i] = values[i] * values[i]


def check_warp() -> bool:
    """Whether the kernel computes wrongly on the default device."""
    values = wp.array(np.arange(16, dtype=np.float32), dtype=float)
    wp.launch(_square, dim=16, inputs=[values])
    return not np.array_equal(values.numpy(), np.arange(16, dtype=np.float32) ** 2)
