"""Prediction and correction of the joint filter as CasADi functions, from the joint model's own
equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any, Final

import casadi as ca

from casadi_models import JointModel
from casadi_models.functions import JointFunctions

Expression = Any

BALANCES: Final = 3
"""Disturbance torques: motor, transmission, link."""
READINGS: Final = 6
"""Drive, motor position and velocity, link position and velocity, torque."""
LEVELS: Final = 20
"""Numbers of :meth:`identification.online.filter.Levels.vector`."""

LEAST: Final = 1e-300
"""Square of a torque that is none: a model may be said to lack nothing."""
CREEP: Final = 0.1
"""Time for which a side stays at one part of the friction law while it turns [s]: what the law is
wrong by there lasts as long, and no record tells the law at such speeds well."""


class Form(Enum):
    """How a free parameter stands in a filter's state."""

    VALUE = 0
    LOGARITHM = 1
    RECIPROCAL = 2

    def value_of(self, entry: Expression) -> Expression:
        """The parameter from its entry in the state."""
        if self is Form.LOGARITHM:
            return ca.exp(entry)
        return 1 / entry if self is Form.RECIPROCAL else entry


class _Layout:
    """Symbols of a filter's state and of what it is given."""

    def __init__(
        self,
        functions: JointFunctions,
        model: JointModel,
        free: Sequence[str],
        forms: Sequence[Form],
    ) -> None:
        self.functions = functions
        self.states = len(functions.state_names) + len(functions.memory_names)
        names = model.parameter_names
        self.size = self.states + BALANCES + len(free)
        self.mean = ca.SX.sym("mean", self.size)
        self.covariance = ca.SX.sym("P", self.size, self.size)
        self.x = self.mean[: self.states]
        self.d = self.mean[self.states : self.states + BALANCES]
        self.theta = self.mean[self.states + BALANCES :]
        count = len(names)
        self.p = ca.SX.sym("p", count + LEVELS + 4 + len(free))
        self.levels = self.p[count : count + LEVELS]
        self.dry = self.p[count + LEVELS : count + LEVELS + 2]
        self.slow = self.p[count + LEVELS + 2 : count + LEVELS + 4]
        self.walks = self.p[count + LEVELS + 4 :]
        values = ca.vertsplit(self.p[:count])
        for k, (name, form) in enumerate(zip(free, forms, strict=True)):
            values[names.index(name)] = form.value_of(self.theta[k])
        self.values = ca.vertcat(*values)

    def joint(self, drive: Expression, when: Expression) -> tuple[Expression, Expression]:
        """Rates and readings of the joint with its disturbances."""
        given = ca.vertcat(drive + self.d[0], when[1], when[0])
        rates, readings = self.functions.disturbed(self.x, given, self.values, self.d[1:])
        return rates, readings


def predict_function(
    functions: JointFunctions, model: JointModel, free: Sequence[str], forms: Sequence[Form]
) -> Any:
    """(mean, P, given, p) -> mean and P one step later.

    given: drive of the sample before and of this one, 1 where the drive is read, length of the
    sample, of the step, time, temperature. Linearly implicit midpoint rule: of second order, stable
    for any stiffness. Slopes are those of the middle of the step, as the slopes of its beginning
    predict it: where a step begins inside the turn of a friction law that is narrower than the step
    is long, the law's slope there would be taken for the whole step, and brake the joint by many
    times its friction. The transition is its Cayley form, which never grows where the joint is
    dissipative.
    """
    a = _Layout(functions, model, free, forms)
    given = ca.SX.sym("given", 7)
    before, now, read, sample, h = ca.vertsplit(given[:5])
    noise, spread, lasting = a.levels[5], a.levels[6:9], a.levels[9:12]
    unknown, unknown_lasting, shift = a.levels[12], a.levels[13], a.levels[14]
    late = functions.drive_lag(a.values)
    drive = read * (before + (shift + late / sample) * (now - before))
    rates, _ = a.joint(drive, given[5:])
    slopes = ca.jacobian(rates, a.x)
    pushed = ca.jacobian(rates, a.d)
    moved = ca.jacobian(rates, a.theta)
    eye = ca.SX.eye(a.states)
    halfway = a.x + h / 2 * ca.mtimes(_inverse(eye - h / 2 * slopes), rates)
    inverse = _inverse(eye - h / 2 * ca.substitute(slopes, a.x, halfway))
    following = a.x + h * ca.mtimes(inverse, rates)
    spread = ca.vertcat(read * spread[0] + (1 - read) * unknown, spread[1:])
    lasting = ca.vertcat(read * lasting[0] + (1 - read) * unknown_lasting, lasting[1:])
    motor, link = a.x[1], a.x[3] if len(functions.state_names) > 2 else a.x[1]
    slow = [ca.exp(-((speed / a.slow[i]) ** 2)) for i, speed in enumerate((motor, link))]
    # one state stands for the torque that the model lacks, for what the law of a creeping side is
    # wrong by, and for the friction that holds a side that stands, which pulls nowhere: it fades by
    # the share of the first
    wrong = ca.vertcat(a.levels[15] ** 2 * slow[0], 0, a.levels[16] ** 2 * slow[1])
    holding = ca.vertcat(a.levels[17] ** 2 * slow[0], 0, a.levels[18] ** 2 * slow[1])
    fresh = spread**2 * (1 - ca.exp(-2 * h / lasting)) + wrong * (1 - ca.exp(-2 * h / CREEP))
    total = ca.fmax(spread**2 + wrong + holding, LEAST)  # none of them: nothing is there to fade
    fade = ca.exp(-h / lasting * spread**2 / total)
    count = len(free)
    kicked = h * ca.mtimes(inverse, pushed)
    transition = ca.vertcat(
        ca.horzcat(2 * inverse - eye, kicked, h * ca.mtimes(inverse, moved)),
        ca.horzcat(ca.SX(BALANCES, a.states), ca.diag(fade), ca.SX(BALANCES, count)),
        ca.horzcat(ca.SX(count, a.states + BALANCES), ca.SX.eye(count)),
    )
    # at a turn dry friction is unsure anew in each sample: white over one sample
    turning = [a.dry[i] ** 2 * sample * slow[i] for i in range(2)]
    white = ca.vertcat(noise**2 + turning[0], 0, turning[1]) / h
    new = ca.mtimes(ca.mtimes(kicked, ca.diag(white)), kicked.T)
    tail = ca.vertcat(fresh, a.walks**2 * h)
    covariance = ca.mtimes(transition, ca.mtimes(a.covariance, transition.T)) + ca.diagcat(
        new, ca.diag(tail)
    )
    mean = ca.vertcat(following, fade * a.d, a.theta)
    return ca.Function(
        "predict",
        [a.mean, a.covariance, given, a.p],
        ca.cse([ca.densify(mean), _symmetric(covariance)]),
        ["mean", "P", "given", "p"],
        ["mean_next", "P_next"],
    )


