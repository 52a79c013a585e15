"""Device functions of the fused renderer: networks shared by a warp of samples.

Each thread works on one sample, whose inputs are a row of half precision numbers in shared memory. The 32 threads of a
warp multiply their rows together on the matrix units, 16 rows at a time (`network`): what passes from layer to layer stays
in registers, since the sums of one product lie there as the next one takes its factors. Matrices lie in shared memory,
brought there once for a block (`bring`). Half precision in, single precision sums. No warp waits for another one.

On the CPU the same functions compute one sample at a time, from the matrices as they are packed.

Layout of the factors in registers: PTX ISA, “Matrix fragments for mma.m16n8k16”.
"""

from functools import cache
from typing import Any

import warp as wp

GRANULE = 16  # sides of matrices are multiples of this, as the matrix units want them
WARP = 32
GAP = 8  # unused numbers behind each row in memory: eight rows then lie in different banks
LEAST_SCORE = 1e-7  # weight of a class that is added to a pixel


def padded(size: int) -> int:
    """`size` rounded up to what the matrix units take."""
    return -(-size // GRANULE) * GRANULE


def packed_size(sizes: tuple[int, ...]) -> int:
    """Numbers that the matrices of a network take, row by row and layer by layer, with the gap behind each row."""
    return sum((inputs + GAP) * outputs for inputs, outputs in zip(sizes, sizes[1:]))


def row_length(*networks: tuple[int, ...]) -> int:
    """Numbers of a thread's row of inputs, which outputs of single precision may overwrite; with the gap behind it."""
    return max(max(sizes[0], 2 * sizes[-1]) for sizes in networks) + GAP


@wp.func_native("return WP_TILE_THREAD_IDX;")
def thread_of_block() -> int:
    """Number of this thread in its block."""


# Shared memory is a tile of single precision numbers, and places in it count half precision ones.


@wp.func
def output(memory: Any, row: int, k: int):
    """Number `k` of what `network` left in the thread's row."""
    return memory[row // 2 + k]


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4* from = reinterpret_cast<const float4*>(weights.data + first);  // 8 weights at a time
    float4* to = reinterpret_cast<float4*>(memory.data.ptr + place / 2);
    for (int i = WP_TILE_THREAD_IDX; i < size / 8; i += WP_TILE_BLOCK_DIM) to[i] = from[i];
    WP_TILE_SYNC();
#endif
""")
def bring(memory: Any, place: int, weights: wp.array(dtype=wp.float16), first: int, size: int):
    """Copy `size` weights from `first` on to `place` in the block's shared memory; the CPU reads them where they are."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, yes);
#else
    return yes;
#endif
""")
def any_of_warp(yes: int) -> int:
    """Whether `yes` is not 0 in any thread of the warp, all of which must ask."""


# What the matrix units do. Of 32 threads, thread 4g + t holds of 16 rows the numbers 2t, 2t + 1 of the rows g and g + 8.
INSTRUCTIONS = """
    const int thread = WP_TILE_THREAD_IDX & 31, group = thread >> 2, pair = 2 * (thread & 3);
    // Four 8×8 matrices of half precision; thread 8m + r has the address of row r of matrix m.
    auto load = [](unsigned* to, const wp::half* from) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
            : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
            : "r"(static_cast<unsigned>(__cvta_generic_to_shared(from))) : "memory");
    };
    // sum (16×8) += a (16×16) · b (16×8)
    auto multiply = [](float* sum, const unsigned* a, unsigned b0, unsigned b1) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800
        asm volatile("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
            : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3]) : "r"(a[0]), "r"(a[1]), "r"(b0));
        asm volatile("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
            : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3]) : "r"(a[2]), "r"(a[3]), "r"(b1));
#else
        asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
            : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
#endif
    };
    auto both = [](float low, float high) {  // as two halves
        return static_cast<unsigned>(wp::half(low).u) | static_cast<unsigned>(wp::half(high).u) << 16;
    };
    auto from_thread = [](auto value, int other) { return __shfl_sync(0xffffffffu, value, other); };
    auto over_row = [](float value, auto join) {  // over the four threads that hold a row
        value = join(value, __shfl_xor_sync(0xffffffffu, value, 1));
        return join(value, __shfl_xor_sync(0xffffffffu, value, 2));
    };
    auto wait = [] { __syncwarp(); };
