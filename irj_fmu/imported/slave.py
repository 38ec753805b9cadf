"""Slaves that carry a user's FMU with the effect that rides outside it, or that effect alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element

from identification.data.units import base_unit
from irj_fmu.fmi.slave_base import Health, TableSlave
from irj_fmu.fmi.unit_definitions import base_unit as fmi_unit
from irj_fmu.fmi.variables import Value, Variable
from irj_fmu.host.run import FmuError
from irj_fmu.imported.correction import PREFIX, CorrectionLaw
from irj_fmu.imported.file import load_user_joint
from irj_fmu.imported.model import UserModel
from irj_fmu.imported.port import feedback_of, hold_of, port_of

PAIR_FILE: Final = "pair.toml"
_STATE: Final = {"canGetAndSetFMUstate": "false", "canSerializeFMUstate": "false"}


def pair_variables(model: UserModel) -> tuple[Variable, ...]:
    """Mapped inputs and outputs of the FMU, its fitted parameters and start values, and those
    of the correction.
    """
    found = []
    for group, causality in ((model.inputs, "input"), (model.outputs, "output")):
        for m in group:
            text = model.fmu.variable(m.variable).description or f"Channel {m.channel}."
            found.append(
                Variable(
                    m.variable,
                    _unit(model, m.variable),
                    model.fmu.start(m.variable),
                    causality=causality,  # type: ignore[arg-type]
                    description=text,
                )
            )
    for name, value in [(p.name, p.value) for p in model.parameters] + [
        (m.variable, model.fmu.start(m.variable)) for m in model.starts
    ]:
        text = model.fmu.variable(name).description or f"{name} of the FMU."
        found.append(
            Variable(name, _unit(model, name), value, causality="parameter", description=text)
        )
    return (*found, *correction_variables(model))


def correction_variables(model: UserModel) -> tuple[Variable, ...]:
    """Parameters of the correction."""
    if model.correction is None:
        return ()
    values = model.correction.free_values()
    meanings = {PREFIX + p.name: p for p in model.correction.model.parameters}
    return tuple(
        Variable(
            name,
            "" if meanings[name].unit == "1" else meanings[name].unit,
            value,
            causality="parameter",
            description=f"{meanings[name].meaning[:1].upper()}{meanings[name].meaning[1:]}.",
        )
        for name, value in values.items()
    )


def _unit(model: UserModel, name: str) -> str:
    """A unit of the FMU, where it is one that can be declared again."""
    unit = model.fmu.variable(name).unit or ""
    try:
        return unit if unit and fmi_unit(unit) is not None and base_unit(unit) else ""
    except ValueError:
        return ""


class Pair(TableSlave):
    """A user's FMU and the effect that rides outside it, as one FMU.

    The correction is read from the inner FMU's outputs every ``sample_time`` and held in between,
    as in the fit. A host step of any length is made of such samples.
    """

    default_sample_time = 1e-3
    summary = (
        "A user's FMU with an effect of the library that rides outside it as a correction "
        "of its torque input."
    )

    def __init__(self, **kwargs: Any) -> None:
        folder = Path(str(kwargs.get("resources") or "."))
        self._model = load_user_joint(folder / PAIR_FILE)
        self.__dict__["variables"] = pair_variables(self._model)
        self.__dict__["default_sample_time"] = hold_of(self._model)
        self._instance: Any = None
        self._time = 0.0
        super().__init__(**kwargs)

    def to_xml(self, model_options: Mapping[str, str] | None = None) -> Element:
        """The inner FMU's state is its own: no FMU state is promised."""
        return super().to_xml({**(model_options or {}), **_STATE})

    def configure(self, parameters: Mapping[str, Value]) -> None:
        """Start the inner FMU with the parameters."""
        from irj_fmu.host.exchange import Stepper
        from irj_fmu.imported.library import UserInstance
        from irj_fmu.imported.run import ATOL, RTOL

        model = self._model
        if self._instance is None:
            self._instance = UserInstance(model.fmu, model.kind)
            self._ins = self._instance.block(m.variable for m in model.inputs)
            self._outs = self._instance.block(m.variable for m in model.outputs)
        start = 0.0 if math.isnan(self._start) else self._start
        own = {
            n: float(parameters[n])
            for n in (*(p.name for p in model.parameters), *(m.variable for m in model.starts))
        }
        instance = self._instance
        instance.begin(start, {**model.constants, **own})
        self._feed()
        self._x = instance.ready()
        self._stepper = (
            Stepper(model.fmu.path.name, instance.nominals(), RTOL, ATOL, instance.accept)
            if model.kind == "me"
            else None
        )
        if self._stepper is not None:
            instance.slope(start, self._x)
        self._law = feedback_of(
            model, {k: float(v) for k, v in parameters.items() if k.startswith(PREFIX)}
        )
        if self._law is not None:
            self._law.restart()
        self._time = start
        self._publish()

    def _feed(self) -> None:
        values, at = self._values, self._index
        self._ins.array[:] = [float(values[at[name]]) for name in self._ins.names]
        self._instance.write(self._ins)

    def _publish(self) -> None:
        for name, value in zip(
            self._outs.names, self._instance.read(self._outs).tolist(), strict=True
        ):
            self._values[self._index[name]] = value

    def _sample(self, time: float, length: float) -> None:
        values = self._values
        bad = [self.table[i].name for i in self._reals if not math.isfinite(float(values[i]))]
        if bad:
            self._report(f"input not finite: {', '.join(bad)}; the step is left out")
            values[1] = int(Health.NUMERIC_TROUBLE)
            return
        count = max(1, math.ceil(length / float(values[0]) - 1e-6))
        for k in range(count):
            self._substep(time + k * length / count, length / count)
        self._publish()
        values[2] = int(values[2]) + count
        values[1] = int(Health.OK)

    def _substep(self, time: float, step: float) -> None:
        instance = self._instance
        if instance is None:
            raise FmuError("the inner FMU has not started; see the first message of the log")
        self._feed()
        if self._law is not None:
            held = self._ins.array.copy()
            self._ins.array[:] = held + self._law(0, time, held, instance.read(self._outs))
            instance.write(self._ins)
        if self._stepper is None:
            instance.do_step(time, step)
        elif instance.size:
            self._x = self._stepper.advance(instance.slope, time, time + step, self._x)
        else:
            instance.slope(time + step, self._x)

    def process(self, time: float, step: float, inputs: Mapping[str, Value]) -> Mapping[str, Value]:
        """Not used: a step is made of samples."""
        return {}


