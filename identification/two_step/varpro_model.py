"""Separable models: outputs that are linear in some parameters and nonlinear in a few others
(thesis 3.6).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models.term import LINK_INERTIA
from identification.errors import InputError

if TYPE_CHECKING:
    from casadi_models import JointModel

FloatArray = npt.NDArray[np.float64]
Columns = Callable[[FloatArray, FloatArray], FloatArray]
Sensitivity = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]

JOINT_CHANNELS: Final = (
    "motor_position",
    "motor_velocity",
    "motor_acceleration",
    "link_position",
    "link_velocity",
    "link_acceleration",
)
VELOCITY_BOX: Final = (0.005, 1.0)
"""Box of a shape velocity as shares of the 99 % velocity: 2.3 decades."""
_BLOCK = 256


@final
@dataclass(frozen=True)
class Coefficient:
    """A parameter that enters linearly.

    Attributes
    ----------
    name, unit : str
    non_negative : bool
        True where a negative value has no physical meaning (friction, stiffness, inertia).
    """

    name: str
    unit: str = ""
    non_negative: bool = False


@final
@dataclass(frozen=True)
class Shape:
    """A parameter that enters nonlinearly, with the box in which it is searched.

    Attributes
    ----------
    name : str
    low, high : float
        Finite box.
    nominal : float
        Value to which the parameter is frozen where the data cannot identify it.
    unit : str
    """

    name: str
    low: float
    high: float
    nominal: float
    unit: str = ""

    def __post_init__(self) -> None:
        finite = all(math.isfinite(v) for v in (self.low, self.high, self.nominal))
        if not finite or not self.low < self.high or not self.low <= self.nominal <= self.high:
            raise InputError(
                f"shape parameter {self.name}: box [{self.low}, {self.high}], nominal "
                f"{self.nominal}; give finite low < high with the nominal value inside"
            )

    @property
    def logarithmic(self) -> bool:
        """True where the parameter is searched on a logarithmic scale (its box is positive)."""
        return self.low > 0

    def inner(self, value: float) -> float:
        """Value on the search scale."""
        return math.log(value) if self.logarithmic else value

    def outer(self, value: float) -> float:
        """Value in user units from the search scale, kept inside the box."""
        return min(max(math.exp(value) if self.logarithmic else value, self.low), self.high)


@final
@dataclass(frozen=True)
class SeparableModel:
    """y = phi(signals, nonlinear) theta + rest(signals, nonlinear).

    Attributes
    ----------
    columns : callable
        phi: (signals (samples, channels), nonlinear (shapes,)) -> (samples, outputs, coefficients),
        or (samples, coefficients) for one output.
    coefficients : tuple of Coefficient
    shapes : tuple of Shape
    channels : tuple of str
        Names of the columns of `signals`.
    outputs : int
    rest : callable, optional
        Same arguments as `columns`, -> (samples, outputs): what neither belongs to y nor to the
        coefficients.
    sensitivity : callable, optional
        (signals, nonlinear, theta) -> (samples, outputs, shapes): derivative of phi theta + rest
        with respect to the nonlinear parameters. Finite differences where it is missing.
    """

    columns: Columns
    coefficients: tuple[Coefficient, ...]
    shapes: tuple[Shape, ...]
    channels: tuple[str, ...] = ()
    outputs: int = 1
    rest: Columns | None = None
    sensitivity: Sensitivity | None = None

    def __post_init__(self) -> None:
        names = [*(c.name for c in self.coefficients), *(s.name for s in self.shapes)]
        if not self.coefficients:
            raise InputError(
                "separable model: it has no linear coefficient; use a plain least-squares fit "
                "instead"
            )
        if len(set(names)) != len(names):
            raise InputError(
                f"separable model: parameter names repeat ({', '.join(names)}); give each its own"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        return tuple(c.name for c in self.coefficients)

    @property
    def shape_names(self) -> tuple[str, ...]:
        """Names of the shape parameters."""
        return tuple(s.name for s in self.shapes)

    @property
    def nominal(self) -> FloatArray:
        """Nominal values of the shapes, shape (shapes,)."""
        return np.array([s.nominal for s in self.shapes])

    def matrix(self, signals: FloatArray, nonlinear: FloatArray) -> FloatArray:
        """phi in full shape (samples, outputs, coefficients)."""
        found = np.asarray(self.columns(signals, nonlinear), dtype=np.float64)
        if found.ndim == 2 and self.outputs == 1:
            found = found[:, None, :]
        if found.shape != (len(signals), self.outputs, len(self.coefficients)):
            raise InputError(
                f"separable model: phi has shape {found.shape}; give ({len(signals)}, "
                f"{self.outputs}, {len(self.coefficients)})"
            )
        return found

    def remainder(self, signals: FloatArray, nonlinear: FloatArray) -> FloatArray:
        """What is known of y, shape (samples, outputs); zero without `rest`."""
        if self.rest is None:
            return np.zeros((len(signals), self.outputs))
        return np.asarray(self.rest(signals, nonlinear), dtype=np.float64).reshape(
            len(signals), self.outputs
        )

    def gradient(self, signals: FloatArray, nonlinear: FloatArray, theta: FloatArray) -> FloatArray:
        """d(phi theta + rest)/d nonlinear, shape (samples, outputs, shapes), by the model or by
        differences.
        """
        if self.sensitivity is not None:
            found = np.asarray(self.sensitivity(signals, nonlinear, theta), dtype=np.float64)
            return found.reshape(len(signals), self.outputs, len(self.shapes))
        rows = []
        for i, shape in enumerate(self.shapes):
            step = 1e-6 * (abs(nonlinear[i]) or shape.high - shape.low)
            values = []
            for sign in (1.0, -1.0):
                at = nonlinear.copy()
                at[i] += sign * step
                values.append(self.matrix(signals, at) @ theta + self.remainder(signals, at))
            rows.append((values[0] - values[1]) / (2 * step))
        return np.stack(rows, axis=-1) if rows else np.zeros((len(signals), self.outputs, 0))

    def with_boxes(self, boxes: Mapping[str, tuple[float, float]]) -> SeparableModel:
        """The model with other search boxes; the nominal values are moved inside."""
        unknown = set(boxes) - set(self.shape_names)
        if unknown:
            raise InputError(
                f"with_boxes: no shape parameter {sorted(unknown)[0]!r}; there are "
                f"{self.shape_names}"
            )
        changed = tuple(
            replace(s, low=low, high=high, nominal=min(max(s.nominal, low), high))
            for s in self.shapes
            for low, high in [boxes.get(s.name, (s.low, s.high))]
        )
        return replace(self, shapes=changed)

    def frozen(self, values: Mapping[str, float]) -> SeparableModel:
        """The model with some shape parameters held at given values."""
        free = [i for i, s in enumerate(self.shapes) if s.name not in values]
        full = np.array([values.get(s.name, s.nominal) for s in self.shapes])

        def spread(nonlinear: FloatArray) -> FloatArray:
            at = full.copy()
            at[free] = nonlinear
            return at

        rest, sensitivity = self.rest, self.sensitivity
        return SeparableModel(
            columns=lambda s, e: self.columns(s, spread(e)),
            coefficients=self.coefficients,
            shapes=tuple(self.shapes[i] for i in free),
            channels=self.channels,
            outputs=self.outputs,
            rest=None if rest is None else lambda s, e: rest(s, spread(e)),
            sensitivity=None
            if sensitivity is None
            else lambda s, e, t: sensitivity(s, spread(e), t)[..., free],
        )


def from_casadi(
    regressor: Any,
    coefficients: Sequence[Coefficient],
    shapes: Sequence[Shape],
    channels: Sequence[str] = (),
) -> SeparableModel:
    """A separable model from a CasADi function of one sample.

    Parameters
    ----------
    regressor : casadi.Function
        (signals (channels,), nonlinear (shapes,)) -> phi (outputs, coefficients), or -> (phi, rest
        (outputs,)).
    coefficients, shapes, channels
        As in :class:`SeparableModel`.

    Raises
    ------
    InputError
        The sizes of the function do not fit.
    """
    import casadi as ca

    outputs, count = regressor.size1_out(0), regressor.size2_out(0)
    if count != len(coefficients) or regressor.size1_in(1) != len(shapes):
        raise InputError(
            f"from_casadi: the function has {count} columns and {regressor.size1_in(1)} "
            "nonlinear parameters; "
            f"{len(coefficients)} coefficients and {len(shapes)} shapes are named"
        )
    s = ca.SX.sym("s", regressor.size1_in(0))
    eta, theta = ca.SX.sym("eta", len(shapes)), ca.SX.sym("theta", count)
    found = regressor(s, eta)
    phi, known = found if isinstance(found, tuple | list) else (found, ca.SX.zeros(outputs, 1))
    empty = ca.SX(known).is_zero()
    phi, known = ca.densify(phi), ca.densify(known)
    value = _Mapped(ca.Function("value", [s, eta], [phi]))
    remainder = _Mapped(ca.Function("rest", [s, eta], [known]))
    slope = _Mapped(
        ca.Function("slope", [s, eta, theta], [ca.densify(ca.jacobian(phi @ theta + known, eta))])
    )
    return SeparableModel(
        columns=value,
        coefficients=tuple(coefficients),
        shapes=tuple(shapes),
        channels=tuple(channels),
        outputs=outputs,
        rest=None if empty else (lambda signals, nonlinear: remainder(signals, nonlinear)[:, :, 0]),
        sensitivity=slope,
    )


@final
class _Mapped:
    """A CasADi function of one sample, run over a record without copies; one buffer per thread."""

    def __init__(self, function: Any) -> None:
        self._function = function
        self._local = threading.local()

    def __call__(self, signals: FloatArray, *fixed: FloatArray) -> FloatArray:
        """Values (samples, rows, columns)."""
        samples, channels = signals.shape
        block = 1 if samples == 1 else _BLOCK
        trigger, given, held, out = self._buffers(block, channels)
        for target, item in zip(held, fixed, strict=True):
            target[:] = item
        rows, columns = self._function.size1_out(0), self._function.size2_out(0)
        result = np.empty((samples, rows, columns))
        for at in range(0, samples, block):
            count = min(block, samples - at)
            given[:count] = signals[at : at + count]
            trigger()
            result[at : at + count] = out[:count].transpose(0, 2, 1)
        return result

    def _buffers(
        self, block: int, channels: int
    ) -> tuple[Any, FloatArray, list[FloatArray], FloatArray]:
        kept = self._local.__dict__.setdefault("kept", {})
        if block not in kept:
            one = self._function
            fixed = list(range(1, one.n_in()))
            function = (
                one if block == 1 else one.map(f"{one.name()}_{block}", "serial", block, fixed, [])
            )
            given = np.zeros((block, channels))
            held = [np.zeros(one.size1_in(i)) for i in fixed]
            out = np.zeros((block, one.size2_out(0), one.size1_out(0)))
            buffer, trigger = function.buffer()
            for i, item in enumerate([given, *held]):
                buffer.set_arg(i, item.data)
            buffer.set_res(0, out.data)
            kept[block] = (function, buffer, trigger, given, held, out)
        _, _, trigger, given, held, out = kept[block]
        return trigger, given, held, out


def smooth_friction(velocity: FloatArray, *, exponent: bool = False) -> SeparableModel:
    """Smooth Stribeck friction (2.77): T = b w + C1 tanh(w/w1) + C2 w exp(-(|w|/wS)^dS).

    Parameters
    ----------
    velocity : (n,) array
        Velocities of the record [rad/s]: they give the boxes of w1 and wS.
    exponent : bool
        Search dS in [0.3, 3] too; it is 1 otherwise.
    """
    import casadi as ca

    low, high = velocity_box(velocity)
    w = ca.SX.sym("w")
    eta = ca.SX.sym("eta", 3 if exponent else 2)
    power = eta[2] if exponent else 1.0
    decay = ca.exp(-((ca.sqrt(w**2 + 1e-24) / eta[1]) ** power))
    phi = ca.horzcat(w, ca.tanh(w / eta[0]), w * decay)
    middle = math.sqrt(low * high)
    shapes = [Shape("w1", low, high, middle, "rad/s"), Shape("wS", low, high, middle, "rad/s")]
    if exponent:
        shapes.append(Shape("dS", 0.3, 3.0, 1.0, "1"))
    coefficients = [
        Coefficient("b", "N.m.s/rad", True),
        Coefficient("C1", "N.m", True),
        Coefficient("C2", "N.m.s/rad", True),
    ]
    return from_casadi(
        ca.Function("friction", [w, eta], [phi]), coefficients, shapes, ("velocity",)
    )


def velocity_box(velocity: FloatArray) -> tuple[float, float]:
    """Search box of a shape velocity: what the record's velocities can resolve, 2.3 decades
    [rad/s].
    """
    speed = np.abs(velocity[np.isfinite(velocity)])
    top = float(np.quantile(speed, 0.99)) if speed.size else 0.0
    if top <= 0:
        raise InputError(
            "velocity box: the record does not move; give a record with motion, or boxes by hand"
        )
    return VELOCITY_BOX[0] * top, VELOCITY_BOX[1] * top


def from_joint(model: JointModel, signals: FloatArray) -> SeparableModel:
    """A separable model from a joint's declared physics.

    Its outputs are the inverse dynamics: the drive torque, and 0 for the link where the joint is
    elastic; with a known link torque use :func:`from_casadi`.

    Parameters
    ----------
    model : JointModel
        Without internal states (hysteresis, LuGre).
    signals : (n, 6) array
        Record in the order of :data:`JOINT_CHANNELS`, link-referred SI; gives the boxes of the
        shapes. The inertias of an elastic joint's link are kept as known values, which fixes the
        scale of the second output.

    Raises
    ------
    InputError
        The model has internal states.
    """
    import casadi as ca

    functions = model.functions
    if functions.memory_names:
        raise InputError(
            "from_joint: the model has effects with internal states; drop them for the two-step fit"
        )
    coefficients = tuple(
        n for n in model.linear_parameters if not (model.is_elastic and n == LINK_INERTIA)
    )
    at = {p.name: p for p in model.parameters}
    nuisance = [n for n in model.parameter_names if n not in model.linear_parameters]
    shapes = [joint_shape(model, n, signals) for n in nuisance]
    s, eta = ca.SX.sym("s", len(JOINT_CHANNELS)), ca.SX.sym("eta", len(shapes))
    values = model.value_vector()
    p = ca.vertcat(
        *(eta[nuisance.index(n)] if n in nuisance else v for n, v in zip(at, values, strict=True))
    )
    elastic = model.is_elastic
    x = ca.vertcat(s[0], s[1], s[3], s[4]) if elastic else s[0:2]
    a = ca.vertcat(s[2], s[5]) if elastic else s[2]
    full, rest = functions.regressor(x, a, ca.SX.zeros(3, 1), p)
    index = [model.linear_parameters.index(n) for n in coefficients]
    if elastic:
        link = model.linear_parameters.index("link_inertia")
        rest = rest + full[:, link] * values[model.parameter_names.index("link_inertia")]
    function = ca.Function("joint", [s, eta], [full[:, index], rest])
    declared = [Coefficient(n, at[n].unit, at[n].low >= 0) for n in coefficients]
    return from_casadi(function, declared, shapes, JOINT_CHANNELS)


def joint_shape(model: JointModel, name: str, signals: FloatArray) -> Shape:
    """Search box of a shape parameter: its grid, widened, in units of the signal it is a
    fraction of.
    """
    p = next(q for q in model.parameters if q.name == name)
    reference = {
        "absolute": np.ones(1),
        "velocity": signals[:, [1, 4]],
        "position": signals[:, [0, 3]],
        "torsion": signals[:, 0] - signals[:, 3],
        "duration": np.array([float(len(signals))]),
    }[p.scale]
    unit = float(np.quantile(np.abs(reference), 0.99))
    grid = p.grid or (0.1 * abs(p.start) or -1.0, 10 * abs(p.start) or 1.0)
    low, high = max(p.low, 0.5 * min(grid) * unit), min(p.high, 2.0 * max(grid) * unit)
    if p.scale == "velocity":
        low, high = max(p.low, VELOCITY_BOX[0] * unit), min(p.high, VELOCITY_BOX[1] * unit)
    if not low < high:
        raise InputError(
            f"from_joint: no search box for {name}; does the record move? Give it a value and "
            "freeze it"
        )
    nominal = float(model.values.get(name, p.start))
    return Shape(name, low, high, min(max(nominal, low), high), p.unit)
