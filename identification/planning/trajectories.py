"""Trajectory selection (thesis 3.8): which motion makes which parameter identifiable."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.errors import InputError
from identification.fitting.covariance import white_errors
from identification.planning.follow import Controller, Followed, Follower
from identification.planning.motion import COLUMNS, WORKSPACE, Motion, sinusoidal, triangular
from identification.search.mcs import mcs

__all__ = [
    "COLUMNS",
    "WORKSPACE",
    "Controller",
    "Excitation",
    "Experiment",
    "Limits",
    "Motion",
    "Selection",
    "select",
    "sinusoidal",
    "sinusoidal_grid",
    "triangular",
    "triangular_grid",
]
FloatArray = npt.NDArray[np.float64]

SPEEDS: Final = (math.radians(15.0), math.radians(45.0))
PERIODS: Final = (0.5, 6.0)


@final
@dataclass(frozen=True)
class Limits:
    """What the joint may do; infinite where nothing is said.

    Attributes
    ----------
    position : float
        Half of the workspace, |link position| [rad].
    speed : float
        |velocity| [rad/s].
    torque : float
        |drive torque|, link-referred [N.m].
    """

    position: float = math.inf
    speed: float = math.inf
    torque: float = math.inf

    def broken(self, run: Followed) -> tuple[str, ...]:
        """Names of the limits that a run breaks."""
        found = []
        if np.max(np.abs(run.states[:, [0, 2]])) > self.position:
            found.append("position")
        if np.max(np.abs(run.states[:, [1, 3]])) > self.speed:
            found.append("speed")
        if np.max(np.abs(run.drive)) > self.torque:
            found.append("torque")
        return tuple(found)


@final
@dataclass(frozen=True)
class Excitation:
    """What one motion excites.

    Attributes
    ----------
    motion : Motion
    parameters : tuple of str
        Columns of the measurement matrix.
    smallest, largest : float
        Singular values of the measurement matrix.
    relative_deviation : mapping
        Cramer-Rao standard deviation of each parameter over its value; infinite for a value of 0 or
        where the motion says nothing.
    broken : tuple of str
        Limits that the simulated joint broke.
    """

    motion: Motion
    parameters: tuple[str, ...]
    smallest: float
    largest: float
    relative_deviation: Mapping[str, float]
    broken: tuple[str, ...]

    @property
    def condition(self) -> float:
        """Largest over smallest singular value."""
        return self.largest / self.smallest if self.smallest > 0 else math.inf

    def identifiable(self, limit: float = 0.1) -> dict[str, bool]:
        """Which parameters will be known to better than `limit` of their value."""
        return {n: d <= limit for n, d in self.relative_deviation.items()}

    def by_effect(self, model: JointModel, limit: float = 0.1) -> dict[str, bool]:
        """Which effects will be identified: all their linear parameters that are judged here."""
        verdict = self.identifiable(limit)
        found = {}
        for term in model.terms:
            names = [n for n in term.names if n in verdict]
            if names:
                found[term.label] = all(verdict[n] for n in names)
        return found


@final
@dataclass(frozen=True)
class Selection:
    """All motions tried and the best.

    Attributes
    ----------
    best : Excitation
    tried : tuple of Excitation
        In the order of the grid; those of the refinement after them.
    criterion : str
    """

    best: Excitation
    tried: tuple[Excitation, ...]
    criterion: str


@final
class Experiment:
    """A joint on which motions are tried in simulation: generate, integrate, build phi, evaluate
    (3.8.1).

    Parameters
    ----------
    model : JointModel
        Elastic, without internal states, with values for its parameters.
    reduced : bool
        Leave the cubic stiffness out of phi: the thesis's reduced model.
    parameters : sequence of str, optional
        Columns of phi. By default all linear parameters but inertias and gravity, which (3.54)
        takes as known.
    noise : float or (2,) sequence
        Standard deviation of the errors in the motor's and the link's equation [N.m].
    dt : float
        Sample time of the simulation [s].
    stride : int
        Every stride-th sample is a row of phi.
    """

    def __init__(
        self,
        model: JointModel,
        *,
        reduced: bool = False,
        parameters: Sequence[str] | None = None,
        noise: float | Sequence[float] = 0.5,
        dt: float = 1e-3,
        stride: int = 10,
    ) -> None:
        if model.functions.memory_names:
            raise InputError(
                "Experiment: the model has effects with internal states; leave them out"
            )
        linear = model.linear_parameters
        chosen = (
            tuple(parameters)
            if parameters is not None
            else tuple(n for n in linear if n not in (*model.inertias, *model.weights))
        )
        chosen = tuple(n for n in chosen if not (reduced and n in model.named("stiffening")))
        unknown = [n for n in chosen if n not in linear]
        if unknown or not chosen:
            what = unknown[0] if unknown else "nothing"
            raise InputError(
                f"Experiment: {what!r} is no linear parameter; use {', '.join(linear)}"
            )
        self.model, self.parameters, self.dt, self.stride = model, chosen, dt, stride
        self.noise = np.broadcast_to(np.asarray(noise, dtype=np.float64), (2,))
        if not (self.noise > 0).all():
            raise InputError("Experiment: noise must be positive")
        self._columns = [linear.index(n) for n in chosen]
        self._follower = Follower(model, dt)
        self._maps: dict[int, Any] = {}
        values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
        self._values = np.array([values[n] for n in chosen])

    def run(self, motion: Motion) -> Followed:
        """The joint along the motion."""
        if abs(motion.dt - self.dt) > 1e-9:
            raise InputError(
                f"Experiment: the motion's sample time is {motion.dt:g} s, the simulation's "
                f"{self.dt:g} s"
            )
        return self._follower.run(motion.table)

    def matrix(self, run: Followed) -> FloatArray:
        """phi of a run, (rows, 2, parameters)."""
        rows = slice(None, None, self.stride)
        x, a = run.states[rows].T, run.accelerations[rows].T
        count = x.shape[1]
        if count not in self._maps:
            self._maps[count] = self.model.functions.regressor.map(count)
        flat = np.asarray(
            self._maps[count](x, a, np.zeros((3, count)), self.model.value_vector())[0]
        )
        phi = flat.reshape(2, count, -1).transpose(1, 0, 2)
        return phi[:, :, self._columns]

    def evaluate(
        self, motion: Motion, *, normalised: bool = False, limits: Limits | None = None
    ) -> Excitation:
        """Singular values and Cramer-Rao deviations of a motion.

        Parameters
        ----------
        motion : Motion
        normalised : bool
            Divide each column of phi by its norm before the singular values are taken (figure
            3.16).
        limits : Limits, optional
        """
        return self.judge(motion, self.run(motion), normalised=normalised, limits=limits)

    def judge(
        self,
        motion: Motion,
        run: Followed,
        *,
        normalised: bool = False,
        limits: Limits | None = None,
    ) -> Excitation:
        """As :meth:`evaluate`, from a run that is there already: one run serves the full and the
        reduced model.

        Parameters
        ----------
        motion : Motion
        run : Followed
            What :meth:`run` gave for it.
        normalised, limits
            As in :meth:`evaluate`.
        """
        phi = self.matrix(run)
        plain = phi.reshape(-1, len(self.parameters))
        norm = np.linalg.norm(plain, axis=0)
        sigma = np.linalg.svd(
            plain / np.where(norm > 0, norm, 1.0) if normalised else plain, compute_uv=False
        )
        return Excitation(
            motion,
            self.parameters,
            float(sigma[-1]),
            float(sigma[0]),
            self._deviations(phi),
            () if limits is None else limits.broken(run),
        )

    def _deviations(self, phi: FloatArray) -> dict[str, float]:
        """Cramer-Rao bound from the Fisher information phi' R^-1 phi, relative to the values."""
        deviation, _ = white_errors(
            (phi / self.noise[None, :, None]).reshape(-1, len(self.parameters))
        )
        with np.errstate(divide="ignore"):
            relative = np.where(self._values != 0, deviation / np.abs(self._values), math.inf)
        return dict(zip(self.parameters, relative.tolist(), strict=True))


