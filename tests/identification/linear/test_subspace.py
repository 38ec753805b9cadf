"""MOESP against published figures, SLICOT itself, and systems known in advance."""

from __future__ import annotations

import ctypes
import os
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from identification.errors import InputError
from identification.linear.subspace import (
    HankelQR,
    MoespOptions,
    SubspaceOutcome,
    UnstableModelWarning,
    moesp,
    moesp_chunks,
)

FloatArray = npt.NDArray[np.float64]
DAISY = Path(__file__).resolve().parents[3].parent / "shared" / "measurements" / "daisy"

A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.7]])
B = np.array([[1.0, 0.0], [0.5, 1.0], [0.0, -1.0]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
D = np.array([[0.1, 0.0], [0.0, -0.2]])


@pytest.fixture
def daisy() -> Path:
    if not DAISY.is_dir():
        message = "the measurements folder ../shared/measurements/daisy is missing"
        pytest.fail(message) if os.environ.get("CI") else pytest.skip(message)
    return DAISY


def reference_response(u: FloatArray, x0: FloatArray) -> FloatArray:
    x, rows = x0, []
    for sample in u:
        rows.append(C @ x + D @ sample)
        x = A @ x + B @ sample
    return np.array(rows)


def known_record(
    samples: int, seed: int, noise: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    u, x0 = rng.standard_normal((samples, 2)), rng.standard_normal(3)
    return u, reference_response(u, x0) + noise * rng.standard_normal((samples, 2)), x0


def poles(a: FloatArray) -> npt.NDArray[np.complex128]:
    return np.sort_complex(np.linalg.eigvals(a).astype(np.complex128))


def markov(a: FloatArray, b: FloatArray, c: FloatArray, count: int = 10) -> FloatArray:
    return np.array([c @ np.linalg.matrix_power(a, k) @ b for k in range(count)])


def slicot_example(folder: Path, name: str) -> tuple[FloatArray, FloatArray]:
    lines = (folder / name).read_text().splitlines()
    start = next(index for index, line in enumerate(lines) if index > 1 and len(line.split()) == 1)
    values = np.array(" ".join(lines[start:]).split(), dtype=np.float64)
    assert len(values) == 2000
    return values[:1000], values[1000:]


def relative_norm1(y: FloatArray, simulated: FloatArray) -> float:
    return float(np.linalg.norm(y - simulated, 1) / np.linalg.norm(y, 1))


# --- systems known in advance -------------------------------------------------------------------


@pytest.mark.parametrize("method", ["ordinary", "past_output"])
@pytest.mark.parametrize("input_matrices", ["simulation", "shift"])
def test_noise_free_system_is_recovered(method: str, input_matrices: str) -> None:
    u, y, x0 = known_record(600, 1)
    sub = moesp(u, y, 8, 3, 0.01, method, options=MoespOptions(input_matrices=input_matrices))  # type: ignore[arg-type]
    assert poles(sub.system.A) == pytest.approx(poles(A), abs=1e-9)
    assert markov(sub.system.A, sub.system.B, sub.system.C) == pytest.approx(
        markov(A, B, C), abs=1e-9
    )
    assert np.abs(sub.system.D - D).max() < 1e-9
    assert sub.system.C @ sub.x0[0] == pytest.approx(C @ x0, abs=1e-9)
    assert sub.vaf_percent == pytest.approx([100.0, 100.0], abs=1e-9)
    assert sub.singular_values[3] < 1e-10 * sub.singular_values[0]
    assert sub.system.dt == 0.01
    assert sub.outcome is SubspaceOutcome.ORDER_GIVEN


@pytest.mark.parametrize("method", ["ordinary", "past_output"])
def test_order_of_a_known_system_is_found(method: str) -> None:
    u, y, _ = known_record(3000, 2, noise=0.05)
    sub = moesp(u, y, 10, method=method)  # type: ignore[arg-type]
    assert sub.order == 3
    assert sub.outcome is SubspaceOutcome.ORDER_CHOSEN
    assert sub.held_out_vaf_percent == pytest.approx(sub.vaf_percent, abs=0.1)


def test_every_record_has_its_own_initial_state_and_no_row_spans_two() -> None:
    parts = [known_record(samples, seed) for seed, samples in enumerate((150, 40, 333, 90))]
    sub = moesp([part[0] for part in parts], [part[1] for part in parts], 8, 3)
    # rows across a border would mix two unrelated states and leave a fourth singular value
    assert sub.singular_values[3] < 1e-10 * sub.singular_values[0]
    for (u, y, _), x0 in zip(parts, sub.x0, strict=True):
        assert sub.simulate(u, x0) == pytest.approx(y, abs=1e-8)
    joined = moesp(
        np.vstack([part[0] for part in parts]), np.vstack([part[1] for part in parts]), 8, 3
    )
    assert joined.singular_values[3] > 1e-3 * joined.singular_values[0]


def test_vaf_is_that_of_the_simulated_response() -> None:
    u, y, _ = known_record(777, 5, noise=0.7)
    y = y + np.array([0.3, -0.2])
    sub = moesp(u, y, 8, 2)
    error = y - sub.simulate(u, sub.x0[0])
    assert sub.vaf_percent == pytest.approx(100 * (1 - error.var(axis=0) / y.var(axis=0)), abs=1e-8)


def test_b_d_and_x0_are_the_least_squares_solution() -> None:
    u, y, _ = known_record(300, 6, noise=0.5)
    sub = moesp(u, y, 8, 2)
    columns = [sub.simulate(np.zeros_like(u), unit).ravel() for unit in np.eye(2)]
    error = (y - sub.simulate(u, sub.x0[0])).ravel()
    for channel in range(2):
        x = np.zeros((2, 2))
        rows = []
        for sample in u:
            rows.append(sub.system.C @ x)
            x = sub.system.A @ x + np.eye(2) * sample[channel]
        columns.extend(np.array(rows).transpose(2, 0, 1).reshape(2, -1))
        for output in range(2):
            direct = np.zeros_like(y)
            direct[:, output] = u[:, channel]
            columns.append(direct.ravel())
    for column in columns:
        assert abs(column @ error) < 1e-9 * np.linalg.norm(column) * np.linalg.norm(error)


def test_past_output_is_unbiased_under_process_noise_where_ordinary_is_not() -> None:
    rng = np.random.default_rng(7)
    u, shocks = rng.standard_normal((40_000, 2)), 3.0 * rng.standard_normal((40_000, 2))
    gain = np.array([[0.5, 0.0], [0.0, 0.5], [0.3, 0.3]])
    x, rows = np.zeros(3), []
    for sample, shock in zip(u, shocks, strict=True):
        rows.append(C @ x + D @ sample + shock)
        x = A @ x + B @ sample + gain @ shock
    truth = np.sort(np.abs(np.linalg.eigvals(A)))
    error = {}
    for method in ("ordinary", "past_output"):
        sub = moesp(u, np.array(rows), 10, 3, method=method)
        error[method] = np.abs(np.sort(np.abs(np.linalg.eigvals(sub.system.A))) - truth).max()
    assert error["past_output"] < 0.02
    assert error["past_output"] < 0.2 * error["ordinary"]


@pytest.mark.parametrize("method", ["ordinary", "past_output"])
def test_smooth_inputs_do_not_spoil_the_model(method: str) -> None:
    """Position, velocity and acceleration of one motion as inputs: nearly dependent block rows."""
    time_s = np.arange(20_000) * 1e-3
    tones = [(0.3, 1.0, 0.0), (0.71, 0.6, 1.0), (1.3, 0.4, 2.0), (2.9, 0.2, 0.5), (5.3, 0.05, 4.0)]
    motion = np.zeros((len(time_s), 3))
    for hertz, size, phase in tones:
        w = 2 * np.pi * hertz
        angle = w * time_s + phase
        motion += size * np.column_stack((np.sin(angle), w * np.cos(angle), -w * w * np.sin(angle)))
    rng = np.random.default_rng(3)
    measured = motion + rng.standard_normal(motion.shape) * [1e-5, 1e-3, 1e-1]
    y = reference_response(measured[:, 1:] * [1.0, 0.02], np.zeros(3))
    y += 1e-3 * y.std(axis=0) * rng.standard_normal(y.shape)
    sub = moesp(measured, y, 20, 3, 1e-3, method)  # type: ignore[arg-type]
    assert sub.spectral_radius < 1.0
    assert np.all(sub.vaf_percent > 99.99)


def test_output_weights_change_the_weighting_not_the_model() -> None:
    u, y, _ = known_record(500, 8)
    sub = moesp(u, y, 8, 3, options=MoespOptions(output_weights=(1.0, 250.0)))
    assert markov(sub.system.A, sub.system.B, sub.system.C) == pytest.approx(
        markov(A, B, C), abs=1e-8
    )
    assert np.abs(sub.system.D - D).max() < 1e-9
    assert sub.singular_values[0] > 50 * moesp(u, y, 8, 3).singular_values[0]


def test_names_reach_the_system() -> None:
    u, y, _ = known_record(300, 9)
    names = MoespOptions(
        input_names=("motor_current", "load"), output_names=("motor_position", "link_position")
    )
    system = moesp(u, y, 5, 3, 1e-3, options=names).system
    assert system.input_labels == ["motor_current", "load"]
    assert system.output_labels == ["motor_position", "link_position"]


# --- instability is said ------------------------------------------------------------------------


def unstable_record(pole: float, samples: int) -> tuple[FloatArray, FloatArray]:
    u = np.random.default_rng(10).standard_normal(samples)
    y = np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = pole * y[k] + u[k]
    return u, y


@pytest.mark.parametrize("order", [1, None])
@pytest.mark.parametrize(("pole", "samples"), [(1.02, 300), (1.02, 3000)])
def test_an_unstable_model_is_never_returned_silently(
    order: int | None, pole: float, samples: int
) -> None:
    u, y = unstable_record(pole, samples)
    with pytest.warns(UnstableModelWarning, match="spectral radius"):
        sub = moesp(u, y, 6, order)
    assert sub.outcome is SubspaceOutcome.UNSTABLE
    assert sub.spectral_radius >= 1.0


def test_an_unstable_order_is_not_chosen_where_a_stable_one_exists(daisy: Path) -> None:
    data = np.loadtxt(daisy / "robot_arm.csv", delimiter=",", skiprows=1)
    sub = moesp(
        data[:, 0], data[:, 1], 20, method="past_output", options=MoespOptions(max_order=16)
    )
    assert any(candidate.spectral_radius >= 1.0 for candidate in sub.candidates)
    assert sub.order == 4
    assert sub.spectral_radius < 1.0


# --- published figures --------------------------------------------------------------------------


def test_singular_values_are_those_slicot_prints(daisy: Path) -> None:
    printed = np.array(
        (daisy / "slicot_IB01AD.res").read_text().split("values are")[1].split(), dtype=np.float64
    )
    u, y = slicot_example(daisy, "slicot_IB01AD.dat")
    sub = moesp(u, y, 15, 4, method="past_output")
    assert np.abs(sub.singular_values - printed).max() <= 0.5e-4 + 1e-12
    assert float(sub.system.D[0, 0]) == pytest.approx(-0.0018, abs=0.5e-4)


def test_poles_are_those_of_the_state_matrix_slicot_prints(daisy: Path) -> None:
    text = (
        (daisy / "slicot_IB01BD.res")
        .read_text()
        .split("matrix A is")[1]
        .split("The system output")[0]
    )
    printed = np.array(text.split(), dtype=np.float64).reshape(4, 4)
    u, y = slicot_example(daisy, "slicot_IB01BD.dat")
    sub = moesp(u, y, 15, 4, method="past_output")
    # four printed decimals of A: its characteristic polynomial agrees to about 1e-3
    assert np.poly(sub.system.A) == pytest.approx(np.poly(printed), abs=1e-3)


def test_robot_arm_error_is_the_published_one(daisy: Path) -> None:
    data = np.loadtxt(daisy / "robot_arm.csv", delimiter=",", skiprows=1)
    sub = moesp(data[:, :1], data[:, 1:], 20, 4, method="past_output")
    assert relative_norm1(data[:, 1:], sub.simulate(data[:, :1], sub.x0[0])) == pytest.approx(
        0.0360, rel=0.01
    )
    assert moesp(data[:, 0], data[:, 1], 20, method="past_output").order == 4


def test_cd_arm_error_is_the_published_one(daisy: Path) -> None:
    data = np.loadtxt(daisy / "cd_player_arm.csv", delimiter=",", skiprows=1)
    trend = np.column_stack((np.ones(len(data)), np.arange(len(data))))
    data = data - trend @ np.linalg.lstsq(trend, data, rcond=None)[0]
    sub = moesp(data[:, :2], data[:, 2:], 15, 8, method="past_output")
    assert relative_norm1(data[:, 2:], sub.simulate(data[:, :2], sub.x0[0])) == pytest.approx(
        0.176, rel=0.01
    )


# --- SLICOT as an oracle ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def slicot() -> ctypes.CDLL:
    try:
        return ctypes.CDLL("libslicot.so.0")
    except OSError:
        message = "libslicot.so.0 is missing: install the Debian package libslicot0"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)


class Slicot:
    """IB01AD and IB01BD for MOESP with past inputs and outputs, by Householder QR."""

    def __init__(self, library: ctypes.CDLL, u: FloatArray, y: FloatArray, block_rows: int) -> None:
        self.library = library
        self.shape = (block_rows, u.shape[1], y.shape[1], len(u))
        columns = 2 * (u.shape[1] + y.shape[1]) * block_rows
        work = np.zeros(200_000 + 20 * columns * columns)
        self.r = np.zeros((columns, columns), order="F")
        self.singular_values = np.zeros(y.shape[1] * block_rows)
        self.order = np.zeros(1, dtype=np.int32)
        samples = len(u)
        self.call(
            "ib01ad_",
            ["M", "Q", "N", "O", "N", "N"],
            list(self.shape),
            np.asfortranarray(u),
            samples,
            np.asfortranarray(y),
            samples,
            self.order,
            self.r,
            columns,
            self.singular_values,
            0.0,
            -1.0,
            np.zeros(10 * columns, dtype=np.int32),
            work,
            len(work),
        )

    def call(self, name: str, letters: list[str], numbers: list[int], *rest: object) -> None:
        warning, info = np.zeros(1, dtype=np.int32), np.zeros(1, dtype=np.int32)
        arguments: list[object] = [ctypes.c_char_p(letter.encode()) for letter in letters]
        for value in (*numbers, *rest, warning, info):
            if isinstance(value, np.ndarray):
                arguments.append(ctypes.c_void_p(value.ctypes.data))
            elif isinstance(value, float):
                arguments.append(ctypes.byref(ctypes.c_double(value)))
            else:
                assert isinstance(value, int)
                arguments.append(ctypes.byref(ctypes.c_int(value)))
        arguments += [ctypes.c_size_t(1)] * len(letters)
        getattr(self.library, name)(*arguments)
        assert info[0] == 0

    def state_matrix(self, order: int) -> FloatArray:
        block_rows, inputs, outputs, samples = self.shape
        a, c = np.zeros((order, order), order="F"), np.zeros((outputs, order), order="F")
        unused = np.zeros((order + outputs, order + outputs + inputs), order="F")
        size = 200_000 + 20 * len(self.r) ** 2
        self.call(
            "ib01bd_",
            ["M", "C", "N"],
            [block_rows, order, inputs, outputs, samples],
            self.r,
            len(self.r),
            a,
            order,
            c,
            outputs,
            unused,
            order,
            unused.copy(),
            outputs,
            unused.copy(),
            order,
            unused.copy(),
            outputs,
            unused.copy(),
            order,
            unused.copy(),
            order,
            -1.0,
            np.zeros(10 * len(self.r), dtype=np.int32),
            np.zeros(size),
            size,
            np.zeros(4 * order, dtype=np.int32),
        )
        return a


@pytest.mark.parametrize(
    ("name", "inputs", "block_rows", "order"),
    [("robot_arm", 1, 20, 4), ("cd_player_arm", 2, 15, 8)],
)
def test_slicot_gives_the_same_poles_and_singular_values(
    slicot: ctypes.CDLL, daisy: Path, name: str, inputs: int, block_rows: int, order: int
) -> None:
    data = np.loadtxt(daisy / f"{name}.csv", delimiter=",", skiprows=1)
    u, y = data[:, :inputs], data[:, inputs:]
    oracle = Slicot(slicot, u, y, block_rows)
    sub = moesp(u, y, block_rows, order, method="past_output")
    assert sub.singular_values == pytest.approx(oracle.singular_values, rel=1e-8)
    assert poles(sub.system.A) == pytest.approx(poles(oracle.state_matrix(order)), abs=1e-8)


# --- streaming ----------------------------------------------------------------------------------


def same_triangle(one: HankelQR, other: HankelQR) -> bool:
    r, s = one.factor().triangle, other.factor().triangle
    gram = r.T @ r
    return bool(np.abs(gram - s.T @ s).max() < 1e-11 * np.abs(gram).max())


@pytest.mark.parametrize("method", ["ordinary", "past_output"])
def test_the_triangle_is_that_of_the_whole_hankel_matrix(method: str) -> None:
    u, y, _ = known_record(2500, 11, noise=0.1)
    i = 4
    qr = HankelQR(2, 2, i, method)  # type: ignore[arg-type]
    for start, stop in ((0, 3), (3, 4), (4, 1700), (1700, 2500)):
        qr.add(u[start:stop], y[start:stop])
    window = i if method == "ordinary" else 2 * i
    hankel = [
        np.hstack([signal[k : len(signal) - window + 1 + k] for k in range(window)])
        for signal in (u, y)
    ]
    past = 2 * (window - i)
    order = (hankel[0][:, past:], hankel[0][:, :past], hankel[1])
    tall = np.hstack(order)
    r = qr.factor().triangle
    assert r.T @ r == pytest.approx(tall.T @ tall, rel=1e-10, abs=1e-8)
    assert qr.rows == len(tall)
    assert np.array_equal(r, np.triu(r))


def test_accumulators_merge() -> None:
    u, y, _ = known_record(2000, 12)
    whole, first, second = (HankelQR(2, 2, 5) for _ in range(3))
    for start, stop, part in ((0, 900, first), (900, 2000, second)):
        for qr in (whole, part):
            qr.add(u[start:stop], y[start:stop])
            qr.end_record()
    first.merge(second)
    assert first.rows == whole.rows
    assert same_triangle(first, whole)
    with pytest.raises(InputError, match="merged"):
        first.merge(HankelQR(2, 2, 6))


def test_an_accumulator_restarts_in_the_middle_of_a_record(tmp_path: Path) -> None:
    u, y, _ = known_record(2000, 13)
    whole, broken = HankelQR(2, 2, 5, "past_output"), HankelQR(2, 2, 5, "past_output")
    whole.add(u, y)
    broken.add(u[:777], y[:777])
    np.savez(tmp_path / "state.npz", **broken.state())  # type: ignore[arg-type]
    again = HankelQR(2, 2, 5, "past_output")
    with np.load(tmp_path / "state.npz") as stored:
        again.restore(stored)
    again.add(u[777:], y[777:])
    assert again.rows == whole.rows
    assert same_triangle(again, whole)


@pytest.mark.parametrize("order", [3, None])
def test_chunks_and_files_give_what_arrays_give(tmp_path: Path, order: int | None) -> None:
    u, y, _ = known_record(3000, 14, noise=0.05)
    expected = moesp(u, y, 8, order)

    def chunks() -> Iterator[tuple[FloatArray, FloatArray]]:
        for start in range(0, 3000, 271):
            yield u[start : start + 271], y[start : start + 271]

    np.save(tmp_path / "u.npy", u)
    np.save(tmp_path / "y.npy", y)
    mapped = moesp(
        np.load(tmp_path / "u.npy", mmap_mode="r"),
        np.load(tmp_path / "y.npy", mmap_mode="r"),
        8,
        order,
    )
    for other in (moesp_chunks([chunks], 8, order), mapped):
        assert other.order == expected.order
        assert other.singular_values == pytest.approx(expected.singular_values, rel=1e-9)
        assert other.vaf_percent == pytest.approx(expected.vaf_percent, rel=1e-9)


def test_a_chunk_function_that_cannot_start_anew_is_refused() -> None:
    u, y, _ = known_record(400, 15)
    once = iter([(u[:200], y[:200]), (u[200:], y[200:])])
    with pytest.raises(InputError, match="gave 0 samples when read again, 400 before"):
        moesp_chunks([lambda: once], 8, 3)
    with pytest.raises(InputError, match="hold no chunk"):
        moesp_chunks([lambda: iter(())], 8, 3)
    with pytest.raises(InputError, match="no record"):
        moesp_chunks([], 8, 3)


# --- input that cannot be used ------------------------------------------------------------------


def _with(values: FloatArray, row: int, channel: int, value: float) -> FloatArray:
    changed = values.copy()
    changed[row, channel] = value
    return changed


def _bad_inputs() -> list[tuple[str, dict[str, object]]]:
    u, y, _ = known_record(400, 15)
    constant = u.copy()
    constant[:, 1] = 3.0
    return [
        ("u channel 1 holds nan at sample 250", {"u": _with(u, 250, 1, np.nan)}),
        ("y channel 0 holds inf at sample 7", {"y": _with(y, 7, 0, np.inf)}),
        ("u channel 1 is constant at 3", {"u": constant}),
        ("y channel 0 is constant at 0", {"y": y * [0.0, 1.0]}),
        ("u has 399 samples and y has 400", {"u": u[1:]}),
        ("u has 2 records and y has 1", {"u": [u, u], "y": [y]}),
        ("its channels differ", {"u": [u, u[:, :1]], "y": [y, y]}),
        ("record 1 has 5 samples", {"u": [u, u[:5]], "y": [y, y[:5]]}),
        ("Hankel rows, 32 are needed", {"u": u[:30], "y": y[:30]}),
        ("order is 99", {"order": 99}),
        ("order is 0", {"order": 0}),
        ("block_rows is 1", {"block_rows": 1}),
        ("method 'n4sid' is unknown", {"method": "n4sid"}),
        ("dt is -1", {"dt": -1.0}),
        ("u has values of type complex128", {"u": u + 1j}),
        ("y has shape", {"y": y[None]}),
        ("u holds no record", {"u": []}),
        ("input_names", {"options": MoespOptions(input_names=("a",))}),
        ("output_names", {"options": MoespOptions(output_names=("a",))}),
        ("output_weights", {"options": MoespOptions(output_weights=(1.0, -1.0))}),
        ("held_out", {"options": MoespOptions(held_out=0.9)}),
        ("max_order", {"options": MoespOptions(max_order=0)}),
        ("input_matrices", {"options": MoespOptions(input_matrices="guess")}),  # type: ignore[arg-type]
    ]


@pytest.mark.parametrize(
    ("message", "changes"), _bad_inputs(), ids=lambda part: part if isinstance(part, str) else ""
)
def test_bad_input_is_refused_in_one_line(message: str, changes: dict[str, object]) -> None:
    u, y, _ = known_record(400, 15)
    with pytest.raises(InputError) as caught:
        moesp(**{"u": u, "y": y, "block_rows": 8, "order": 3, **changes})  # type: ignore[arg-type]
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_simulate_refuses_wrong_channels() -> None:
    u, y, _ = known_record(400, 15)
    with pytest.raises(InputError, match="inputs"):
        moesp(u, y, 8, 3).simulate(u[:, :1])


# --- time and memory ----------------------------------------------------------------------------


def joint_like(samples: int) -> tuple[FloatArray, FloatArray]:
    u, y, _ = known_record(min(samples, 20_000), 16, noise=0.02)
    repeats = -(-samples // len(u))
    rng = np.random.default_rng(17)
    u = np.tile(np.column_stack((u, u[:, 0] * 0.1)), (repeats, 1))[:samples]
    u[:, 2] += rng.standard_normal(samples)
    return u, np.tile(y, (repeats, 1))[:samples]


@pytest.mark.parametrize(
    "method", ["ordinary", pytest.param("past_output", marks=pytest.mark.slow)]
)
def test_a_hundred_thousand_samples_of_five_channels_take_50_mb(method: str) -> None:
    u, y = joint_like(100_000)
    tracemalloc.start()
    moesp(u, y, 20, method=method)  # type: ignore[arg-type]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= 50e6


@pytest.mark.slow
def test_ten_million_samples_from_disk_take_200_mb(tmp_path: Path) -> None:
    u, y = joint_like(20_000)
    files = []
    for name, values in (("u", u), ("y", y)):
        files.append(tmp_path / f"{name}.npy")
        target = np.lib.format.open_memmap(
            files[-1], "w+", np.float64, (10_000_000, values.shape[1])
        )
        for start in range(0, 10_000_000, 20_000):
            target[start : start + 20_000] = values
        target.flush()
        del target
    mapped = [np.load(file, mmap_mode="r") for file in files]
    tracemalloc.start()
    sub = moesp(mapped[0], mapped[1], 20, 3)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sub.outcome is SubspaceOutcome.ORDER_GIVEN
    assert peak <= 200e6
