"""A warp of 32 host threads that runs what the fused renderer's device functions do on a GPU, compiled by the host's C++
compiler: the instructions of the matrix units and the exchanges between threads are emulated, see PTX ISA, “Warp-level
matrix instructions”."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from fieldwork.nerfcore.kernels.fused_network import INSTRUCTIONS

COMPILER = shutil.which("g++")

_INSTRUCTIONS = """
    const int thread = WP_TILE_THREAD_IDX & 31, group = thread >> 2, pair = 2 * (thread & 3);
    auto wait = [] { together.arrive_and_wait(); };
    auto load = [&](unsigned* to, const wp::half* from) {
        shown[thread].address = from;
        wait();
        for (int m = 0; m < 4; ++m) {
            const wp::half* row = shown[8 * m + group].address;
            to[m] = bits(row[pair]) | unsigned(bits(row[pair + 1])) << 16;
        }
        wait();
    };
    auto multiply = [&](float* sum, const unsigned* a, unsigned b0, unsigned b1) {
        for (int k = 0; k < 4; ++k) shown[thread].factors[k] = a[k];
        shown[thread].factors[4] = b0;
        shown[thread].factors[5] = b1;
        wait();
        for (int e = 0; e < 4; ++e) {
            const int row = group + 8 * (e >> 1), column = pair + (e & 1);
            for (int k = 0; k < 16; ++k) {
                const unsigned left = shown[4 * (row % 8) + k % 8 / 2].factors[(row >= 8) + 2 * (k >= 8)];
                const unsigned right = shown[4 * column + k % 8 / 2].factors[4 + (k >= 8)];
                sum[e] += number(left >> 16 * (k & 1)) * number(right >> 16 * (k & 1));
            }
        }
        wait();
    };
    auto both = [](float low, float high) { return bits(wp::half(low)) | unsigned(bits(wp::half(high))) << 16; };
    auto from_thread = [&](auto value, int other) {
        shown[thread].value = value;
        wait();
        const auto found = decltype(value)(shown[other].value);
        wait();
        return found;
    };
    auto over_row = [&](float value, auto join) {
        value = join(value, from_thread(value, thread ^ 1));
        return join(value, from_thread(value, thread ^ 2));
    };
"""

_PROGRAM = """
#include <barrier>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <mutex>
#include <thread>
#include <vector>
namespace wp { using half = _Float16; }
struct Shown { const wp::half* address; unsigned factors[6]; double value; } shown[32];
std::barrier together(32);
std::mutex one;
unsigned short bits(wp::half h) { unsigned short u; std::memcpy(&u, &h, 2); return u; }
float number(unsigned u) { unsigned short s = u; wp::half h; std::memcpy(&h, &s, 2); return h; }
void atomicAdd(float* to, float value) { std::lock_guard<std::mutex> lock(one); *to += value; }
float __expf(float x) { return std::exp(x); }
struct Tile { struct { float* ptr; } data; };
struct Pixels { float* data; };
void snippet(int WP_TILE_THREAD_IDX, Tile memory, int row, int held, int place, float share, Pixels pixels, int pixel,
             float weight, int count) {
SNIPPET
}
int main(int, char** names) {
    std::vector<float> memory(MEMORY), pixels(PIXELS), numbers(64);
    auto file = std::fopen(names[1], "rb");
    size_t got = std::fread(memory.data(), 4, memory.size(), file) + std::fread(numbers.data(), 4, 64, file);
    std::fclose(file);
    if (got != memory.size() + 64) return 1;
    std::vector<std::thread> threads;
    for (int t = 0; t < 32; ++t)
        threads.emplace_back([&, t] {
            snippet(t, {{memory.data()}}, HELD + t * LENGTH, 0, PLACE, numbers[t], {pixels.data()}, int(numbers[32 + t]), numbers[t], COUNT);
        });
    for (auto& thread : threads) thread.join();
    file = std::fopen(names[1], "wb");
    std::fwrite(memory.data(), 4, memory.size(), file);
    std::fwrite(pixels.data(), 4, pixels.size(), file);
    std::fclose(file);
}
"""


def run_warp(
    snippet: str,
    matrices: np.ndarray,
    rows: np.ndarray,
    factors: np.ndarray,
    folder: Path,
    pixel: Sequence[int] = (0,) * 32,
    place: int = 0,
    count: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Run a device function's snippet as a GPU compiles it.

    Args:
        matrices (N,), rows (32, length): float16, shared memory. factors (32,): share or weight of each thread.
    Returns:
        The rows afterwards, float16, and the pixels (32, count).
    """
    assert COMPILER is not None
    text = snippet.replace(INSTRUCTIONS, _INSTRUCTIONS)
    assert text != snippet
    memory = np.concatenate([matrices, rows.ravel()]).astype(np.float16)
    names = {
        "SNIPPET": text,
        "MEMORY": len(memory) // 2,
        "PIXELS": 32 * count,
        "HELD": len(matrices),
        "LENGTH": rows.shape[1],
        "PLACE": place,
        "COUNT": count,
    }
    program = _PROGRAM
    for name, value in names.items():
        program = program.replace(name, str(value))
    source, binary, data = folder / "warp.cpp", folder / "warp", folder / "memory"
    source.write_text(program, encoding="utf-8")
    options = ["-std=c++20", "-O1", "-pthread", "-fno-strict-aliasing", "-w", "-D__CUDA_ARCH__=900"]
    subprocess.run([COMPILER, *options, str(source), "-o", str(binary)], check=True)
    numbers = np.concatenate([factors, np.asarray(pixel)]).astype(np.float32)
    data.write_bytes(memory.tobytes() + numbers.tobytes())
    subprocess.run([str(binary), str(data)], check=True, timeout=60)
    found = data.read_bytes()
    end = 2 * len(memory)
    after = np.frombuffer(found[:end], np.float16)[len(matrices) :].reshape(rows.shape)
    return after, np.frombuffer(found[end:], np.float32).reshape(32, count)
