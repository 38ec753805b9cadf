"""Time, memory and accuracy of MOESP, alone and beside two other implementations.

    python benchmarks/subspace.py                 everything but the disk run
    python benchmarks/subspace.py --disk          1e7 samples streamed from disk
    python benchmarks/subspace.py --disk --samples 1000000

nfoursid and ctrlsys (SLICOT's QR) are optional: what is missing is said and left out.
Set OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1 for figures that compare.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
import tracemalloc
import warnings
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import numpy.typing as npt

from identification.linear.hankel_qr import Method
from identification.linear.subspace import moesp

FloatArray = npt.NDArray[np.float64]
BLOCK_ROWS, ORDER = 20, 4
METHODS: tuple[Method, ...] = ("ordinary", "past_output")


def known_system() -> tuple[FloatArray, ...]:
    """Two lightly damped modes, three inputs, two outputs."""
    modes = [(0.97, 0.15), (0.93, 0.6)]
    a = np.zeros((4, 4))
    for k, (size, angle) in enumerate(modes):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        a[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = size * turn
    b = np.array([[0.1, 0.05, 0.0], [0.0, 0.1, 0.02], [0.0, -0.1, 0.1], [0.05, 0.0, 0.1]])
    c = np.array([[1.0, 0.0, 1.0, 0.0], [1.0, 0.2, -0.3, 0.0]])
    return a, b, c, np.zeros((2, 3))


def record(samples: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Inputs and noisy outputs of the known system, float64, 5 channels."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    a, b, c, _ = known_system()
    u = lfilter([0.2], [1.0, -0.8], rng.standard_normal((samples, 3)), axis=0)
    driven = u @ b.T
    poles = np.diag(a)[::2] + 1j * np.diag(a, 1)[::2]
    # z = x1 - i x2 of each mode obeys z(k+1) = pole z(k) + input
    states = np.empty((samples, 4))
    for k, pole in enumerate(poles):
        forced = driven[:, 2 * k] - 1j * driven[:, 2 * k + 1]
        z = lfilter([0.0, 1.0], [1.0, -pole], forced)
        states[:, 2 * k], states[:, 2 * k + 1] = z.real, -z.imag
    return u, states @ c.T + 0.01 * rng.standard_normal((samples, 2))


def pole_error(a: FloatArray) -> float:
    """Largest distance of the poles from the true ones."""
    found, true = np.linalg.eigvals(a), np.linalg.eigvals(known_system()[0])
    return float(max(np.abs(found - pole).min() for pole in true))


def timed(function: Callable[[], FloatArray], repeats: int = 3) -> tuple[float, FloatArray]:
    """Shortest of some wall-clock times, and the result."""
    best, result = np.inf, np.empty(0)
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        best = min(best, time.perf_counter() - start)
    return best, result


def alone(samples: int) -> None:
    """Time and memory of moesp for several block rows."""
    u, y = record(samples)
    moesp(u[:3000], y[:3000])
    print(f"\nmoesp, {samples} samples x 5 channels")
    print(
        f"{'method':>12} {'i':>3} {'order':>6} {'seconds':>8} {'extra MB':>9} {'pole error':>11} "
        " VAF %"
    )
    for method in METHODS:
        for rows in (10, 20, 30):
            for order in (ORDER, None):
                start = time.perf_counter()
                sub = moesp(u, y, rows, order, method=method)
                seconds = time.perf_counter() - start
                tracemalloc.start()
                moesp(u, y, rows, order, method=method)
                peak = tracemalloc.get_traced_memory()[1] / 1e6
                tracemalloc.stop()
                name = f"{sub.order}" if order else f"({sub.order})"
                error, vaf = pole_error(sub.system.A), np.round(sub.vaf_percent, 3)
                print(
                    f"{method:>12} {rows:>3} {name:>6} {seconds:8.3f} {peak:9.1f} {error:11.2e}  "
                    f"{vaf}"
                )


def against_nfoursid(samples: int) -> None:
    """The same identification by nfoursid (N4SID with a stored Hankel matrix)."""
    if find_spec("nfoursid") is None:
        print("\nnfoursid is not installed: left out")
        return
    import pandas as pd
    from nfoursid.nfoursid import NFourSID

    u, y = record(samples)
    inputs, outputs = [f"u{k}" for k in range(3)], [f"y{k}" for k in range(2)]
    frame = pd.DataFrame(np.hstack((u, y)), columns=inputs + outputs)

    def theirs() -> FloatArray:
        identifier = NFourSID(
            frame, output_columns=outputs, input_columns=inputs, num_block_rows=BLOCK_ROWS
        )
        identifier.subspace_identification()
        return np.asarray(identifier.system_identification(rank=ORDER)[0].a)

    def ours(method: Method) -> FloatArray:
        return np.asarray(moesp(u, y, BLOCK_ROWS, ORDER, method=method).system.A)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        their_time, their_a = timed(theirs, repeats=1)
    print(f"\nagainst nfoursid, {samples} samples, i = {BLOCK_ROWS}, order {ORDER}")
    print(f"nfoursid           {their_time:9.3f} s   pole error {pole_error(their_a):.2e}")
    for method in METHODS:
        our_time, our_a = timed(partial(ours, method))
        ratio = their_time / our_time
        print(
            f"moesp {method:<12} {our_time:9.3f} s   pole error {pole_error(our_a):.2e}   "
            f"{ratio:.0f} times faster"
        )


def against_slicot(samples: int) -> None:
    """The compression and singular values of SLICOT's IB01AD, through ctrlsys, against QR and
    fast compression.
    """
    if find_spec("ctrlsys") is None:
        print("\nctrlsys is not installed: left out")
        return
    import ctrlsys

    from identification.linear.hankel_gram import HankelGram
    from identification.linear.subspace import HankelQR

    u, y = record(samples)
    columns_u, columns_y = np.asfortranarray(u), np.asfortranarray(y)

    def theirs(algorithm: str) -> FloatArray:
        arguments = (
            "M",
            algorithm,
            "N",
            "O",
            "N",
            "N",
            BLOCK_ROWS,
            3,
            2,
            columns_u,
            columns_y,
            0.0,
            -1.0,
        )
        return np.asarray(ctrlsys.ib01ad(*arguments)[2])

    def ours(fast: bool) -> FloatArray:
        qr = HankelQR(3, 2, BLOCK_ROWS, "past_output")
        accumulator = HankelGram(qr) if fast else qr
        for start in range(0, samples, 8192):
            accumulator.add(u[start : start + 8192], y[start : start + 8192])
        return accumulator.factor().directions()[1]

    print(
        f"\nsingular values against SLICOT (ctrlsys), {samples} samples, i = {BLOCK_ROWS}, past "
        "outputs; shortest of some runs"
    )
    qr_time, qr_values = timed(partial(ours, False))
    fast_time, fast_values = timed(partial(ours, True), repeats=7)
    print(f"QR                     {qr_time:6.3f} s")
    print(
        f"fast                   {fast_time:6.3f} s   relative difference to QR "
        f"{np.abs(fast_values / qr_values - 1.0).max():.1e}"
    )
    for algorithm, name in (("Q", "Householder QR"), ("F", "fast QR"), ("C", "Cholesky")):
        their_time, their_values = timed(
            partial(theirs, algorithm), repeats=2 if algorithm == "Q" else 7
        )
        difference = np.abs(qr_values / their_values - 1.0).max()
        print(
            f"SLICOT {name:<15} {their_time:6.3f} s   {their_time / qr_time:4.1f} times our QR, "
            f"{their_time / fast_time:4.1f} times our fast one"
            f"   relative difference to QR {difference:.1e}"
        )


def own_memory() -> float:
    """Resident memory of this process in MB, pages of mapped files included."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return float(line.split()[1]) / 1024
    return float("nan")


