"""Small ReLU networks without biases on the CPU, in float32: whole chains of layers a block of rows at a time.

A block's activations stay in the core's first cache from the first layer to the last, and one launch does what would be
three torch operations a layer. The products are as fast as the processor multiplies (AVX2: 118 of 128 GFLOP/s a core,
AVX-512: 219 of 256, docs/experiments.md); torch's matrix library has 107 in either. Written in C++ with vector types of
the compiler; `field/mlp.py` has the same in torch operations.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import warp as wp

from .runtime import array, init, launch

ROWS = 48  # of a block
MOST = 128  # inputs or outputs of a layer
LANES = 16  # numbers that widths are padded to


def padded(width: int) -> int:
    """A width as blocks have it."""
    return -(-width // LANES) * LANES


# `multiply`: to (ROWS, columns) = from (ROWS, K) · matrix (K, columns), in tiles of 6 rows whose sums stay in registers:
# 16 columns with AVX2, 32 with AVX-512. `add_products`: sums (outputs, columns) += grads (rows, outputs)ᵀ · given (rows,
# columns), 4 outputs at a time. Widths are multiples of 16 but K, which may be less than its stride.
BLOCKS = """
    typedef float V __attribute__((vector_size(64), aligned(4)));
    struct One { enum { N = 1 }; };
    struct Two { enum { N = 2 }; };
    enum { ROWS = 48, MOST = 128 };
    auto padded = [](int width) { return (width + 15) / 16 * 16; };
    auto multiply_columns = [](auto wide, const float* from, int stride, int K, const float* matrix, int columns, int c,
                               float* to, bool rectified) {
        enum { N = decltype(wide)::N };
        for (int r = 0; r < ROWS; r += 6) {
            V sums[6][N];
            for (int i = 0; i < 6; ++i) for (int j = 0; j < N; ++j) sums[i][j] = V{};
            const float* rows = from + r * stride;
            const float* weights = matrix + c;
            for (int k = 0; k < K; ++k, weights += columns) {
                V w[N];
                for (int j = 0; j < N; ++j) __builtin_memcpy(&w[j], weights + 16 * j, 64);
                for (int i = 0; i < 6; ++i) for (int j = 0; j < N; ++j) sums[i][j] += rows[i * stride + k] * w[j];
            }
            for (int i = 0; i < 6; ++i) for (int j = 0; j < N; ++j) {
                V sum = sums[i][j];
                if (rectified) sum = sum > 0.0f ? sum : V{};
                __builtin_memcpy(to + (r + i) * columns + c + 16 * j, &sum, 64);
            }
        }
    };
    auto multiply = [&](const float* from, int stride, int K, const float* matrix, int columns, float* to, bool rectified) {
        int c = 0;
#ifdef __AVX512F__
        for (; c + 32 <= columns; c += 32) multiply_columns(Two{}, from, stride, K, matrix, columns, c, to, rectified);
#endif
        for (; c < columns; c += 16) multiply_columns(One{}, from, stride, K, matrix, columns, c, to, rectified);
    };
"""
_PRODUCTS = """
    auto product_columns = [](auto wide, const float* grads, int outputs, const float* given, int columns, int c, int rows,
                              float* sums) {
        enum { N = decltype(wide)::N };
        for (int o = 0; o < outputs; o += 4) {
            V held[4][N];
            for (int i = 0; i < 4; ++i) for (int j = 0; j < N; ++j)
                __builtin_memcpy(&held[i][j], sums + (o + i) * columns + c + 16 * j, 64);
            for (int r = 0; r < rows; ++r) {
                V x[N];
                for (int j = 0; j < N; ++j) __builtin_memcpy(&x[j], given + r * columns + c + 16 * j, 64);
                for (int i = 0; i < 4; ++i) for (int j = 0; j < N; ++j) held[i][j] += grads[r * outputs + o + i] * x[j];
            }
            for (int i = 0; i < 4; ++i) for (int j = 0; j < N; ++j)
                __builtin_memcpy(sums + (o + i) * columns + c + 16 * j, &held[i][j], 64);
        }
    };
    auto add_products = [&](const float* grads, int outputs, const float* given, int columns, int rows, float* sums) {
        int c = 0;
#ifdef __AVX512F__
        for (; c + 32 <= columns; c += 32) product_columns(Two{}, grads, outputs, given, columns, c, rows, sums);
#endif
        for (; c < columns; c += 16) product_columns(One{}, grads, outputs, given, columns, c, rows, sums);
    };
"""

# Rows of a matrix into a block, zeros beside and below them.
_TAKE = """
    auto take = [](const float* from, int width, int rows, float* to, int columns) {
        for (int r = 0; r < ROWS; ++r) {
            if (r < rows) __builtin_memcpy(to + r * columns, from + (size_t)r * width, width * sizeof(float));
            const int begin = r < rows ? width : 0;
            __builtin_memset(to + r * columns + begin, 0, (columns - begin) * sizeof(float));
        }
    };
    const int* widths = (const int*)sizes.data;
    const int left = count - block * ROWS, rows = left < ROWS ? left : ROWS;
    const size_t first = (size_t)block * ROWS;