def update_function(
    functions: JointFunctions,
    model: JointModel,
    free: Sequence[str],
    forms: Sequence[Form],
    estimated: int,
) -> Any:
    """(mean, P, readings, used, p) -> mean, P, outputs of the sample.

    readings: drive, motor position and velocity, link position and velocity, torque; used: a flag
    for each, time, temperature. The five are taken one after the other, in Joseph's form, which
    stays positive; an innovation beyond the limit weighs less (Huber). Parameters behind the
    `estimated` ones get no gain: their errors count in what is expected, and are not found
    (Schmidt). Outputs as in
    :meth:`identification.online.filter.JointFilter.sample_function`.
    """
    a = _Layout(functions, model, free, forms)
    readings, used = ca.SX.sym("y", READINGS), ca.SX.sym("used", READINGS + 2)
    clip = a.levels[19]
    _, expected = a.joint(used[0] * readings[0], used[READINGS:])
    rows = ca.jacobian(expected, a.mean)
    mean, covariance = a.mean, a.covariance
    learns = ca.vertcat(*[1] * (a.states + BALANCES + estimated), *[0] * (len(free) - estimated))
    whitened, spread = [], []
    for i in range(READINGS - 1):
        row, on = rows[i, :], used[i + 1]
        error = readings[i + 1] - expected[i] - ca.mtimes(row, mean - a.mean)
        seen = ca.mtimes(covariance, row.T)
        total = ca.mtimes(row, seen) + a.levels[i] ** 2
        deviation = ca.sqrt(total)
        whitened.append(on * error / deviation)
        spread.append(on * deviation + (1 - on))
        wide = total * ca.fmax(1, ca.fabs(error) / (clip * deviation))
        gain = learns * on * seen / wide
        mean = mean + gain * error
        half = covariance - ca.mtimes(gain, seen.T)
        back = ca.mtimes(half, row.T)
        rest = wide - ca.mtimes(row, seen)
        covariance = _symmetric(half - ca.mtimes(back, gain.T) + rest * ca.mtimes(gain, gain.T))
    at = a.states
    own = ca.vertcat(*(ca.sqrt(covariance[k, k]) for k in range(at, at + BALANCES)))
    out = ca.vertcat(*whitened, *spread, mean[at : at + BALANCES], own, mean[:at])
    return ca.Function(
        "update",
        [a.mean, a.covariance, readings, used, a.p],
        ca.cse([ca.densify(mean), covariance, ca.densify(out)]),
        ["mean", "P", "y", "used", "p"],
        ["mean_next", "P_next", "out"],
    )


def _symmetric(matrix: Expression) -> Expression:
    """The matrix of its upper triangle: what lies below is not computed."""
    upper = ca.triu(ca.densify(matrix))
    return ca.densify(ca.triu2symm(upper))


def _inverse(matrix: Expression) -> Expression:
    """Inverse of a symbolic matrix by elimination without pivots: those of I - h/2 J stay above
    one where the joint is dissipative. Structural zeros cost nothing.
    """
    count = matrix.shape[0]
    left = [[matrix[i, j] for j in range(count)] for i in range(count)]
    right = [[ca.SX(1.0 if i == j else 0.0) for j in range(count)] for i in range(count)]
    for k in range(count):
        for j in range(count):
            right[k][j] = right[k][j] / left[k][k]
        for j in range(k + 1, count):
            left[k][j] = left[k][j] / left[k][k]
        for i in range(count):
            if i != k and not _is_zero(left[i][k]):
                factor = left[i][k]
                for j in range(k + 1, count):
                    left[i][j] = left[i][j] - factor * left[k][j]
                for j in range(count):
                    right[i][j] = right[i][j] - factor * right[k][j]
    return ca.vertcat(*(ca.horzcat(*row) for row in right))


def _is_zero(entry: Expression) -> bool:
    return entry.nnz() == 0 or bool(entry.is_zero())