def write_record(folder: str, samples: int) -> None:
    """Write u.npy and y.npy of the known system."""
    u = np.lib.format.open_memmap(f"{folder}/u.npy", "w+", np.float64, (samples, 3))
    y = np.lib.format.open_memmap(f"{folder}/y.npy", "w+", np.float64, (samples, 2))
    for k, start in enumerate(range(0, samples, 500_000)):
        part_u, part_y = record(min(500_000, samples - start), seed=k)
        u[start : start + len(part_u)], y[start : start + len(part_y)] = part_u, part_y
    u.flush()
    y.flush()


def from_disk(samples: int) -> None:
    """Streamed from memory-mapped files: time and highest memory above the start."""
    with tempfile.TemporaryDirectory() as folder:
        # in a process of its own, so that its memory is not counted
        writer = get_context("spawn").Process(target=write_record, args=(folder, samples))
        writer.start()
        writer.join()
        u, y = np.load(f"{folder}/u.npy", mmap_mode="r"), np.load(f"{folder}/y.npy", mmap_mode="r")
        moesp(u[:3000], y[:3000])
        print(f"\nstreamed from disk, {samples} samples x 5 channels, i = {BLOCK_ROWS}")
        for method in METHODS:
            for order in (ORDER, None):
                base, highest, stop = own_memory(), [0.0], threading.Event()

                def watch(highest: list[float] = highest, stop: threading.Event = stop) -> None:
                    while not stop.wait(0.02):
                        highest[0] = max(highest[0], own_memory())

                watcher = threading.Thread(target=watch)
                watcher.start()
                start_time = time.perf_counter()
                sub = moesp(u, y, BLOCK_ROWS, order, method=method)
                seconds = time.perf_counter() - start_time
                stop.set()
                watcher.join()
                name = f"{sub.order}" if order else f"({sub.order})"
                error, extra = pole_error(sub.system.A), highest[0] - base
                print(
                    f"{method:>12} order {name:>4} {seconds:7.1f} s   extra {extra:6.1f} MB   "
                    f"whole process {highest[0]:6.1f} MB   pole error {error:.2e}"
                )


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--disk", action="store_true", help="only the run from disk")
    parser.add_argument(
        "--samples", type=int, default=10_000_000, help="samples of the run from disk"
    )
    arguments = parser.parse_args()
    if arguments.disk:
        from_disk(arguments.samples)
        return
    alone(100_000)
    against_nfoursid(10_000)
    against_slicot(100_000)


if __name__ == "__main__":
    main()
