"""UV coordinates by xatlas, in processes that can be stopped."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import psutil

from ..errors import TrainingError
from ..files import disk_errors
from ..kernels.host import default_threads
from ..progress import Reporter
from .triangles import components

# xatlas takes longer than in proportion to the faces, docs/experiments.md, “Vector types of the CPU's compiler”.
CHUNK_FACES = 1_000
PACK_SIZE = 2048  # packing takes time in proportion to the area; charts then stand at steps of size / PACK_SIZE texels
CUT_SIZE = 2048  # texels for which charts are cut where the size is not known yet: small ones, as of wires, then come out larger
STANDSTILL = 30.0  # seconds without processor time, after which a process is started anew
COVERED = 0.6  # share of the texture that charts are scaled to cover
PADDING = 4  # texels between charts, as far as the packing's steps allow


@dataclass(frozen=True)
class UvMap:
    """Where each face lies on the texture.

    corners (F, 3, 2) UV of the faces' corners in [0, 1], v upwards; chart (F,) number of the connected piece; seams
    (E, 2) edges, as vertex indices, along which the texture is cut; utilization: share of the square that charts cover;
    size: of the texture that it is made for.
    """

    corners: np.ndarray
    chart: np.ndarray
    seams: np.ndarray
    utilization: float
    size: int


def unwrap(vertices: np.ndarray, faces: np.ndarray, size: int | Callable[[int], int], report: Reporter) -> UvMap:
    """Cut a mesh (V, 3), (F, 3) into charts of even scale and pack them into a square of `size` texels.

    Chunks of about `CHUNK_FACES` neighbouring faces are cut one by one, in as many processes as there are cores to use,
    and packed together at the end.

    Args:
        size: or what makes it of the number of charts.
    Raises:
        TrainingError: xatlas failed on the mesh. DiskError: no room for its temporary files.
        Cancelled: through `report`; the processes are gone then.
    """
    area = float(np.linalg.norm(np.cross(*_sides(vertices, faces)), axis=1).sum()) / 2
    if not np.isfinite(area) or area <= 0:
        raise TrainingError("The mesh has no area to unwrap.", "Extract it again.")
    vertices = _with_unit_faces(vertices, area / len(faces))
    chunks = spatial_chunks(vertices[faces].mean(1), CHUNK_FACES)
    cut_for = CUT_SIZE if callable(size) else size
    with tempfile.TemporaryDirectory(prefix="fieldwork-uv-") as name:
        folder = Path(name)
        with disk_errors(folder):
            for number, chunk in enumerate(chunks):
                used, corners = np.unique(faces[chunk], return_inverse=True)
                np.savez(
                    folder / f"in_{number}.npz",
                    vertices=vertices[used],
                    faces=corners.reshape(-1, 3),
                    texels_per_unit=np.sqrt(COVERED * cut_for**2 / len(faces)),
                )
        _work(folder, list(range(len(chunks))), report, 0.7, 0.0)
        order = np.concatenate(chunks)
        uv, corners = [], []
        for number in range(len(chunks)):
            with np.load(folder / f"out_{number}.npz", allow_pickle=False) as cut:
                corners.append(cut["faces"] + sum(map(len, uv)))
                uv.append(cut["uv"])
        joined, flat = np.concatenate(corners), np.concatenate(uv)
        chart = components(joined, len(flat)).astype(np.int32)
        if callable(size):
            size = size(int(chart.max()) + 1)
        step = max(1, size // PACK_SIZE)
        with disk_errors(folder):
            np.savez(
                folder / "in_pack.npz",
                uv=_apart(flat, joined, chart),
                faces=joined,
                resolution=size // step,
                padding=max(1, PADDING // step),
            )
        _work(folder, ["pack"], report, 0.3, 0.7)
        with np.load(folder / "out_pack.npz", allow_pickle=False) as packed:
            placed, utilization = np.empty((len(faces), 3, 2), np.float32), float(packed["utilization"])
            placed[order] = packed["corners"]
    placed = _settled(faces, placed)
    numbers = np.empty(len(faces), np.int32)
    numbers[order] = chart
    return UvMap(placed, numbers, seams(faces, placed), utilization, size)


def _sides(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    return b - a, c - a


def _with_unit_faces(vertices: np.ndarray, face_area: float) -> np.ndarray:
    """Vertices (V, 3) about the origin and scaled, so that a mean face, of area `face_area`, has an area of 1: xatlas leaves out
    faces below 1e-7, which in metres most faces of a small object are."""
    middle = (vertices.min(0).astype(np.float64) + vertices.max(0)) / 2
    return (vertices - middle) / np.sqrt(face_area)


def spatial_chunks(centers: np.ndarray, most: int) -> list[np.ndarray]:
    """Indices of points (N, 3) in groups of up to `most` that lie together: halves along the longest side, again."""
    done, open_ = [], [np.arange(len(centers))]
    while open_:
        part = open_.pop()
        if len(part) <= most:
            done.append(part)
            continue
        axis = int(np.ptp(centers[part], axis=0).argmax())
        ordered = part[np.argsort(centers[part, axis], kind="stable")]
        open_ += [ordered[: len(part) // 2], ordered[len(part) // 2 :]]
    return done


def _settled(faces: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """UV (F, 3, 2) with faces that xatlas left out, for want of area, as points at a neighbour's corner."""
    lost = ~((corners >= 0) & (corners <= 1)).all((1, 2))
    if not lost.any():
        return corners
    at_vertex = np.zeros((int(faces.max()) + 1, 2), np.float32)
    at_vertex[faces[~lost]] = corners[~lost]
    corners[lost] = at_vertex[faces[lost, :1]]
    return corners


