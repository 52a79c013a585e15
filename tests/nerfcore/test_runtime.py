"""Launching kernels from many threads."""

import subprocess
import sys

import pytest
import torch
from fieldwork.nerfcore.kernels import blocks, runtime

FIRST_USE = """
import threading, torch
torch.set_num_threads(4)
from fieldwork.nerfcore.kernels import runtime
real, running, most = runtime.wp.init, [0], [0]
def slow():
    running[0] += 1
    most[0] = max(most[0], running[0])
    threading.Event().wait(0.2)
    real()
    running[0] -= 1
runtime.wp.init = slow
threads = [threading.Thread(target=runtime.init) for _ in range(8)]
[t.start() for t in threads]
[t.join() for t in threads]
print(most[0])
"""


def test_warp_is_started_by_one_thread_only():
    done = subprocess.run([sys.executable, "-c", FIRST_USE], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "1"


def test_results_come_in_the_order_of_the_tasks_and_nested_calls_stay_in_their_thread():
    import threading

    import torch
    from fieldwork.nerfcore.kernels.runtime import run_parallel

    cpu, before = torch.device("cpu"), torch.get_num_threads()
    torch.set_num_threads(3)
    try:

        def outer(k):
            here = threading.get_ident()
            return [
                k * 10 + j
                for j, thread in run_parallel([lambda j=j: (j, threading.get_ident()) for j in range(3)], cpu)
                if thread == here
            ]

        assert run_parallel([lambda k=k: outer(k) for k in range(5)], cpu) == [
            [10 * k + j for j in range(3)] for k in range(5)
        ]
    finally:
        torch.set_num_threads(before)


def test_host_threads_serve_the_cpu_only():
    import threading

    import torch
    from fieldwork.nerfcore.kernels.device import using_kernels
    from fieldwork.nerfcore.kernels.runtime import run_parallel

    def threads(device):
        return set(run_parallel([threading.get_ident] * 8, device))

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert threading.get_ident() not in threads(torch.device("cpu"))
        assert threads(torch.device("cuda")) == {threading.get_ident()}
        assert threads(torch.device("mps")) == {threading.get_ident()}
        with using_kernels("torch"):
            assert threads(torch.device("cpu")) == {threading.get_ident()}
    finally:
        torch.set_num_threads(before)


QUIET = """
import os
from fieldwork.nerfcore.kernels import runtime
runtime.nvidia_gpu = lambda: {gpu}
real = runtime.wp.init
def told():
    real()
    os.write(2, b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution ...\\nanother line\\n")
runtime.wp.init = told
runtime.init()
os.write(2, b"afterwards\\n")
"""


@pytest.mark.parametrize("gpu", [False, True])
def test_a_machine_without_a_gpu_is_not_told_that_its_driver_is_missing(gpu: bool):
    done = subprocess.run([sys.executable, "-c", QUIET.format(gpu=gpu)], capture_output=True, text=True, check=True)
    assert ("CUDA driver" in done.stderr) == gpu
    assert done.stderr.splitlines()[-2:] == ["another line", "afterwards"]


def test_kernels_follow_torch_on_its_current_stream(monkeypatch):
    """Without a GPU: which stream a launch names."""
    launched = []
    monkeypatch.setattr(runtime, "load", lambda kernel, device: None)
    monkeypatch.setattr(runtime.torch.cuda, "current_stream", lambda device: f"current of {device}")
    monkeypatch.setattr(runtime.wp, "stream_from_torch", lambda stream: f"Warp's view of {stream}")
    monkeypatch.setattr(runtime.wp, "device_from_torch", lambda name: name)
    monkeypatch.setattr(runtime.wp, "launch", lambda kernel, **how: launched.append(how))
    device = torch.device("cuda:1")
    runtime.launch(None, 1000, ["a"], device)
    assert launched == [
        {"dim": 1000, "inputs": ["a", 0], "device": "cuda:1", "stream": "Warp's view of current of cuda:1"}
    ]
    launched.clear()
    monkeypatch.setattr(blocks, "load_blocks", lambda kernel, lanes, device: None)
    blocks.launch_blocks(None, 3, 64, ["a"], device)
    assert [how["stream"] for how in launched] == ["Warp's view of current of cuda:1"]
    assert launched[0]["dim"] == 3 * 64
