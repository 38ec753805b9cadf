"""What a user's FMU leaves in every balance of its joint, from restarts at measured states.

The FMU is started at the measured positions and velocities of a sample and runs for two samples.
The second difference of its positions is the acceleration that it gives there, so its drive, link
and gear laws are seen apart, without a controller. They are written as a record of a joint with
nothing but inertias and a spring, which that joint explains exactly where the FMU lacks nothing:

    drive  = J_m a_m + P,    coupling torque = J_l a_l - P,    torque = reading + P - T

with the FMU's accelerations a and its gear torque T, and P = K d + D d' from its torsion d in the
middle of the run. J_m, K and D follow from how its accelerations answer to the input and to the
other side's position and velocity, J_l from the reaction. What P takes out is what a wrong law of
one side does to the other within the run; what it does to its own side is taken out by the slope of
that side's resistance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, final

import numpy as np

from identification.balance.colour import white
from identification.balance.dataset import pointwise_kernel
from identification.balance.noise import noise_level
from identification.data.record import Record
from identification.errors import InputError
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.correction import CorrectionLaw
from irj_fmu.imported.port import feedback_of, port_of
from irj_fmu.imported.run import Runner, Window, shortened
from irj_fmu.imported.tracking import smooth_slope

if TYPE_CHECKING:
    from irj_fmu.imported.model import UserModel

EVERY: Final = 0.004
"""Time between restarts [s]: fifteen to the kernel of the balances, whose nonlinear laws take a
point every 2 ms; in between what the FMU resists with is taken as straight."""
PROBES: Final = 40
"""Restarts that inertias and stiffness are taken from: their scatter is that of a smooth law."""
PROBE: Final = 1e-3
"""Step of such a probe, as a share of the channel's standard deviation: small beside a bend of the
law, large beside rounding."""
SAME: Final = 0.05
"""Share of the torque for acceleration by which restarts along the FMU's own run may miss that run;
a state that is not started misses it wholly, a friction law of 1 ms between its samples by 1 %."""
MOVED: Final = 0.3
"""Share of its relative change that a parameter moves an inertia by, where it is one: an inertia
made of two parts in the FMU moves by the share of each; friction and damping, through the run of
two samples, by a hundredth."""
STEEP: Final = 0.1
"""Share of a side's velocity that its own friction takes in one sample from which a run of two
samples is none at that velocity; viscous friction of a drive takes a hundredth."""
LEAST_DAMPING: Final = 1e-2
"""Share of what the spring does within a sample below which a damper is none: the run is then as
well without it, and a damper that is missing can be named."""
LONGEST: Final = 0.03
"""Longest kernel of a start velocity [s], as that of the nonlinear laws of every balance."""


@final
@dataclass(frozen=True)
class Side:
    """Where one side of the joint is started and read.

    Attributes
    ----------
    channel : str
        Its position.
    output : int
        Column of that position in the outputs.
    position, velocity : int
        Places of its start values.
    unit : float
        Link-referred position per unit of the output [rad or m].
    """

    channel: str
    output: int
    position: int
    velocity: int
    unit: float


@final
@dataclass(frozen=True)
class Inertias:
    """What an FMU's answers to small probes say, link-referred.

    Attributes
    ----------
    motor : float
        Drive torque per acceleration of the driven side [kg.m2].
    link, stiffness, damping : float
        Of the other side, and between them; zero for a joint of one side.
    drag : tuple of float
        Slope of each side's own resistance over its velocity [N.m.s/rad].
    """

    motor: float
    link: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    drag: tuple[float, ...] = ()


def sides_of(model: UserModel) -> tuple[Side, ...]:
    """The sides of a joint whose FMU can be started at measured states, the driven one first.

    Raises
    ------
    InputError
        Why it cannot.
    """
    port = port_of(model)
    starts = {m.channel: i for i, m in enumerate(model.starts)}
    found = []
    for i, m in enumerate(model.outputs):
        if m.channel not in ("motor_position", "link_position"):
            continue
        speed = m.channel.replace("position", "velocity")
        missing = [c for c in (m.channel, speed) if c not in starts]
        if missing:
            raise InputError(
                f"{model.fmu.path.name}: no variable of [model.start] starts at "
                f"{' and '.join(missing)}"
            )
        ratio = model.joint.gear_ratio if m.channel == "motor_position" else 1.0
        places = starts[m.channel], starts[speed]
        found.append(Side(m.channel, i, *places, 1.0 / (ratio * m.scale)))
    return tuple(sorted(found, key=lambda s: s.output != port.output))


@final
class Restart:
    """An FMU that is started again and again along records.

    Parameters
    ----------
    model : UserModel
    first : Window
        Of the first record: inertias are probed there.

    Raises
    ------
    InputError
        Where a state cannot be started, or the FMU holds more than is started.
    """

    def __init__(self, model: UserModel, first: Window, record: Record) -> None:
        self.model, self.port, self.sides = model, port_of(model), sides_of(model)
        self.runner: Runner = model.runner()
        self.values = {p.name: p.value for p in model.parameters}
        self.runner.choose_substeps(first, self.values)
        self._torque = next(
            (i for i, m in enumerate(model.outputs) if m.channel == "link_torque"), None
        )
        starts = self._starts(record, first)
        self._check(first, starts)
        self._first = first, starts
        self.inertias = self._probed(self.values)

    def moved_inertias(self, name: str, change: float) -> frozenset[str]:
        """Sides whose inertia a change of a parameter of the FMU moves, as places of an effect."""
        value = self.values.get(name)
        if value is None:
            return frozenset()
        after, least = self._probed({**self.values, name: value + change}), MOVED * abs(change)
        least = least / max(abs(value), abs(change))
        before = self.inertias
        moved = {
            "motor": abs(after.motor / before.motor - 1) > least,
            "link": len(self.sides) == 2 and abs(after.link / before.link - 1) > least,
        }
        if len(self.sides) == 1:
            moved["link"] = moved["motor"]
        return frozenset(side for side, has in moved.items() if has)

    @property
    def sizes(self) -> dict[str, float]:
        """Inertias and stiffness of the joint that is left, by the names of its parameters."""
        return self.sizes_of(self.inertias)

    def sizes_of(self, found: Inertias) -> dict[str, float]:
        """The same of other inertias."""
        if len(self.sides) == 1:
            return {"inertia": found.motor}
        sizes = {
            "motor_inertia": found.motor,
            "link_inertia": found.link,
            "stiffness": found.stiffness,
        }
        return {**sizes, "structural_damping": found.damping} if found.damping else sizes

    def inertias_at(self, values: Mapping[str, float]) -> Inertias:
        """Inertias and stiffness with other parameters of the FMU."""
        own = {**self.values, **{k: v for k, v in values.items() if k in self.values}}
        found = self._probed(own)
        # with or without a damper it is the same joint
        return found if self.inertias.damping else replace(found, damping=0.0)

    def record(
        self,
        record: Record,
        values: Mapping[str, float] | None = None,
        inertias: Inertias | None = None,
    ) -> Record:
        """A record of the joint that is left (see the head of this module), link torque on the
        link side, motor torque on the motor shaft.

        Parameters
        ----------
        record : Record
        values : mapping, optional
            Parameters of the FMU, in place of the model's.
        inertias : Inertias, optional
            Of the joint that is left, in place of those of the model's parameters. A torque that
            the FMU lacks has its size in the balances where they are those of the values.
        """
        model, sides, found = self.model, self.sides, inertias or self.inertias
        own = {**self.values, **{k: v for k, v in (values or {}).items() if k in self.values}}
        law = feedback_of(model, {**model.values, **(values or {})})
        parts: list[dict[str, FloatArray]] = []
        for w in model.windows([record]):
            starts = self._starts(record, w)
            given = self._driven(w, starts, law)
            rows = self._rows(w, starts)
            rates, speeds, path = self._answers(given, starts, rows, own)
            drive = self._mean(given, rows)
            drifts = [
                b * (speeds[:, j] - smooth_velocity(starts[rows + 1, s.velocity], model, s))
                for j, (b, s) in enumerate(zip(found.drag, sides, strict=True))
            ]
            left = found.motor * rates[:, 0] + drifts[0] - drive
            known = {"drive": left}
            if len(sides) == 2:
                twist = path[:, 0] * sides[0].unit - path[:, 1] * sides[1].unit
                pull = found.stiffness * twist + found.damping * (speeds[:, 0] - speeds[:, 1])
                known = {
                    "drive": left + pull,
                    "coupling": found.link * rates[:, 1] + drifts[1] - pull,
                }
                if self._torque is not None:
                    scale = model.outputs[self._torque].scale
                    known["torque"] = pull - path[:, -1] / scale
            inner = slice(1, int(rows[-1]) + 2)
            at = np.arange(inner.start, inner.stop)
            spread = {n: np.interp(at, rows + 1, x) for n, x in known.items()}
            part = {
                "time": w.time[inner],
                "motor_torque": (self._sampled(given)[inner] + spread["drive"])
                / model.joint.gear_ratio,
                **{
                    s.channel: w.outputs[inner, s.output] / model.outputs[s.output].scale
                    for s in sides
                },
            }
            if "coupling" in spread:
                part["coupling_torque"] = spread["coupling"]
            if "torque" in spread and self._torque is not None:
                scale = model.outputs[self._torque].scale
                part["link_torque"] = w.outputs[inner, self._torque] / scale + spread["torque"]
            parts.append(part)
        joined = {n: np.concatenate([p[n] for p in parts]) for n in parts[0]}
        joined["run"] = np.concatenate(
            [np.full(len(p["time"]), float(i)) for i, p in enumerate(parts)]
        )
        time = joined.pop("time")
        made = Record.from_channels(time, joined, name=record.name, kind=record.kind)
        return made.without("run")

    def steep(self, record: Record) -> dict[str, FloatArray]:
        """Where the run of two samples is no look at one velocity, by side, as a flag (0 or 1) for
        each sample of :meth:`record`: dry friction near a reversal answers within it.
        """
        parts: dict[str, list[FloatArray]] = {s.channel.partition("_")[0]: [] for s in self.sides}
        for w in self.model.windows([record]):
            starts, dt = self._starts(record, w), float(np.median(np.diff(w.time)))
            rows = self._rows(w, starts)
            plain, _, _ = self._answers(w, starts, rows, self.values)
            at = np.arange(1, int(rows[-1]) + 2)
            for j, s in enumerate(self.sides):
                speed = starts[:, s.velocity]
                push = max(float(np.std(np.diff(speed, 2))), PROBE * float(np.std(speed))) or 1.0
                moved, _, _ = self._answers(
                    w, starts, rows, self.values, moved=("start", s.velocity, push)
                )
                ratio = self.model.starts[s.velocity].scale / self.model.outputs[s.output].scale
                change = np.abs(moved[:, j] - plain[:, j]) * dt / (push * abs(s.unit) / ratio)
                flags = (change > STEEP).astype(np.float64)
                spread = np.ceil(np.interp(at, rows + 1, flags))
                parts[s.channel.partition("_")[0]].append(spread)
        return {side: np.concatenate(found) for side, found in parts.items()}

    # --- inside -----------------------------------------------------------------------------------

    def _rows(self, window: Window, starts: FloatArray) -> np.ndarray:
        """Samples that are restarted: every few, and all near a reversal, where friction is not
        straight."""
        count = len(window.time) - 2
        stride = max(1, round(EVERY / float(np.median(np.diff(window.time)))))
        chosen = np.zeros(count, dtype=bool)
        chosen[::stride] = True
        for s in self.sides:
            turns = np.flatnonzero(np.diff(np.sign(starts[:, s.velocity])))
            for k in range(-2 * stride, 2 * stride + 1):
                chosen[np.clip(turns + k, 0, count - 1)] = True
        return np.flatnonzero(chosen)

    def _starts(self, record: Record, window: Window) -> FloatArray:
        """Start values of every sample of a window, (n, starts)."""
        model = self.model
        first = int(np.searchsorted(record.time, window.time[0]))
        rows = slice(first, first + len(window.time))
        out = np.empty((len(window.time), len(model.starts)))
        velocities = {s.velocity: s for s in self.sides}
        for i, m in enumerate(model.starts):
            if i in velocities:
                x = np.asarray(record[velocities[i].channel][rows], dtype=np.float64)
                out[:, i] = m.scale * self._slope(x, record.dt)
            else:
                out[:, i] = m.scale * record[m.channel][rows]
        return out

    @staticmethod
    def _slope(position: FloatArray, dt: float) -> FloatArray:
        """Velocity with the kernel that the balances would take for this position."""
        part = (slice(0, len(position)),)
        noise = white(noise_level(position, part))
        return smooth_slope(position, dt, pointwise_kernel(position, part, dt, LONGEST, noise))

    def _driven(self, window: Window, starts: FloatArray, law: CorrectionLaw | None) -> Window:
        """The window with the torque of what rides outside the FMU in its input."""
        if law is None:
            return window
        side, port = self.sides[0], self.port
        q = window.outputs[:, side.output] * side.unit
        v = smooth_velocity(starts[:, side.velocity], self.model, side)
        inputs = window.inputs.copy()
        law.begin(window)
        for k, t in enumerate(window.time.tolist()):
            drive = float(window.inputs[k, port.input]) * port.torque
            inputs[k, port.input] += law.torque(t, drive, float(q[k]), float(v[k])) / port.torque
        return replace(window, inputs=inputs)

    def _mean(self, window: Window, rows: np.ndarray) -> FloatArray:
        """Drive torque that two samples of a run have in the middle, link-referred."""
        u = window.inputs[:, self.port.input] * self.port.torque
        return np.asarray((u[rows] + u[rows + 1]) / 2)

    def _sampled(self, window: Window) -> FloatArray:
        """The same at every sample: half a sample earlier than the input that is held, its noise
        left as it is.

        A longer kernel than the noise asks for would take from a fast drive what half a sample is
        of it, and a damper and an inertia would make up for that.
        """
        u = window.inputs[:, self.port.input] * self.port.torque
        dt = float(np.median(np.diff(window.time)))
        return np.asarray(u - dt / 2 * self._slope(u, dt))

    def _answers(
        self,
        window: Window,
        starts: FloatArray,
        rows: np.ndarray,
        values: Mapping[str, float],
        *,
        moved: tuple[str, int, float] | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Accelerations and velocities (rows, sides) and outputs (rows, sides and gear torque) in
        the middle of runs over two samples; `moved` is what a probe adds: ("start" or "input",
        place, size).
        """
        columns = [s.output for s in self.sides]
        columns += [] if self._torque is None else [self._torque]
        rates, path = np.empty((len(rows), len(self.sides))), np.empty((len(rows), len(columns)))
        speeds = np.empty_like(rates)
        units = np.array([s.unit for s in self.sides])
        inputs = window.inputs
        if moved is not None and moved[0] == "input":
            inputs = inputs.copy()
            inputs[:, moved[1]] += moved[2]
        if moved is not None and moved[0] == "start":
            starts = starts.copy()
            starts[:, moved[1]] += moved[2]
        for i, k in enumerate(rows.tolist()):
            three = slice(k, k + 3)
            time = window.time[three]
            y = self.runner.run(
                Window(time, inputs[three], window.outputs[three], starts[k]), values
            )
            path[i] = y[1, columns]
            a, b = time[1] - time[0], time[2] - time[1]
            q = y[:, columns[: len(units)]] * units
            rates[i] = 2 * ((q[2] - q[1]) / b - (q[1] - q[0]) / a) / (a + b)
            speeds[i] = (q[2] - q[0]) / (a + b)
        return rates, speeds, path

    def _check(self, window: Window, starts: FloatArray) -> None:
        """Restarts along the FMU's own run must give that run: else it holds what is not started.

        Raises
        ------
        InputError
            Where they do not.
        """
        short = shortened(window)
        own = self.runner.run(short, self.values, starts[0])
        begun = starts[: len(own)].copy()
        dt = float(np.median(np.diff(short.time)))
        for s in self.sides:
            scale = [
                self.model.starts[i].scale / self.model.outputs[s.output].scale
                for i in (s.position, s.velocity)
            ]
            begun[:, s.position] = own[:, s.output] * scale[0]
            begun[:, s.velocity] = np.gradient(own[:, s.output], dt) * scale[1]
        rows = np.unique(np.linspace(1, len(own) - 4, PROBES * 4).astype(int))
        found, _, _ = self._answers(short, begun, rows, self.values)
        for j, s in enumerate(self.sides):
            q = own[:, s.output] * s.unit
            true = (q[rows + 2] - 2 * q[rows + 1] + q[rows]) / dt**2
            missed = float(np.median(np.abs(found[:, j] - true)))
            if not missed <= SAME * float(np.median(np.abs(true))):
                raise InputError(
                    f"{self.model.fmu.path.name}: started at the positions and velocities of its "
                    f"own run it does not go on as that run does ({s.channel}); it holds states "
                    "that [model.start] does not start"
                )

    def _probed(self, values: Mapping[str, float]) -> Inertias:
        """Inertias and stiffness from small probes along the first window.

        Each probe moves the input or a start value, and what it changes is read in the middle of
        the runs: J_m a_m + K d + D d' + B w + C q is the input's change or nothing, and J_l a_l +
        B w + C q is K d + D d'. Own slopes B and C are there so that they do not end in J.
        """
        window, starts = self._first
        port, sides = self.port, self.sides
        rows = np.unique(np.linspace(0, len(window.time) - 3, PROBES).astype(int))

        def run(moved: tuple[str, int, float] | None) -> FloatArray:
            rates, speeds, path = self._answers(window, starts, rows, values, moved=moved)
            units = [s.unit for s in sides]
            return np.hstack([rates, speeds, path[:, : len(sides)] * units])

        plain = run(None)
        size = PROBE * (float(np.std(window.inputs[:, port.input])) or 1.0)
        probes: list[tuple[tuple[str, int, float], float]] = [
            (("input", port.input, size), size * port.torque)
        ]
        for s in sides:
            for place in (s.position, s.velocity):
                step = PROBE * (float(np.std(starts[:, place])) or 1.0)
                probes.append((("start", place, step), 0.0))
        answers = np.array([np.median(run(moved) - plain, axis=0) for moved, _ in probes])
        drive = np.array([torque for _, torque in probes])
        scale = 1.0 / np.maximum(np.abs(answers[:, : len(sides)]).max(axis=1), 1e-300)
        if len(sides) == 1:
            alone = np.linalg.lstsq(answers * scale[:, None], drive * scale, rcond=None)[0]
            self._must_move(float(alone[0]))
            return Inertias(float(alone[0]), drag=(float(alone[1]),))
        a, w, q = answers[:, 0:2], answers[:, 2:4], answers[:, 4:6]
        twist = np.column_stack([q[:, 0] - q[:, 1], w[:, 0] - w[:, 1]])
        left = np.column_stack([a[:, 0], twist, w[:, 0], q[:, 0]])
        found = np.linalg.lstsq(left * scale[:, None], drive * scale, rcond=None)[0]
        motor, stiffness, damping = (float(x) for x in found[:3])
        self._must_move(motor)
        right = np.column_stack([a[:, 1], w[:, 1], q[:, 1]])
        pull = twist @ found[1:3]
        other = np.linalg.lstsq(right * scale[:, None], pull * scale, rcond=None)[0]
        link, drag = float(other[0]), (float(found[3]), float(other[1]))
        if not (stiffness > 0 and link > 0):
            raise InputError(
                f"{self.model.fmu.path.name}: its link does not answer to its motor; check the "
                "channels that are mapped"
            )
        dt = float(np.median(np.diff(window.time)))
        damping = damping if damping > LEAST_DAMPING * stiffness * dt else 0.0
        return Inertias(motor, link, stiffness, damping, drag)

    def _must_move(self, inertia: float) -> None:
        if not (np.isfinite(inertia) and inertia > 0):
            raise InputError(
                f"{self.model.fmu.path.name}: its drive input does not move its position; check "
                "the channels that are mapped"
            )


def smooth_velocity(values: FloatArray, model: UserModel, side: Side) -> FloatArray:
    """Start velocities of a side, link-referred."""
    ratio = model.joint.gear_ratio if side.channel == "motor_position" else 1.0
    return np.asarray(values / (model.starts[side.velocity].scale * ratio))


__all__ = ["Inertias", "Restart", "Side", "sides_of"]