def triangular_grid(
    speeds: Sequence[float] | None = None,
    *,
    duration: float = 10.0,
    dt: float = 1e-3,
    reversal: float = 0.1,
    limit: float = WORKSPACE,
) -> list[Motion]:
    """Triangular motions over the thesis's range of speeds, 15 to 45 deg/s."""
    chosen = np.linspace(*SPEEDS, 7) if speeds is None else speeds
    return [
        triangular(float(v), duration=duration, dt=dt, reversal=reversal, limit=limit)
        for v in chosen
    ]


def sinusoidal_grid(
    speeds: Sequence[float] | None = None,
    periods: Sequence[float] | None = None,
    *,
    duration: float = 15.0,
    dt: float = 1e-3,
    start: float = 0.0,
    hold: float = 0.0,
) -> list[Motion]:
    """Sinusoidal motions over the thesis's ranges, 15 to 45 deg/s and 0.5 to 6 s; speed varies
    slowest.
    """
    v = np.linspace(*SPEEDS, 7) if speeds is None else speeds
    t = np.linspace(*PERIODS, 8) if periods is None else periods
    return [
        sinusoidal(float(a), float(b), duration=duration, dt=dt, start=start, hold=hold)
        for a in v
        for b in t
    ]


def select(
    experiment: Experiment,
    motions: Sequence[Motion],
    *,
    criterion: Literal["singular_value", "normalised", "fisher"] = "fisher",
    limits: Limits | None = None,
    refine: int = 0,
) -> Selection:
    """The best of several motions.

    Parameters
    ----------
    experiment : Experiment
    motions : sequence of Motion
        See :func:`triangular_grid`, :func:`sinusoidal_grid`.
    criterion
        "singular_value": largest smallest singular value of phi (the thesis); "normalised": the
        same with normalised columns; "fisher": smallest worst relative Cramer-Rao deviation of the
        parameters.
    limits : Limits, optional
        Workspace, speed and torque, checked on the simulated joint.
    refine : int
        Further evaluations, by coordinate search over speed and period between the sinusoidal
        motions given.

    Raises
    ------
    InputError
        No motion, or none that keeps the limits.
    """
    if criterion not in ("singular_value", "normalised", "fisher"):
        raise InputError(
            f"select: unknown criterion {criterion!r}; use 'singular_value', 'normalised' or "
            "'fisher'"
        )
    tried = [
        experiment.evaluate(m, normalised=criterion == "normalised", limits=limits) for m in motions
    ]
    if refine > 0 and tried and all(m.family == "sinusoidal" for m in motions):
        tried += _refined(experiment, motions, criterion, limits, refine)
    allowed = [e for e in tried if not e.broken]
    if not allowed:
        broken = sorted({b for e in tried for b in e.broken})
        raise InputError(
            f"select: no motion keeps the limits ({', '.join(broken) or 'none given'}); widen "
            "the grid"
        )
    return Selection(min(allowed, key=lambda e: _cost(e, criterion)), tuple(tried), criterion)


