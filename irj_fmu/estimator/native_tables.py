"""C code and tables of a native estimator, read off a Python estimator that has been built for the
same joint.

Nothing is computed twice here: kernels and laws come from
:class:`identification.online.rows.RowMaker`, the recursion from
:mod:`identification.recursive.ud_codegen`, the observer, its gains and its limits from the fault
detector.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.clocks import MOST_SKEW, SURE, cubic
from identification.balance.noise import CUT_DEVIATION, FOURTH_GAIN, KEPT
from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.faults import structured
from identification.faults.core import ABSURD, OPEN
from identification.faults.detector import MOVED, PARITY_SENSORS, DetectorTables
from identification.faults.residuals import COUNT, ENERGY_LEFT, ENERGY_TOP
from identification.online import first_window, verdict
from identification.online import watch as watch_settings
from identification.online.calibration import FURTHER, ROUNDS
from identification.online.estimator import OnlineEstimator
from identification.online.first_window import ABSENT, RIDGE
from identification.online.grid import ON_GRID
from identification.online.row_check import LEAST
from identification.online.rows import _NAMES, SOURCES
from identification.online.verdict import _RECENT, FAULT_TEXT, SCALED, WRONG_SCALE, WRONG_SIGMAS
from identification.online.watch import DRIVE, READINGS, TAU
from identification.recursive.prior_start import PRIOR_PASSES, UNDETERMINED
from irj_fmu.estimator.native_expressions import cheaper
from irj_fmu.fmi import slave_base
from irj_fmu.fmi.compiler import model_code
from irj_fmu.fmi.variables import Variable

FloatArray = npt.NDArray[np.float64]

MAX_WARM_UP: Final = 20.0
"""Longest first window that a native estimator has room for, where the built-in one is not
longer [s].
"""
_KINDS: Final = {"real": 0, "integer": 1, "boolean": 2, "string": 3}


@final
@dataclass(frozen=True)
class Code:
    """Generated text: CasADi's functions, and sizes, tables and start values."""

    model: bytes
    config: bytes


def generate(joint: Joint, made: OnlineEstimator, variables: Sequence[Variable], guid: str) -> Code:
    """Write the C code of an estimator.

    Parameters
    ----------
    joint : Joint
    made : OnlineEstimator
        The Python estimator, before its first sample.
    variables : sequence of Variable
        In the order of the value references.
    guid : str
    """
    functions = _functions(made)
    header = _Header()
    header.define("NATIVE_GUID", f'"{guid}"')
    _variable_tables(header, joint, made, variables)
    _row_tables(header, made)
    _calibration_tables(header, made)
    _watch_tables(header, made)
    _recursion_tables(header, made)
    _fault_tables(header, made)
    header.define("SZ_ARG", max(8, *(f.sz_arg() for f in functions)))
    header.define("SZ_RES", max(8, *(f.sz_res() for f in functions)))
    header.define("SZ_IW", max(f.sz_iw() for f in functions))
    header.define("SZ_W", max(f.sz_w() for f in functions))
    return Code(model_code("native_model", functions), header.text())


# --- CasADi's functions ---------------------------------------------------------------------------


def _functions(made: OnlineEstimator) -> list[Any]:
    import casadi as ca

    engine = made.recursion(made.theta).engine_for("generate")
    found = [engine.formulas.step, engine.formulas.check, made.rows.point, made.rows.slopes]
    part = ca.SX.sym("part")
    between = ca.Function("cubic", [part], [ca.vertcat(*cubic(part))])
    own = [made.check.function, made.check.weight, made.rows.still, between]
    if made.detector is not None:
        found.append(made.detector.tables().function)
    recursion = []
    for name, function in zip(("rls_step", "rls_check"), found[:2], strict=True):
        arguments = function.sx_in()
        recursion.append(ca.Function(name, arguments, function.call(arguments)))
    laws = zip(("points", "slopes", "sample_observer"), found[2:], strict=False)
    return [*recursion, *own, *(cheaper(function, name) for name, function in laws)]


# --- text -----------------------------------------------------------------------------------------


def _literal(value: float) -> str:
    number = float(value)
    if math.isinf(number):
        return "INFINITY" if number > 0 else "-INFINITY"
    return repr(number)


