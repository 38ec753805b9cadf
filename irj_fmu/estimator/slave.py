"""The estimator FMU: the online estimator of a joint file behind FMI variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, cast

from identification.data.channels import channel_unit
from identification.data.joint_file import Joint, load_joint
from identification.errors import InputError
from identification.faults.detector import ABSURD
from identification.online.estimator import (
    FAULT_TEXT,
    OnlineEstimator,
    OnlineOptions,
    held_parameters,
    prepared,
    searched_parameters,
)
from identification.online.rows import linear_parameters
from identification.online.verdict import PLANT
from identification.online.watch import Q_L, READINGS, W_L
from irj_fmu.estimator.packed import STEP, load_options
from irj_fmu.fmi.slave_base import Health, TableSlave
from irj_fmu.fmi.variables import Value, Variable

JOINT_FILE: Final = "joint.toml"
OPTIONS_FILE: Final = "estimator.toml"
DETECTOR_FILE: Final = "detector.bin"
_BALANCE_TEXT: Final = {
    "motor": "motor balance",
    "link": "link balance",
    "transmission": "transmission balance",
    "sum": "sum of motor and link balance",
    "deflection": "motor balance with the torsion for a torque sensor",
    "axis": "balance of the axis",
}


def estimator_variables(joint: Joint, options: OnlineOptions) -> tuple[Variable, ...]:
    """Inputs, parameters and outputs of a joint's estimator besides those every slave has."""
    model, sensing = prepared(joint, options)
    names = linear_parameters(model, sensing, held_parameters(joint))
    balances = sensing.balances
    return (
        *_inputs(joint),
        *_parameters(options),
        *_estimates(joint, names, model),
        *(
            variable
            for b in balances
            for variable in (
                _output(
                    f"residual.{b}",
                    _torque(joint),
                    f"Residual of the {_BALANCE_TEXT[b]}, newest row.",
                ),
                _output(
                    f"ratio.{b}",
                    "",
                    f"Residual of the {_BALANCE_TEXT[b]}: root mean square of the last seconds "
                    "over its floor.",
                    0.0,
                ),
            )
        ),
        _output(
            "q_l_hat",
            channel_unit("link_position", joint.kind),
            "Link position; the estimate where its reading is missing or failed.",
        ),
        _output(
            "w_l_hat",
            channel_unit("link_velocity", joint.kind),
            "Link velocity; the estimate where its reading is missing or failed.",
        ),
        Variable(
            "fault",
            start=0,
            minimum=0,
            maximum=99,
            causality="output",
            kind="integer",
            description=f"{FAULT_TEXT}.",
        ),
        *(
            _output(
                f"fault_score[{i}]",
                "",
                f"How near the residuals with {name} are to their limits (1: at the limit).",
                0.0,
            )
            for i, name in enumerate(READINGS, 1)
        ),
        Variable(
            "n_rows",
            start=0,
            minimum=0,
            causality="output",
            kind="integer",
            description="Rows of the balances so far.",
        ),
        Variable(
            "alarm",
            start=False,
            causality="output",
            kind="boolean",
            description="The recursion has seen a change and lets the parameters move.",
        ),
    )


def _output(name: str, unit: str, description: str, minimum: float | None = None) -> Variable:
    return Variable(name, unit, minimum=minimum, causality="output", description=description)


def _torque(joint: Joint) -> str:
    return channel_unit("link_torque", joint.kind)


def _inputs(joint: Joint) -> list[Variable]:
    by_current = joint.torque_per_current is not None
    drive = Variable(
        "i_m" if by_current else "tau_m",
        channel_unit("motor_current" if by_current else "motor_torque", joint.kind),
        causality="input",
        description="Motor current." if by_current else "Motor torque on the motor shaft.",
    )
    channels = {
        "q_m": "motor_position",
        "w_m": "motor_velocity",
        "q_l": "link_position",
        "w_l": "link_velocity",
        "tau_l": "link_torque",
    }
    found = [drive]
    for name, channel in channels.items():
        found.append(
            Variable(
                name,
                channel_unit(channel, joint.kind),
                causality="input",
                description=f"{channel.replace('_', ' ').capitalize()}.",
            )
        )
    found.append(
        Variable(
            "enable",
            start=True,
            causality="input",
            kind="boolean",
            description="False holds the estimate.",
        )
    )
    found += [
        Variable(
            f"valid.{name}",
            start=True,
            causality="input",
            kind="boolean",
            description=f"False where {name} is missing.",
        )
        for name in (drive.name, *channels)
    ]
    return found