def _apart(uv: np.ndarray, faces: np.ndarray, chart: np.ndarray) -> np.ndarray:
    """UV (N, 2) with the charts in rows beside each other: xatlas takes charts that touch for one."""
    owner = np.zeros(len(uv), np.int64)
    owner[faces] = chart[:, None]
    count = int(chart.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, owner, uv)
    np.maximum.at(high, owner, uv)
    sides = np.where(np.isfinite(low), high - low, 0) + 2
    row = np.floor(np.cumsum(sides[:, 0]) / max(np.sqrt(sides.prod(1).sum()), sides[:, 0].max())).astype(int)
    row = np.unique(row, return_inverse=True)[1]
    heights = np.zeros(row.max() + 1)
    np.maximum.at(heights, row, sides[:, 1])
    begin = np.cumsum(sides[:, 0]) - sides[:, 0]
    first = np.minimum.reduceat(begin, np.searchsorted(row, np.arange(row.max() + 1)))
    place = np.stack([begin - first[row], (np.cumsum(heights) - heights)[row]], 1)
    return (uv - np.where(np.isfinite(low), low, 0)[owner] + place[owner]).astype(np.float32)


def seams(faces: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Edges (E, 2) whose two faces have different UV (F, 3, 2) there."""
    follow = [1, 2, 0]
    ends = np.stack([faces, faces[:, follow]], -1).reshape(-1, 2)
    uv = np.stack([corners, corners[:, follow]], 2).reshape(-1, 2, 2)
    turned = ends[:, 0] > ends[:, 1]
    ends, uv = np.where(turned[:, None], ends[:, ::-1], ends), np.where(turned[:, None, None], uv[:, ::-1], uv)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    same = (ends[order[1:]] == ends[order[:-1]]).all(1)
    apart = np.abs(uv[order[1:]] - uv[order[:-1]]).max((1, 2)) > 1e-6
    return np.unique(ends[order[1:]][same & apart], axis=0)


def _worker(folder: Path, numbers: list, log: IO[bytes]) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", f"{__package__}.uv_worker", str(folder), *map(str, numbers)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    # A session of its own: Ctrl-C reaches us first, and we decide how it ends.
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait(timeout=10)
    if process.stdin is not None:
        process.stdin.close()


class _Pulse:
    """Whether a process has stood still: xatlas can wait for its own threads for ever when it frees an atlas."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process, self.used, self.since = process, -1.0, time.monotonic()

    def stopped(self) -> bool:
        """No processor time for `STANDSTILL` seconds."""
        now = time.monotonic()
        if self.process.poll() is not None or now - self.since < STANDSTILL:
            return False
        try:
            times = psutil.Process(self.process.pid).cpu_times()
        except psutil.NoSuchProcess:
            return False
        before, self.used, self.since = self.used, times.user + times.system, now
        return self.used == before


def _work(folder: Path, numbers: list, report: Reporter, share: float, before: float) -> None:
    """Let processes work off FOLDER/in_<number>.npz; progress goes from `before` up by `share`."""
    workers = min(default_threads(), len(numbers))
    shares = [numbers[worker::workers] for worker in range(workers)]
    processes: list[subprocess.Popen[bytes]] = []
    words = folder / "words.txt"
    there = lambda number: (folder / f"out_{number}.npz").is_file()  # noqa: E731
    try:
        with open(words, "wb") as log:
            processes += [_worker(folder, own, log) for own in shares]
            alive = [_Pulse(process) for process in processes]
        done = [0] * workers  # of each share, which is worked off in its order
        while any(process.poll() is None for process in processes):
            for index, own in enumerate(shares):
                while done[index] < len(own) and there(own[done[index]]):
                    done[index] += 1
            report.progress(before + share * sum(done) / len(numbers))
            if any(process.poll() for process in processes):
                break
            for index, pulse in enumerate(alive):
                if pulse.stopped():
                    _end(processes[index])
                    with open(words, "ab") as log:
                        processes[index] = _worker(folder, [n for n in shares[index] if not there(n)], log)
                    alive[index] = _Pulse(processes[index])
            time.sleep(0.05)
    finally:
        for process in processes:
            _end(process)
    missing = [number for number in numbers if not there(number)]
    if missing:
        last = words.read_text("utf-8", "replace").strip().splitlines()[-1:] or ["nothing"]
        raise TrainingError(
            f"Unwrapping the mesh failed: the process ended without a result; its last words: {last[0]}.",
            "Extract the mesh with fewer faces, or without a texture.",
        )