@final
class _Header:
    """Lines of native_config.h."""

    def __init__(self) -> None:
        self.lines = ["/* Sizes, tables and start values of this estimator. */"]

    def define(self, name: str, value: object) -> None:
        self.lines.append(
            f"#define {name} {_literal(value) if isinstance(value, float) else value}"
        )

    def doubles(self, name: str, values: npt.ArrayLike) -> None:
        """A table of doubles, nested as the array is."""
        array = np.asarray(values, dtype=np.float64)
        shape = "".join(f"[{max(1, size)}]" for size in array.shape)
        self.lines.append(
            f"static const double {name}{shape} = {_nested(array) if array.size else '{0}'};"
        )

    def whole(self, name: str, values: Iterable[int], kind: str = "int") -> None:
        found = [str(int(value)) for value in values]
        self.lines.append(
            f"static const {kind} {name}[{max(1, len(found))}] = {{{', '.join(found) or '0'}}};"
        )

    def raw(self, line: str) -> None:
        self.lines.append(line)

    def text(self) -> bytes:
        return ("\n".join(self.lines) + "\n").encode()


def _nested(array: FloatArray) -> str:
    if array.ndim == 1:
        return "{" + ", ".join(map(_literal, array.tolist())) + "}"
    return "{" + ",\n ".join(_nested(part) for part in array) + "}"


# --- tables ---------------------------------------------------------------------------------------


def _variable_tables(
    header: _Header, joint: Joint, made: OnlineEstimator, variables: Sequence[Variable]
) -> None:
    at = {v.name: i for i, v in enumerate(variables)}
    strings = [v.name for v in variables if v.kind == "string"]
    header.define("N_VARIABLES", len(variables))
    header.define("N_TEXTS", len(strings))
    header.whole("kind", (_KINDS[v.kind] for v in variables), "unsigned char")
    header.whole("access", map(_access, variables), "unsigned char")
    header.doubles("start_real", [float(v.start) if v.kind == "real" else 0.0 for v in variables])
    header.whole(
        "start_whole", (int(v.start) if v.kind in ("integer", "boolean") else 0 for v in variables)
    )
    header.whole("text_of", (strings.index(v.name) if v.kind == "string" else 0 for v in variables))
    header.define("TEXT_JOINT_FILE", strings.index("joint_file"))
    single = {
        "SAMPLE_TIME": "sample_time",
        "HEALTH": "health",
        "N_SAMPLES": "n_samples",
        "WARM_UP": "warm_up",
        "DETECT": "detect",
        "DRIFT": "drift",
        "ALARM_DRIFT": "alarm_drift",
        "FLOOR_SHARE": "floor_share",
        "FAULT_MARGIN": "fault_margin",
        "RESET": "reset",
        "ENABLE": "enable",
        "THETA": "theta[1]",
        "SIGMA": "sigma[1]",
        "LINK_POSITION": "q_l_hat",
        "FAULT": "fault",
        "SCORE": "fault_score[1]",
        "N_ROWS": "n_rows",
        "ALARM": "alarm",
        "REOPTIMISE": "reoptimise",
        "OPTIMISE": "optimise",
        "REQUEST": "reoptimise_request",
    }
    for key, name in single.items():
        header.define(f"V_{key}", at[name])
    header.whole("residual_at", (at[f"residual.{b}"] for b in made.balances))
    header.whole("ratio_at", (at[f"ratio.{b}"] for b in made.balances))
    drive = "i_m" if joint.torque_per_current is not None else "tau_m"
    inputs = (drive, *READINGS[1:])
    header.whole("input_at", (at[n] for n in inputs))
    header.whole("valid_at", (at[f"valid.{n}"] for n in inputs))
    header.raw(
        "static const char *const input_name[] = "
        f"{{{', '.join(chr(34) + n + chr(34) for n in inputs)}}};"
    )
    gear = joint.gear_ratio
    per_unit = joint.torque_per_current if drive == "i_m" else gear
    header.doubles("input_gain", [float(per_unit or 1.0), 1.0 / gear, 1.0 / gear, 1.0, 1.0, 1.0])
    for name in ("SLACK", "EARLY", "ROUNDED", "HOLD"):
        header.define(f"GRID_{name}", getattr(slave_base, name))
    header.define("FAULT_TEXT", f'"{FAULT_TEXT}"')


def _access(variable: Variable) -> int:
    is_parameter = variable.causality == "parameter"
    return (
        (1 if is_parameter or variable.causality == "input" else 0)
        + (2 if is_parameter else 0)
        + (4 if is_parameter and variable.stated_variability == "fixed" else 0)
    )


