"""Taichi and torch are started here, and nowhere else.

Global state of a process: Taichi and its arch (``start``), and the fields and kernels of ``masiv.mpm.simulator``.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import os
from collections.abc import Iterator
from typing import Any

from masiv.cores import available_cores
from masiv.errors import InputError

_started: str | None = None
ONE_THREAD: dict[str, str] = dict.fromkeys(
    ("TI_CPU_MAX_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
"""Environment variables that limit a process to one thread, if they are set before torch and Taichi are imported."""


def silence() -> None:
    """Keep Taichi from printing a line when it is imported: for what uses its definitions without starting it."""
    os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")


def start(arch: str = "cpu") -> Any:
    """Start Taichi on ``arch`` (cpu, cuda or vulkan), once a process, and return the ``taichi`` module.

    On a CPU it takes no more threads than ``available_cores``, unless ``TI_CPU_MAX_NUM_THREADS`` says otherwise.
    A second call with the same arch does nothing, since ``ti.init`` would destroy every field.
    Raises InputError for an unknown arch, for one that this machine lacks, and for a change of arch.
    """
    global _started
    silence()
    import taichi as ti

    if _started == arch:
        return ti
    if _started is not None:
        raise InputError(f"taichi already runs on {_started}; start a new process for --arch {arch}")
    known = {"cpu": ti.cpu, "cuda": ti.cuda, "vulkan": ti.vulkan}
    if arch not in known:
        raise InputError(f"unknown arch '{arch}': use one of {', '.join(known)}")
    cores = available_cores()
    limit: dict[str, Any] = {} if "TI_CPU_MAX_NUM_THREADS" in os.environ else {"cpu_max_num_threads": cores}
    if cores < (os.cpu_count() or 1):  # neither library knows of a container's limit
        import torch

        torch.set_num_threads(min(torch.get_num_threads(), cores))
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a banner, and stdout may be for one JSON object
        # One of Taichi's own passes is half of a kernel's compilation, and LLVM does its work again; see ``adjoint``.
        # It would warn of loops over more than 32 coefficients of an effect, which compile in seconds.
        ti.init(arch=known[arch], log_level=ti.ERROR, offline_cache=True, random_seed=0, cfg_optimization=False,
                unrolling_limit=0, **limit)  # fmt: skip
    atexit.register(ti.reset)  # writes the kernel cache, which the next command starts from
    running = _taichi_config().arch
    if arch != "cpu" and running != known[arch]:
        ti.reset()
        raise InputError(f"--arch {arch} is not available on this machine: use --arch cpu")
    _started = arch
    return ti


def start_on_one_thread(arch: str) -> Any:
    """Start Taichi and torch in this process, on one thread of a CPU. Returns the ``taichi`` module."""
    os.environ.update(ONE_THREAD)
    import torch

    ti = start(arch)
    torch.set_num_threads(1)
    return ti


def _taichi_config() -> Any:
    from taichi.lang import impl

    return impl.current_cfg()


def adjoint(kernel: Any, *arguments: Any) -> None:
    """Run the adjoint of ``kernel`` by Taichi's autodiff.

    It is compiled with the pass that ``start`` turns off: without it, Taichi 1.7.4 silently loses terms of a derivative
    in float32 (of v / (1 + c |v|) all of that by v). The switch is of the whole process: no other thread may compile a
    kernel at the same time.
    """
    config = _taichi_config()
    config.cfg_optimization = True
    try:
        kernel.grad(*arguments)
    finally:
        config.cfg_optimization = False


def running_arch() -> str:
    """The arch that Taichi runs on; cpu if it has not been started."""
    return _started or "cpu"


def check_float64(user: str) -> None:
    """Raises InputError on Vulkan, whose exp, log and sin are of float32 only; user: what needs float64."""
    if running_arch() == "vulkan":
        raise InputError(f"{user} needs float64, which --arch vulkan lacks: use --arch cpu or cuda")


def threads() -> int:
    """Threads of Taichi's kernels on a CPU."""
    return _taichi_config().cpu_max_num_threads


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run torch on ``count`` threads for a while. Small networks between Taichi kernels are faster on one: two pools of
    threads would spin against each other."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