class Outside(TableSlave):
    """The effect alone, for a system of two FMUs: reads drive, position and velocity, gives the
    corrected drive.
    """

    default_sample_time = 1e-3
    summary = (
        "An effect of the library that rides outside an FMU as a correction of its torque input."
    )

    def __init__(self, **kwargs: Any) -> None:
        folder = Path(str(kwargs.get("resources") or "."))
        self._model = load_user_joint(folder / PAIR_FILE)
        self._port = port_of(self._model)
        self.__dict__["variables"] = outside_variables(self._model)
        self._law: CorrectionLaw | None = None
        super().__init__(**kwargs)

    def to_xml(self, model_options: Mapping[str, str] | None = None) -> Element:
        """No FMU state is promised."""
        return super().to_xml({**(model_options or {}), **_STATE})

    def configure(self, parameters: Mapping[str, Value]) -> None:
        """Make the law with the parameters."""
        self._law = feedback_of(
            self._model, {k: float(v) for k, v in parameters.items() if k.startswith(PREFIX)}
        )
        if self._law is not None:
            self._law.restart()

    def process(self, time: float, step: float, inputs: Mapping[str, Value]) -> Mapping[str, Value]:
        """The drive with the correction."""
        port, drive = self._port, float(inputs["drive"])
        speed = float(inputs["velocity"]) * port.rate if "velocity" in inputs else None
        if self._law is None:
            return {"corrected": drive}
        torque = self._law.torque(
            time, drive * port.torque, float(inputs["position"]) * port.position, speed
        )
        return {"corrected": drive + torque / port.torque}


def outside_variables(model: UserModel) -> tuple[Variable, ...]:
    """Inputs, output and parameters of :class:`Outside`."""
    port = port_of(model)
    drive, place = model.inputs[port.input].variable, model.outputs[port.output].variable
    found = [
        Variable(
            "drive",
            _unit(model, drive),
            causality="input",
            description="Drive, in the unit of the FMU's input.",
        ),
        Variable(
            "position",
            _unit(model, place),
            causality="input",
            description="Position, as the FMU gives it.",
        ),
    ]
    if port.velocity is not None:
        speed = model.outputs[port.velocity].variable
        found.append(
            Variable(
                "velocity",
                _unit(model, speed),
                causality="input",
                description="Velocity, as the FMU gives it.",
            )
        )
    found.append(
        Variable(
            "corrected",
            _unit(model, drive),
            causality="output",
            description="Drive with the correction.",
        )
    )
    return (*found, *correction_variables(model))


__all__ = ["PAIR_FILE", "Outside", "Pair", "outside_variables", "pair_variables"]