def _row_tables(header: _Header, made: OnlineEstimator) -> None:
    rows = made.rows
    t, (count, width) = rows.timing, (len(rows.balances), rows.width)
    centre = t.window - 1 - t.reach
    header.define("N_THETA", len(rows.names))
    header.define("N_BALANCES", count)
    header.define("N_SIGNALS", len(_NAMES))
    header.define("SOURCES", len(SOURCES))
    header.define("WINDOW", t.window)
    header.define("STRIDE", t.stride)
    header.define("CENTRE", centre)
    header.define("DELAY", float(t.delay))
    header.define("LOST_SAMPLES", made.samples.memory)
    header.define("TAPS", made.samples.alignment.taps.shape[1])
    header.doubles("delay_samples", [rows.alignment.late[n] for n in SOURCES])
    header.define("SAMPLE_TIME", float(t.dt))
    header.define("ROW_PERIOD", float(t.stride * t.dt))
    new = t.stride // t.step
    header.define("NEW_POINTS", new)
    header.define("POINTS", 2 * t.point_half + 1)
    header.define("ROWS_BEFORE_READY", rows.rows_before_ready)
    header.define("N_NEEDED", len(rows.needed))
    header.define("N_COORDINATES", rows.point.size1_in(2))
    header.define("N_MEMORY", rows.point.size1_in(3))
    header.define("N_AVERAGED", rows.averaged)
    header.whole("needed", rows.needed)
    place = rows.place
    header.define("PLACES", len(place))
    header.whole("place_signal", (p[0] for p in place))
    header.whole("place_order", (p[1] for p in place))
    header.whole("place_source", (p[2] for p in place))
    header.whole("source_signal", (_NAMES.index(n) for n in SOURCES))
    header.whole("speed_signal", rows.speeds)
    header.whole("point_at", rows.raw_at)
    half, averaging = _support(rows.averaging, centre)
    header.define("AVERAGE_HALF", half)
    header.doubles("average_kernel", averaging)
    half, smoothing = _support(
        np.array([rows.smoothing[order, 0] for _, order, _ in place]), rows.raw_at[0]
    )
    for k in range(new):
        shifted = _support(
            np.array([rows.smoothing[order, k] for _, order, _ in place]), rows.raw_at[k]
        )
        if shifted[0] != half or not np.array_equal(shifted[1], smoothing):
            raise InputError(
                "native estimator: the kernels of the points differ; build the Python estimator "
                "instead"
            )
    header.define("SMOOTH_HALF", half)
    header.doubles("smooth_kernel", smoothing)
    header.doubles("point_weight", rows.weights)
    header.doubles("rate_weight", rows.rate_weights)
    header.doubles("sharp", rows.sharp)
    linear = [
        (i, j)
        for i, j in itertools.product(range(count * width), range(len(_NAMES)))
        if rows.linear[i, j] != 0.0
    ]
    header.define("N_LINEAR", len(linear))
    header.whole("linear_row", (i for i, _ in linear))
    header.whole("linear_column", (j for _, j in linear))
    header.doubles("linear_value", [rows.linear[i, j] for i, j in linear])
    header.doubles("entry_gain", rows.entry_gain.ravel())
    uses = ",\n ".join("{" + ", ".join(str(int(v)) for v in line) + "}" for line in rows.uses)
    header.raw(f"static const unsigned char uses[N_BALANCES][SOURCES] = {{{uses}}};")
    names = rows.model.parameter_names
    header.define("N_VALUES", len(names))
    header.doubles("fixed_value", rows.model.value_vector())
    header.whole("theta_value", (names.index(n) for n in rows.names))


def _calibration_tables(header: _Header, made: OnlineEstimator) -> None:
    own = made.calibration
    header.define("LINK_SOURCE", SOURCES.index("link_position"))
    header.define("HAS_VALUES", int(made.has_values))
    header.define("N_UNKNOWNS", len(own.unknowns))
    header.whole("unknown_theta", own.unknowns)
    header.define("N_SKEWS", len(own.skews))
    header.whole("skew_theta", own.skews)
    header.whole("skew_source", (SOURCES.index(n) for n in own.skews.values()))
    header.define("N_ZEROS", len(own.zeros))
    header.whole("zero_theta", own.zeros)
    header.define("MOST_LATE", float(own.most))
    header.define("NEAR_LATE", float(own.near))
    header.define("LATE_PART", float(own.part))
    header.define("CALIBRATION_ROUNDS", ROUNDS)
    header.define("CALIBRATION_FURTHER", FURTHER)
    header.define("CALIBRATION_SURE", float(SURE))