def _cost(found: Excitation, criterion: str) -> float:
    if criterion == "fisher":
        finite = [d for d in found.relative_deviation.values() if math.isfinite(d)]
        lost = len(found.relative_deviation) - len(finite)
        return (math.log(max(finite)) if finite else 0.0) + 1e3 * lost
    return -math.log(max(found.smallest, 1e-300))


def _refined(
    experiment: Experiment,
    motions: Sequence[Motion],
    criterion: str,
    limits: Limits | None,
    evaluations: int,
) -> list[Excitation]:
    """Coordinate search between the grid's ends."""
    pairs = np.array([[m.parameters["speed"], m.parameters["period"]] for m in motions])
    low, high = pairs.min(axis=0), pairs.max(axis=0)
    if (low == high).any():
        return []
    base = motions[0]
    found: list[Excitation] = []

    def value(at: FloatArray) -> float:
        motion = sinusoidal(
            float(at[0]),
            float(at[1]),
            hold=base.parameters["hold"],
            start=base.parameters["start"],
            duration=float(base.time[-1] + base.dt),
            dt=base.dt,
        )
        one = experiment.evaluate(motion, normalised=criterion == "normalised", limits=limits)
        found.append(one)
        return _cost(one, criterion) + 1e6 * len(one.broken)

    mcs(value, np.column_stack([low, high]), max_evaluations=evaluations)
    return found