"""


def _layer(k: int, inputs: int, outputs: int, last: bool) -> str:
    """A product of the factors `a` (16, inputs) with a matrix (outputs, inputs) at `matrix`, into `sum_k`; rectified and
    back into `a` unless it is the last one."""
    text = f"""
        float sum_{k}[{outputs // 8}][4];
        #pragma unroll
        for (int n = 0; n < {outputs // 8}; ++n)
            #pragma unroll
            for (int e = 0; e < 4; ++e) sum_{k}[n][e] = 0.0f;
        #pragma unroll
        for (int q = 0; q < {inputs // 16}; ++q)
            #pragma unroll
            for (int n = 0; n < {outputs // 16}; ++n) {{
                unsigned b[4];
                load(b, matrix + (16 * n + 8 * (thread >> 4) + (thread & 7)) * {inputs + GAP} + 16 * q + 8 * ((thread >> 3) & 1));
                multiply(sum_{k}[2 * n], a[q], b[0], b[1]);
                multiply(sum_{k}[2 * n + 1], a[q], b[2], b[3]);
            }}
        matrix += {outputs * (inputs + GAP)};
    """
    if last:
        return text
    return (
        text
        + f"""
        #pragma unroll
        for (int q = 0; q < {outputs // 16}; ++q) {{
            const float* low = sum_{k}[2 * q];
            const float* high = sum_{k}[2 * q + 1];
            a[q][0] = both(fmaxf(low[0], 0.0f), fmaxf(low[1], 0.0f));
            a[q][1] = both(fmaxf(low[2], 0.0f), fmaxf(low[3], 0.0f));
            a[q][2] = both(fmaxf(high[0], 0.0f), fmaxf(high[1], 0.0f));
            a[q][3] = both(fmaxf(high[2], 0.0f), fmaxf(high[3], 0.0f));
        }}
    """
    )


def _warp_body(sizes: tuple[int, ...], length: int, take: str) -> str:
    """CUDA: a ReLU network of the rows of a warp; `take` uses the sums of its last layer, `sum` (N/8, 4), of the rows
    `first_row` + group and + 8."""
    layers = list(zip(sizes, sizes[1:]))
    products = "".join(_layer(k, *layer, last=k == len(layers) - 1) for k, layer in enumerate(layers))
    return f"""
    {INSTRUCTIONS}
    wp::half* halves = reinterpret_cast<wp::half*>(memory.data.ptr);
    wp::half* rows = halves + row - thread * {length};
    wait();
    #pragma unroll 1
    for (int first_row = 0; first_row < 32; first_row += 16) {{
        unsigned a[{max(sizes[:-1]) // 16}][4];
        #pragma unroll
        for (int q = 0; q < {sizes[0] // 16}; ++q)
            load(a[q], rows + (first_row + (thread & 15)) * {length} + 16 * q + 8 * (thread >> 4));
        const wp::half* matrix = halves + held;
        {products}
        auto& sum = sum_{len(layers) - 1};
        wait();
        {take}
    }}
    wait();
    """


def _host_body(sizes: tuple[int, ...], take: str) -> str:
    """The CPU: a ReLU network of one row; `take` uses the sums of its last layer, `sum` (N,)."""
    most, layers = max(sizes), list(zip(sizes, sizes[1:]))
    text = f"""
    float x[{most}], sum[{most}];
    wp::half* own = reinterpret_cast<wp::half*>(memory.data.ptr) + row;
    const wp::half* matrix = weights.data + first;
    for (int k = 0; k < {sizes[0]}; ++k) x[k] = float(own[k]);
    """
    for number, (inputs, outputs) in enumerate(layers):
        text += f"""
    for (int n = 0; n < {outputs}; ++n) {{
        sum[n] = 0.0f;
        for (int k = 0; k < {inputs}; ++k) sum[n] += float(matrix[n * {inputs + GAP} + k]) * x[k];
    }}
    matrix += {outputs * (inputs + GAP)};
    """
        if number < len(layers) - 1:
            text += f"for (int n = 0; n < {outputs}; ++n) x[n] = float(wp::half(sum[n] > 0.0f ? sum[n] : 0.0f));"
    return text + take


def _both(sizes: tuple[int, ...], length: int, on_warp: str, on_host: str) -> str:
    return f"""
#if defined(__CUDA_ARCH__)
{_warp_body(sizes, length, on_warp)}
#else
{_host_body(sizes, on_host)}
#endif
"""


def _name(kind: str, sizes: tuple[int, ...], length: int) -> str:
    return f"{kind}_{'_'.join(map(str, sizes))}_{length}"


# Of the functions below: `memory`: the block's shared memory; `row`: place of the thread's inputs in it; `held`: place of
# the network's matrices in it; `weights`, `first`: where the CPU finds them. `sizes`: of the network, padded; `length`: of
# a row. All threads of a warp call them together.


@cache
def network_to_row(sizes: tuple[int, ...], length: int) -> Any:
    """A device function: the outputs of a network, times `share`, in half precision into the thread's row, from number
    `place` on."""

    def outputs(
        memory: Any,
        row: int,
        held: int,
        weights: wp.array(dtype=wp.float16),
        first: int,
        place: int,
        share: float,
    ):
        """See above."""

    on_warp = f"""
        #pragma unroll
        for (int r = 0; r < 2; ++r) {{
            const int of_row = first_row + group + 8 * r;
            const float factor = from_thread(share, of_row);
            #pragma unroll
            for (int n = 0; n < {sizes[-1] // 8}; ++n)
                *reinterpret_cast<unsigned*>(rows + of_row * {length} + place + 8 * n + pair) =
                    both(factor * sum[n][2 * r], factor * sum[n][2 * r + 1]);
        }}
    """
    on_host = f"for (int n = 0; n < {sizes[-1]}; ++n) own[place + n] = wp::half(share * sum[n]);"
    outputs.__name__ = outputs.__qualname__ = _name("network_to_row", sizes, length)
    return wp.func_native(_both(sizes, length, on_warp, on_host))(outputs)


@cache
def network(sizes: tuple[int, ...], length: int) -> Any:
    """A device function: the outputs of a network, in single precision at the beginning of the thread's row (`output`)."""

    def outputs(memory: Any, row: int, held: int, weights: wp.array(dtype=wp.float16), first: int):
        """See above."""

    on_warp = f"""
        #pragma unroll
        for (int r = 0; r < 2; ++r) {{
            float* to = reinterpret_cast<float*>(rows + (first_row + group + 8 * r) * {length}) + pair;
            #pragma unroll
            for (int n = 0; n < {sizes[-1] // 8}; ++n) {{
                to[8 * n] = sum[n][2 * r];
                to[8 * n + 1] = sum[n][2 * r + 1];
            }}
        }}
    """
    on_host = f"__builtin_memcpy(own, sum, {sizes[-1]} * sizeof(float));"
    outputs.__name__ = outputs.__qualname__ = _name("network", sizes, length)
    return wp.func_native(_both(sizes, length, on_warp, on_host))(outputs)


@cache
def network_to_pixels(sizes: tuple[int, ...], length: int, logits: bool) -> Any:
    """A device function: the scores of a network with `count` classes, as probabilities unless `logits`, times `weight`,
    added to row `pixel` of `pixels` (R, count); nothing is added where the weight is 0."""

    def scores(
        memory: Any,
        row: int,
        held: int,
        weights: wp.array(dtype=wp.float16),
        first: int,
        pixels: wp.array2d(dtype=float),
        pixel: int,
        weight: float,
        count: int,
    ):
        """See above."""

    probabilities = f"""
            float largest = -1e30f, total = 0.0f;
            #pragma unroll
            for (int n = 0; n < {sizes[-1] // 8}; ++n)
                #pragma unroll
                for (int e = 0; e < 2; ++e)
                    if (8 * n + pair + e < count) largest = fmaxf(largest, sum[n][2 * r + e]);
            largest = over_row(largest, [](float a, float b) {{ return fmaxf(a, b); }});
            #pragma unroll
            for (int n = 0; n < {sizes[-1] // 8}; ++n)
                #pragma unroll
                for (int e = 0; e < 2; ++e) {{
                    const float one = 8 * n + pair + e < count ? __expf(sum[n][2 * r + e] - largest) : 0.0f;
                    sum[n][2 * r + e] = one;
                    total += one;
                }}
            total = over_row(total, [](float a, float b) {{ return a + b; }});
            factor /= total;
    """
    on_warp = f"""
        #pragma unroll
        for (int r = 0; r < 2; ++r) {{
            const int of_row = first_row + group + 8 * r;
            float factor = from_thread(weight, of_row);
            float* to = pixels.data + size_t(from_thread(pixel, of_row)) * count;
            {"" if logits else probabilities}
            #pragma unroll
            for (int n = 0; n < {sizes[-1] // 8}; ++n)
                #pragma unroll
                for (int e = 0; e < 2; ++e) {{
                    const float value = factor * sum[n][2 * r + e];
                    // Less than half precision tells apart is not worth a write.
                    if (8 * n + pair + e < count && fabsf(value) > {LEAST_SCORE:g}f) atomicAdd(to + 8 * n + pair + e, value);
                }}
        }}
    """
    on_host = f"""
    float total = 1.0f;
    if (!{int(logits)}) {{
        float largest = -1e30f;
        for (int k = 0; k < count; ++k) largest = sum[k] > largest ? sum[k] : largest;
        total = 0.0f;
        for (int k = 0; k < count; ++k) total += sum[k] = wp::exp(sum[k] - largest);
    }}
    for (int k = 0; k < count; ++k) pixels.data[size_t(pixel) * count + k] += weight / total * sum[k];
    """
    scores.__name__ = scores.__qualname__ = _name("network_to_pixels", sizes, length) + ("_logits" if logits else "")
    return wp.func_native(_both(sizes, length, on_warp, on_host))(scores)


@cache
def keep_head(geometry: int) -> Any:
    """A device function: the outputs of a network in the thread's row, half precision, to row `place` of `features`
    (N, padded(geometry))."""

    def keep(memory: Any, row: int, features: wp.array2d(dtype=wp.float16), place: int):
        """See above."""

    size = padded(geometry)
    body = f"""
    wp::half* to = features.data + size_t(place) * {size};
    const float* values = memory.data.ptr + row / 2;
    wp::half halves[{size}];
    for (int k = 0; k < {size}; ++k) halves[k] = k < {geometry} ? wp::half(values[k]) : wp::half(0.0f);
#if defined(__CUDA_ARCH__)
    #pragma unroll
    for (int k = 0; k < {size}; k += 8) {{
        uint4 eight;
        unsigned* two = &eight.x;
        #pragma unroll
        for (int i = 0; i < 4; ++i) two[i] = halves[k + 2 * i].u | unsigned(halves[k + 2 * i + 1].u) << 16;
        *reinterpret_cast<uint4*>(to + k) = eight;
    }}
#else
    __builtin_memcpy(to, halves, sizeof(halves));
#endif
    """
    keep.__name__ = keep.__qualname__ = f"keep_head_{geometry}"
    return wp.func_native(body)(keep)


@cache
def read_head(geometry: int) -> Any:
    """A device function: row `index` of `features` (N, padded(geometry)) to the beginning of the thread's row."""

    def head(memory: Any, row: int, features: wp.array2d(dtype=wp.float16), index: int):
        """See above."""

    size = padded(geometry)
    body = f"""
    const wp::half* from = features.data + size_t(index) * {size};
#if defined(__CUDA_ARCH__)
    #pragma unroll
    for (int k = 0; k < {size}; k += 8)
        *reinterpret_cast<uint4*>(memory.data.ptr + (row + k) / 2) = *reinterpret_cast<const uint4*>(from + k);
#else
    __builtin_memcpy(memory.data.ptr + row / 2, from, {size} * sizeof(wp::half));
#endif
    """
    head.__name__ = head.__qualname__ = f"read_head_{geometry}"
    return wp.func_native(body)(head)