def _support(kernels: FloatArray, centre: int) -> tuple[int, FloatArray]:
    """Half width of the part that is not zero, about a sample, and that part of each kernel."""
    used = np.flatnonzero(np.any(kernels != 0.0, axis=0))
    half = int(np.max(np.abs(used - centre)))
    return half, kernels[:, centre - half : centre + half + 1]


def _watch_tables(header: _Header, made: OnlineEstimator) -> None:
    header.define("WATCH", made.watch.length)
    for name in ("MOVED", "SCALE_MOTION"):
        header.define(name, float(getattr(watch_settings, f"_{name}")))
    header.define("SCALE_ERROR", float(watch_settings.SCALE))
    header.define("TWIST_PLAY", float(made.watch.twist.play))
    header.define("TWIST_COMPLIANCE", float(made.watch.twist.compliance))
    header.define("MOST_SKEW", float(MOST_SKEW))
    header.define("NOISE_MEMORY", watch_settings.MEMORY)
    header.define("NOISE_KEPT", KEPT)
    header.define("NOISE_GAIN", FOURTH_GAIN)
    header.define("TINY", watch_settings.TINY)
    header.define("WRONG_SCALE", WRONG_SCALE)
    header.define("WRONG_SIGMAS", WRONG_SIGMAS)
    header.define("NOISE_CUT_DEVIATION", CUT_DEVIATION)
    header.whole("present", made.present, "unsigned char")
    header.whole("needs", made.needs, "unsigned char")
    header.define("RECENT_SAMPLES", round(_RECENT / made.dt))
    names = made.names
    stiffness = made.model.stiffness_name
    header.define("STIFFNESS_THETA", names.index(stiffness) if stiffness in names else -1)
    header.define("HELD_STIFFNESS", float(made.held_stiffness))
    header.define("LINK_FROM_TORSION", int(made.model.is_elastic and made.options.has_torque))
    found = [
        (names.index(n), made.joint.fitted[n], code)
        for n, code in (("link_inertia", SCALED + 1 + TAU), ("motor_inertia", SCALED + 1 + DRIVE))
        if made.is_fitted and n in names and n in made.joint.fitted
    ]
    header.define("N_INERTIAS", len(found))
    header.whole("inertia_theta", (i for i, _, _ in found))
    header.doubles("inertia_before", [v for _, v, _ in found])
    header.whole("inertia_code", (c for _, _, c in found))


def _recursion_tables(header: _Header, made: OnlineEstimator) -> None:
    from identification.recursive.settings import Settings, start_state

    period = made.rows.timing.stride * made.dt
    engine = made.recursion(made.theta).engine_for("generate")
    layout, n = engine.layout, len(made.names)
    fast, slow = start_state(layout, np.zeros(n), engine.config)
    collect = max(made.collect, round(MAX_WARM_UP / period))
    header.define("COLLECT", collect)
    header.define("HEARD", made.room_of(collect) if made.calibration else 0)
    header.define("LEAST", LEAST)
    header.define("ABSENT", ABSENT)
    header.define("RIDGE", RIDGE)
    header.define("UNDETERMINED", UNDETERMINED)
    header.define("PRIOR_PASSES", PRIOR_PASSES)
    header.define("OVERLAP", float(made.rows.timing.overlap))
    for name in ("RANGE", "PASSES", "DEVIATION"):
        header.define(f"FIRST_{name}", getattr(first_window, name))
    header.define("SHOWN_OVER", float(Settings.shown_over))
    header.define("SHOWN_RATE", Settings(sample_time=period).shown_rate)
    told = ("d", "u", "theta", "noise", "error", "learned", "alarm", "due", "size")
    tuned = ("scale", "theta0", "walk", "walk_alarm", "enabled", "start", "hides")
    for name, block, parts in (
        ("FAST", layout.fast, told),
        ("SLOW", layout.slow, ()),
        ("CONFIG", layout.config, tuned),
    ):
        header.define(f"N_{name}", block.size)
        for part in parts:
            header.define(f"{name}_{part.upper()}", block[part].start)
    header.doubles("start_fast", fast)
    header.doubles("start_slow", slow)
    header.doubles("start_config", engine.config)
    header.doubles("fixed_theta", made.theta)
    header.whole("reference_signal", made.reference)
    for key, value in made.guard.figures().items():
        header.define(f"GUARD_{key}", value)
    header.doubles("usual_range", made.rows.usual)
    header.whole("like", made.rows.like)
    header.doubles("lowest", made.low)
    header.doubles("highest", made.high)
    for key, number in made.pulse.figures().items():
        header.define(f"PULSE_{key}", number)
    for name in ("MISSING", "CONSTANT", "SCALED", "CURRENT_OR_FRICTION", "PLANT", "HELD"):
        header.define(f"CODE_{name}", getattr(verdict, name))
    header.define("ON_GRID", ON_GRID)
    header.define("GRID_GAP", float(made.grid.gap))
    header.define("CONFIRM_ROWS", made.confirm)