def _parameters(options: OnlineOptions) -> list[Variable]:
    fixed: dict[str, Any] = {"causality": "parameter"}
    tunable: dict[str, Any] = {"causality": "parameter", "variability": "tunable"}
    share = "as a share of its prior range in one second"
    rows: list[tuple[str, str, Value, float | None, float | None, str, dict[str, Any]]] = [
        (
            "joint_file",
            "",
            "",
            None,
            None,
            "Path of a joint file in place of the packed one, with the same estimated parameters.",
            fixed,
        ),
        (
            "warm_up",
            "s",
            options.warm_up,
            0.1,
            None,
            "First window, from which the recursion starts.",
            fixed,
        ),
        (
            "detect",
            "",
            options.detect,
            None,
            None,
            "Run the fault detector, for an elastic joint with fitted values.",
            fixed,
        ),
        (
            "drift",
            "1/s",
            options.drift,
            0.0,
            10.0,
            f"Forgetting in calm: drift of a parameter {share}.",
            tunable,
        ),
        (
            "alarm_drift",
            "1/s",
            options.alarm_drift,
            0.0,
            100.0,
            f"Forgetting in an alarm: drift of a parameter {share}.",
            tunable,
        ),
        (
            "floor_share",
            "",
            options.floor_share,
            0.0,
            1.0,
            "A floor is never below this share of the torque it balances.",
            tunable,
        ),
        (
            "fault_margin",
            "",
            1.0,
            1e-3,
            None,
            "Factor on the limits of the fault detector.",
            tunable,
        ),
        ("reset", "", False, None, None, "Set to true: start anew.", tunable),
    ]
    found = []
    for name, unit, start, low, high, text, about in rows:
        kind = {str: "string", bool: "boolean"}.get(type(start), "real")
        found.append(
            Variable(name, unit, start, low, high, description=text, kind=cast(Any, kind), **about)
        )
    return found


def _estimates(joint: Joint, names: tuple[str, ...], model: Any) -> list[Variable]:
    known = {p.name: p for p in model.parameters}
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    found = []
    for i, name in enumerate(names, 1):
        p = known[name]
        unit = "" if p.unit == "1" else p.unit
        found.append(
            Variable(
                f"theta[{i}]",
                unit,
                values[name],
                nominal=abs(values[name]) or None,
                causality="output",
                description=f"{name}: {p.meaning}.",
            )
        )
    for i, name in enumerate(names, 1):
        p = known[name]
        unit = "" if p.unit == "1" else p.unit
        found.append(
            Variable(
                f"sigma[{i}]",
                unit,
                minimum=0.0,
                causality="output",
                description=f"{name}: standard deviation.",
            )
        )
    return found


def two_step_variables(joint: Joint, options: OnlineOptions) -> tuple[Variable, ...]:
    """Variables of the two-step algorithm; they stand behind those of
    :func:`estimator_variables`.
    """
    model, _ = prepared(joint, options)
    known = {p.name: p for p in model.parameters}
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    fixed: dict[str, Any] = {"causality": "parameter"}
    found = [
        Variable(
            "optimise",
            start=options.optimise,
            kind="boolean",
            description="Search the nonlinear parameters too (two-step algorithm).",
            **fixed,
        ),
        Variable(
            "portions",
            start=options.portions,
            minimum=1,
            kind="integer",
            description="Portions of a search per sample.",
            **fixed,
        ),
        Variable(
            "reoptimise_request",
            start=False,
            causality="input",
            kind="boolean",
            description="Set to true: search the nonlinear parameters now.",
        ),
    ]
    names = searched_parameters(joint, options)
    for symbol, meaning in (
        ("eta", "{0.meaning}."),
        ("sigma_eta", "standard deviation, 0 where it is held."),
    ):
        for i, name in enumerate(names, 1):
            p = known[name]
            start = values[name] if symbol == "eta" else 0.0
            unit = "" if p.unit == "1" else p.unit
            found.append(
                Variable(
                    f"{symbol}[{i}]",
                    unit,
                    start,
                    causality="output",
                    description=f"{name}: {meaning.format(p)}",
                )
            )
    flags = (
        (
            "reoptimise",
            "The linear parameters do not explain the residuals any more: the nonlinear ones "
            "want another search.",
        ),
        ("searching", "A search for the nonlinear parameters runs, a portion per sample."),
    )
    found += [
        Variable(name, start=False, causality="output", kind="boolean", description=text)
        for name, text in flags
    ]
    found.append(
        Variable(
            "n_searches",
            start=0,
            minimum=0,
            causality="output",
            kind="integer",
            description="Searches begun so far.",
        )
    )
    return tuple(found)