"""


@wp.struct
class PartArrays:
    """Rows (N, …) put together of up to three arrays. Of each: its values, how wide its rows are (0: it is not there), and
    which row stands for which, if `gathered`, else they follow each other."""

    first: wp.array(dtype=float)
    first_rows: wp.array(dtype=wp.int64)
    first_width: int
    second: wp.array(dtype=float)
    second_rows: wp.array(dtype=wp.int64)
    second_width: int
    third: wp.array(dtype=float)
    third_rows: wp.array(dtype=wp.int64)
    third_width: int
    gathered: int


@wp.func_native(
    BLOCKS
    + """
    const int* widths = (const int*)sizes.data;
    const int left = count - block * ROWS, rows = left < ROWS ? left : ROWS;
    const size_t first = (size_t)block * ROWS;
    float even[ROWS * MOST], odd[ROWS * MOST];
    const int inputs = padded(widths[0]);
    if (rows < ROWS) __builtin_memset(even, 0, sizeof(even));  // rows below the last one only have to be numbers
    int begin = 0;
    auto take = [&](const float* values, const long long* index, int width) {
        if (width == 0) return;
        for (int r = 0; r < rows; ++r) {
            const size_t row = parts.gathered ? (size_t)index[first + r] : first + r;
            __builtin_memcpy(even + r * inputs + begin, values + row * width, width * sizeof(float));
        }
        begin += width;
    };
    take((const float*)parts.first.data, (const long long*)parts.first_rows.data, parts.first_width);
    take((const float*)parts.second.data, (const long long*)parts.second_rows.data, parts.second_width);
    take((const float*)parts.third.data, (const long long*)parts.third_rows.data, parts.third_width);
    const float* matrix = (const float*)weights.data;
    float *from = even, *to = odd;
    int hidden = 0;
    for (int layer = 0; layer < layers; ++layer) {
        const int stride = padded(widths[layer]), columns = padded(widths[layer + 1]);
        multiply(from, stride, widths[layer], matrix, columns, to, layer + 1 < layers);
        matrix += stride * columns;
        float* next = from; from = to; to = next;
        if (keep && layer + 1 < layers) {
            float* kept_rows = (float*)kept.data + first * keep + hidden;
            for (int r = 0; r < rows; ++r)
                __builtin_memcpy(kept_rows + (size_t)r * keep, from + r * columns, columns * sizeof(float));
            hidden += columns;
        }
    }
    const int width = widths[layers], columns = padded(width);
    float* result = (float*)out.data + first * width;
    for (int r = 0; r < rows; ++r) __builtin_memcpy(result + (size_t)r * width, from + r * columns, width * sizeof(float));
"""
)
def _forward(
    parts: PartArrays,
    weights: wp.array(dtype=float),
    sizes: wp.array(dtype=int),
    layers: int,
    count: int,
    keep: int,
    kept: wp.array(dtype=float),
    out: wp.array(dtype=float),
    block: int,
): ...


@wp.func_native(
    BLOCKS
    + _PRODUCTS
    + _TAKE
    + """
    float even[ROWS * MOST], odd[ROWS * MOST], input[ROWS * MOST];
    int matrices = 0, hidden = 0;
    for (int layer = 0; layer < layers; ++layer) {
        matrices += padded(widths[layer]) * padded(widths[layer + 1]);
        if (layer + 1 < layers) hidden += padded(widths[layer + 1]);
    }
    const int kept_width = hidden;
    float *grads = even, *to = odd;
    take((const float*)grad_out.data + first * widths[layers], widths[layers], rows, grads, padded(widths[layers]));
    for (int layer = layers - 1; layer >= 0; --layer) {
        const int inputs = padded(widths[layer]), outputs = padded(widths[layer + 1]);
        matrices -= inputs * outputs;
        if (layer > 0) {
            hidden -= inputs;
            const float* kept_rows = (const float*)kept.data + first * kept_width + hidden;
            for (int r = 0; r < rows; ++r)
                __builtin_memcpy(input + r * inputs, kept_rows + (size_t)r * kept_width, inputs * sizeof(float));
        } else {
            take((const float*)given.data + first * widths[0], widths[0], rows, input, inputs);
        }
        add_products(grads, outputs, input, inputs, rows, (float*)grad_weights.data + matrices);
        if (layer == 0 && !want_input) return;
        multiply(grads, outputs, widths[layer + 1], (const float*)weights.data + matrices, inputs, to, false);
        if (layer > 0)
            for (int k = 0; k < rows * inputs; ++k) to[k] = input[k] > 0.0f ? to[k] : 0.0f;
        float* next = grads; grads = to; to = next;
    }
    const int width = widths[0], columns = padded(width);
    float* result = (float*)grad_input.data + first * width;
    for (int r = 0; r < rows; ++r) __builtin_memcpy(result + (size_t)r * width, grads + r * columns, width * sizeof(float));