def _fault_tables(header: _Header, made: OnlineEstimator) -> None:
    header.define("HAS_DETECTOR", int(made.detector is not None))
    waits = (
        "link_wait",
        "torque_wait",
        "pair_wait",
        "plant_wait",
        "quiet_seconds",
        "recover_seconds",
        "settle_seconds",
        "plant_rest_seconds",
    )
    for name in ("LARGEST", "WIDER", "WELL_OVER", "FRESH", "SHOWS"):
        header.define(f"FAULT_{name}", getattr(structured, name))
    header.define("ABSURD", ABSURD)
    header.define("FAULT_OPEN", OPEN)
    header.whole("fault_short", structured.SHORT)
    header.define("RESIDUALS", COUNT)
    header.define("ENERGY_LEFT", ENERGY_LEFT)
    header.define("ENERGY_TOP", ENERGY_TOP)
    keys = ("LINK", "TORQUE", "PAIR", "PLANT", "QUIET", "RECOVER", "SETTLE", "REST")
    header.whole("parity_sensors", (sum(1 << s for s in sensors) for sensors in PARITY_SENSORS))
    header.doubles("moved", MOVED)
    if made.detector is None:
        _no_fault_tables(header, keys)
        return
    held: DetectorTables = made.detector.tables()
    for key, name in zip(keys, waits, strict=True):
        header.define(f"WAIT_{key}", held.waits[name])
    header.define("WAIT_ARM", held.waits["arm"])
    header.define("HAS_TORQUE", int(held.has_torque))
    header.define("N_OBSERVER", held.states)
    header.define("N_OBSERVED", held.function.size1_out(0))
    header.define("FAULT_RING", 1 << math.ceil(math.log2(held.lags[-1] + 2)))
    header.define("FAULT_STIFFNESS", float(held.stiffness))
    header.define("HALF_STEP", float(held.half))
    header.define("MEAN_1", float(held.means[0]))
    header.define("MEAN_2", float(held.means[1]))
    header.define("ENERGY_DRIFT", float(held.drift))
    header.whole("lag", held.lags)
    header.doubles("fault_limit", held.limits)
    header.doubles("energy_inverse", held.inverse)
    header.doubles("energy_limit", held.energy_limits)
    header.doubles("fault_noise", held.noise)
    header.doubles("recover_limit", held.recover_limits)
    header.doubles("widening", held.widening)
    header.doubles("observer_gain", held.gains)
    header.doubles("gate", held.gates)


def _no_fault_tables(header: _Header, keys: Sequence[str]) -> None:
    """The smallest tables with which the detector's code compiles, for a joint without one."""
    for key in (*keys, "ARM"):
        header.define(f"WAIT_{key}", 1)
    for name, size in (("HAS_TORQUE", 0), ("N_OBSERVER", 0), ("N_OBSERVED", 32), ("FAULT_RING", 1)):
        header.define(name, size)
    for name in ("FAULT_STIFFNESS", "HALF_STEP", "MEAN_1", "MEAN_2", "ENERGY_DRIFT"):
        header.define(name, 0.0)
    header.whole("lag", [1] * 4)
    for name, size in (
        ("fault_limit", 19),
        ("energy_inverse", 3),
        ("energy_limit", 3),
        ("fault_noise", 6),
        ("recover_limit", 6),
        ("gate", 5),
    ):
        header.doubles(name, np.zeros(size))
    header.doubles("widening", np.zeros((6, 5)))
    header.doubles("observer_gain", np.zeros((32, 5)))


__all__ = ["MAX_WARM_UP", "Code", "generate"]