class Estimator(TableSlave):
    """Estimates a joint's parameters from its readings; see
    :class:`identification.online.estimator.OnlineEstimator`.
    """

    default_sample_time = STEP
    resamples = True
    summary = (
        "Online estimation of the parameters of a geared joint, with residuals of its "
        "balances and fault detection."
    )

    def __init__(self, **kwargs: Any) -> None:
        folder = Path(str(kwargs.get("resources") or "."))
        self._packed = load_joint(folder / JOINT_FILE)
        self._fixed, step = load_options(folder / OPTIONS_FILE)
        self.__dict__["default_sample_time"] = step
        detector = folder / DETECTOR_FILE
        self._detector_state = detector.read_bytes() if detector.is_file() else None
        self.__dict__["variables"] = (
            *estimator_variables(self._packed, self._fixed),
            *two_step_variables(self._packed, self._fixed),
        )
        self._estimator: OnlineEstimator | None = None
        self._setup: tuple[Any, ...] = ()
        self._told = 0
        self._shown: Any = None
        self._reset_before = self._asked_before = False
        super().__init__(**kwargs)
        self._places()

    def _places(self) -> None:
        """Where inputs and outputs stand in the table."""
        drive = "i_m" if self._packed.torque_per_current is not None else "tau_m"
        self._first, self._flag = self._index[drive], self._index[f"valid.{drive}"]
        ratio = self._packed.gear_ratio
        per_unit = self._packed.torque_per_current if drive == "i_m" else ratio
        self._gains = [float(per_unit or 1.0), 1.0 / ratio, 1.0 / ratio, 1.0, 1.0, 1.0]
        self._enable = self._index["enable"]
        self._q_at, self._fault_at = self._index["q_l_hat"], self._index["fault"]
        count = sum(1 for v in self.table if v.name.startswith("theta["))
        self._theta_at, self._sigma_at = self._index["theta[1]"], self._index["sigma[1]"]
        self._thetas = count
        self._etas = sum(1 for v in self.table if v.name.startswith("eta["))
        self._request, self._flags = self._index["reoptimise_request"], self._index["reoptimise"]

    # --- life -------------------------------------------------------------------------------------

    def configure(self, parameters: Mapping[str, Value]) -> None:
        """Build the estimator where what it is built from has changed; take the tunable
        parameters over.
        """
        setup = tuple(
            parameters[n]
            for n in ("sample_time", "joint_file", "warm_up", "detect", "optimise", "portions")
        )
        options = replace(
            self._fixed,
            warm_up=float(parameters["warm_up"]),
            detect=bool(parameters["detect"]),
            drift=float(parameters["drift"]),
            alarm_drift=float(parameters["alarm_drift"]),
            floor_share=float(parameters["floor_share"]),
            optimise=bool(parameters["optimise"]),
            portions=int(parameters["portions"]),
        )
        if self._estimator is None or setup != self._setup:
            self._estimator = self._build(
                str(parameters["joint_file"]), float(parameters["sample_time"]), options
            )
            self._setup = setup
        elif options != self._estimator.options:
            self._estimator.retune(options)
        self._estimator.set_fault_margin(float(parameters["fault_margin"]))
        if parameters["reset"] and not self._reset_before:
            self._estimator.reset()
        self._reset_before = bool(parameters["reset"])
        self._publish()

    def _build(self, path: str, dt: float, options: OnlineOptions) -> OnlineEstimator:
        joint = load_joint(path) if path else self._packed
        made = OnlineEstimator(joint, dt, options, self._detector_state if not path else None)
        if len(made.names) != self._thetas or joint.gear_ratio != self._packed.gear_ratio:
            raise InputError(
                f"{path}: has other estimated parameters or another gear ratio than the packed "
                "joint file"
            )
        return made

    def longest(self, period: float) -> float:
        """Longest step of a host between two samples that the estimator bridges [s]."""
        return self._estimator.grid.gap if self._estimator is not None else period

    # --- a sample ---------------------------------------------------------------------------------

    def _sample(self, time: float, length: float) -> None:
        """Readings that are no number or absurd count as missing; the others of that sample are
        used.
        """
        if not self._due(time, length):
            return
        values = self._values
        health = self._take(
            time, values[self._first : self._first + 6], values[self._flag : self._flag + 6]
        )
        if self._too_long:
            health = max(health, Health.STEP_MISMATCH)
        values[2] = int(values[2]) + 1
        values[1] = int(health)

    def process(self, time: float, step: float, inputs: Mapping[str, Value]) -> Mapping[str, Value]:
        """Take one sample of finite readings given by name."""
        raw = [float(inputs[v.name]) for v in self.table[self._first : self._first + 6]]
        flags = [bool(inputs[v.name]) for v in self.table[self._flag : self._flag + 6]]
        return {"health": int(self._take(time, raw, flags))}

    def _take(self, time: float, raw: Sequence[Any], flags: Sequence[Any]) -> Health:
        """Give one sample of readings to the :class:`OnlineEstimator` and copy what it says
        into the outputs.
        """
        estimator = self._estimator
        if estimator is None:
            raise InputError("the estimator is not configured; see the first message of the log")
        values, gains = self._values, self._gains
        readings = [raw[0] * gains[0], raw[1] * gains[1], raw[2] * gains[2], raw[3], raw[4], raw[5]]
        request = bool(values[self._request])
        if request != self._asked_before:
            self._asked_before = request
            if request and not estimator.reoptimise():
                self._report("reoptimise_request: there are no nonlinear parameters to search")
        if estimator.update(time, readings, flags, enable=bool(values[self._enable])):
            self._publish()
        shown = estimator.readings
        values[self._q_at], values[self._q_at + 1] = shown[Q_L], shown[W_L]
        fault = estimator.fault
        if fault != values[self._fault_at]:
            values[self._fault_at] = fault
            if fault:
                self._report(f"fault {fault} at t = {time:g} s ({FAULT_TEXT})")
        if estimator.unusable:
            names = ", ".join(self.table[self._first + i].name for i in estimator.unusable)
            self._report(
                f"input not finite or beyond {ABSURD:g} in SI units: {names}; it counts as missing"
            )
            return Health.NUMERIC_TROUBLE
        if fault > PLANT or estimator.held:
            return Health.NUMERIC_TROUBLE
        return Health.WARMING_UP if estimator.warming_up else Health.OK

    def _publish(self) -> None:
        """Copy the estimates into the outputs."""
        estimator, values, at = self._estimator, self._values, self._index
        if estimator is None:
            return
        n = self._thetas
        values[self._theta_at : self._theta_at + n] = estimator.theta.tolist()
        values[self._sigma_at : self._sigma_at + n] = estimator.sigma.tolist()
        first = at[f"residual.{estimator.balances[0]}"]
        for b, (residual, ratio) in enumerate(
            zip(estimator.residual.tolist(), estimator.ratio.tolist(), strict=True)
        ):
            values[first + 2 * b], values[first + 2 * b + 1] = residual, ratio
        score = at["fault_score[1]"]
        values[score : score + 6] = estimator.score
        values[at["n_rows"]] = estimator.made
        values[at["alarm"]] = estimator.estimator is not None and estimator.estimator.alarm
        two, flag = estimator.two_step, self._flags
        values[flag] = estimator.wanted
        if two is not None:
            values[flag + 1], values[flag + 2] = two.searching, two.searches
            if two.eta is not self._shown:
                self._shown = two.eta
                values[flag - 2 * self._etas : flag] = [*two.eta.tolist(), *two.deviation.tolist()]
        for text in estimator.events[self._told :]:
            self._report(text)
        self._told = len(estimator.events)

    # --- state ------------------------------------------------------------------------------------

    def get_state(self) -> bytes:
        """Everything the estimator remembers."""
        return b"" if self._estimator is None else self._estimator.state()

    def set_state(self, state: bytes) -> None:
        """Take up what :meth:`get_state` returned."""
        if not state or self._estimator is None:
            return
        self._estimator.restore(state)
        self._told = len(self._estimator.events)


__all__ = [
    "DETECTOR_FILE",
    "JOINT_FILE",
    "OPTIONS_FILE",
    "Estimator",
    "estimator_variables",
    "two_step_variables",
]