"""
)
def _backward(
    given: wp.array(dtype=float),
    kept: wp.array(dtype=float),
    weights: wp.array(dtype=float),
    sizes: wp.array(dtype=int),
    layers: int,
    count: int,
    want_input: int,
    grad_out: wp.array(dtype=float),
    grad_input: wp.array(dtype=float),
    grad_weights: wp.array(dtype=float),
    block: int,
): ...


@wp.kernel(module="fieldwork_network_host")
def chain_forward(
    parts: PartArrays,
    weights: wp.array(dtype=float),
    sizes: wp.array(dtype=int),
    layers: int,
    count: int,
    keep: int,
    kept: wp.array(dtype=float),
    out: wp.array(dtype=float),
    offset: int,
):
    _forward(parts, weights, sizes, layers, count, keep, kept, out, wp.tid() + offset)


@wp.kernel(module="fieldwork_network_host")
def chain_backward(
    given: wp.array(dtype=float),
    kept: wp.array(dtype=float),
    weights: wp.array(dtype=float),
    sizes: wp.array(dtype=int),
    layers: int,
    count: int,
    want_input: int,
    grad_out: wp.array(dtype=float),
    grad_input: wp.array(dtype=float),
    grad_weights: wp.array(dtype=float),
    offset: int,
):
    # Blocks add to the same sums, one after the other: nothing is atomic.
    _backward(
        given,
        kept,
        weights,
        sizes,
        layers,
        count,
        want_input,
        grad_out,
        grad_input,
        grad_weights,
        wp.tid() + offset,
    )


def sizes_of(matrices: Sequence[torch.Tensor]) -> list[int]:
    """Widths from the input to the output of layers (out, in)."""
    return [matrices[0].shape[1], *(len(m) for m in matrices)]


def supported(matrices: Sequence[torch.Tensor]) -> bool:
    """Whether layers (out, in) are narrow enough."""
    return max(sizes_of(matrices)) <= MOST


def packed(matrices: Sequence[torch.Tensor], transposed: bool) -> torch.Tensor:
    """Layers (out, in) one after the other, padded; as (in, out) if `transposed`."""
    parts = []
    for matrix in matrices:
        value = matrix.detach().t() if transposed else matrix.detach()
        rows, columns = value.shape
        parts.append(torch.nn.functional.pad(value, (0, padded(columns) - columns, 0, padded(rows) - rows)).flatten())
    return torch.cat(parts)


Part = tuple[torch.Tensor, torch.Tensor | None]


def forward(
    parts: Sequence[Part], matrices: Sequence[torch.Tensor], keep: bool = False
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Rows put together of one to three arrays through layers (out, in): (N, out), and, to `keep`, what the hidden layers
    were (N, hidden), their widths padded.

    Args:
        parts: values (M, width) float32, and which of their rows (N,) int64; None for all of them in their order, of all
            parts alike.
    """
    init()
    sizes = sizes_of(matrices)
    values, rows = parts[0]
    count = len(values) if rows is None else len(rows)
    given = PartArrays()
    given.gathered = int(rows is not None)
    for name, (values, rows) in zip(("first", "second", "third"), parts):
        setattr(given, name, array(values.contiguous().view(-1)))
        setattr(given, f"{name}_width", values.shape[1])
        if rows is not None:
            setattr(given, f"{name}_rows", array(rows))
    width = sum(padded(size) for size in sizes[1:-1]) if keep else 0
    kept = torch.empty(count, width) if width else None
    out = torch.empty(count, sizes[-1])
    numbers = torch.tensor(sizes, dtype=torch.int32)
    inputs = [given, array(packed(matrices, True)), array(numbers), len(matrices), count, width]
    results = [array(out.view(-1) if kept is None else kept.view(-1)), array(out.view(-1))]
    launch(chain_forward, -(-count // ROWS), [*inputs, *results], out.device)
    return out, kept


def backward(
    grad_out: torch.Tensor,
    x: torch.Tensor,
    kept: torch.Tensor | None,
    matrices: Sequence[torch.Tensor],
    want_input: bool,
) -> tuple[torch.Tensor | None, list[torch.Tensor]]:
    """Gradients of `forward` from that of its result (N, out): to x (N, in), if wanted, and to the layers."""
    init()
    sizes = sizes_of(matrices)
    grad_input = torch.empty(len(x), sizes[0]) if want_input else None
    sums = torch.zeros(sum(padded(a) * padded(b) for a, b in zip(sizes, sizes[1:])))
    grads = grad_out.contiguous().view(-1)
    numbers = torch.tensor(sizes, dtype=torch.int32)
    inputs = [
        array(x.contiguous().view(-1)),
        array(grads if kept is None else kept.view(-1)),
        array(packed(matrices, False)),
        array(numbers),
        len(matrices),
        len(x),
        int(want_input),
        array(grads),
        array(grads if grad_input is None else grad_input.view(-1)),
        array(sums),
    ]
    launch(chain_backward, -(-len(x) // ROWS), inputs, x.device, serial=True)
    found, begin = [], 0
    for inside, outside in zip(sizes, sizes[1:]):
        count = padded(inside) * padded(outside)
        found.append(sums[begin : begin + count].view(padded(outside), padded(inside))[:outside, :inside])
        begin += count
    return grad_input, found
