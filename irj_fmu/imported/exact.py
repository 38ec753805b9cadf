"""Exact derivatives of a user's model-exchange FMU through CasADi's import, where they check out.

The import asks the FMU for directional derivatives. Three things can go wrong, and all are checked
once: an FMI 3.0 description whose ``dependencies`` leave the parameters out (zero derivatives, and
wrong ones beside them), an FMU that refuses or ignores parameters after initialization, and
derivatives that are wrong in the FMU itself.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from casadi_models.solve import runge_kutta
from irj_fmu.host.run import FmuError
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.library import UserFmu, UserInstance
from irj_fmu.imported.run import Window, agrees, shortened

if TYPE_CHECKING:
    from irj_fmu.imported.model import UserModel

_CHUNK: Final = 250
_AGREE: Final = 1e-4
"""Largest difference of an imported derivative from a difference quotient, relative to its
column.
"""
_UNKNOWNS: Final = "Output|ContinuousStateDerivative|InitialUnknown|EventIndicator"
_MOST_SUBSTEPS: Final = 16


class NotExact(Exception):
    """Why the import cannot be used."""


@final
class Exact:
    """Fixed Runge-Kutta steps with forward sensitivities over the imported right-hand side.

    Parameters
    ----------
    model : UserModel
    windows : sequence of Window

    Raises
    ------
    NotExact
        Where the import fails a check; a black-box simulation does then.
    """

    def __init__(self, model: UserModel, windows: Sequence[Window]) -> None:
        _suitable(model)
        self.model, self.windows = model, tuple(windows)
        self.imported = Imported(model)
        self.imported.check(windows)
        self.substeps = self._choose_substeps()

    def _choose_substeps(self) -> int:
        """As many steps per sample as agree with the driver of controlled step length."""
        short, model = shortened(self.windows[0]), self.model
        reference = model.runner().run(short, {p.name: p.value for p in model.parameters})
        count = 1
        while count <= _MOST_SUBSTEPS:
            if agrees(
                self.imported.outputs_along(short, model.values, short.start, count), reference
            ):
                return count
            count *= 2
        raise NotExact(f"{_MOST_SUBSTEPS} fixed steps per sample do not follow it")

    def simulate(self, values: Mapping[str, float], starts: FloatArray) -> list[FloatArray]:
        """See :class:`irj_fmu.imported.sensitivity.Simulator`."""
        return [
            self.imported.outputs_along(w, values, x, self.substeps)
            for w, x in zip(self.windows, starts, strict=True)
        ]

    def sensitivities(
        self, values: Mapping[str, float], starts: FloatArray, names: Sequence[str]
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """See :class:`irj_fmu.imported.sensitivity.Simulator`."""
        pairs = [
            self.imported.sensitivities_along(w, values, x, names, self.substeps)
            for w, x in zip(self.windows, starts, strict=True)
        ]
        return [p[0] for p in pairs], [p[1] for p in pairs]


def _suitable(model: UserModel) -> None:
    if model.kind != "me":
        raise NotExact("the FMU is used in co-simulation")
    if not model.fmu.promises_derivatives():
        raise NotExact("it promises no directional derivatives")
    if model.correction is not None:
        raise NotExact("a correction rides outside it")
    if model.fmu.once("me"):
        raise NotExact("a process may hold one instance of it only")
    if model.fmu.elements:
        raise NotExact("it has arrays")
    other = [m.variable for m in model.starts if m.variable not in model.fmu.states]
    if other:
        raise NotExact(f"{', '.join(other)} starts it and is no state")
    if not model.fmu.states:
        raise NotExact("it has no states")
    fixed = [p.name for p in model.parameters if model.fmu.real(p.name).variability != "tunable"]
    if fixed:
        raise NotExact(f"{', '.join(fixed)} may be set before initialization only")


def patched_copy(fmu: UserFmu) -> Path:
    """A folder with the FMU in which every output and derivative depends on all states, inputs and
    parameters.

    FMI 3.0 lists in ``dependencies`` what the standard asks for, and that leaves parameters out.
    The importer takes a missing one for a zero derivative, and packs others together that then
    disturb each other. It cannot read an unknown without a list.
    """
    folder = Path(tempfile.mkdtemp(prefix="irj-import-"))
    shutil.copytree(fmu.folder, folder, dirs_exist_ok=True)
    if fmu.version == 3:
        states = set(fmu.states)
        known = [
            v.valueReference
            for v in fmu.description.modelVariables
            if v.name in states
            or v.causality == "input"
            or (v.causality == "parameter" and v.variability == "tunable" and v.type == "Float64")
        ]
        path = folder / "modelDescription.xml"
        text = path.read_text(encoding="utf-8")
        every = " ".join(str(v) for v in known)
        for attribute in ("dependenciesKind", "dependencies"):
            text = re.sub(rf'(<(?:{_UNKNOWNS})\b[^>]*?)\s+{attribute}="[^"]*"', r"\1", text)
        text = re.sub(rf"(<(?:{_UNKNOWNS})\b)", rf'\1 dependencies="{every}"', text)
        path.write_text(text, encoding="utf-8")
    return folder


@final
class Imported:
    """The right-hand side of an FMU as a CasADi function.

    Parameters
    ----------
    model : UserModel
    """

    def __init__(self, model: UserModel) -> None:
        import casadi as ca

        self.model = model
        folder = patched_copy(model.fmu)
        weakref.finalize(self, shutil.rmtree, folder, True)
        try:
            dae = ca.DaeBuilder("user", str(folder), {})
            for name, value in model.constants.items():
                dae.set(name, float(value))
            self.states, self.inputs, self.tunable = list(dae.x()), list(dae.u()), list(dae.p())
            every = list(dae.y())
            missing = [m.variable for m in model.outputs if m.variable not in every]
            if missing:
                raise NotExact(f"{', '.join(missing)} is no output of it")
            self.rows = [every.index(m.variable) for m in model.outputs]
            self._f = dae.create("user", ["x", "u", "p"], ["ode", "y"])
            wanted = ["ode", "y", *(f"jac:{a}:{b}" for a in ("ode", "y") for b in ("x", "p"))]
            self._j = self._f.factory("user_jacobian", ["x", "u", "p"], wanted)
        except RuntimeError as error:
            raise NotExact(f"the import fails ({_first_line(error)})") from error
        fmu = model.fmu
        lost = [n for n in model.fmu.states if n not in self.states] + [
            p.name for p in model.parameters if p.name not in self.tunable
        ]
        if lost:
            raise NotExact(f"the import does not know {', '.join(lost)}")
        self._x = np.array([float(model.constants.get(n, fmu.start(n))) for n in self.states])
        self._u = np.array([float(model.constants.get(n, fmu.start(n))) for n in self.inputs])
        self._p = np.array([float(model.constants.get(n, fmu.start(n))) for n in self.tunable])
        self._driven = [self.inputs.index(m.variable) for m in model.inputs]
        self._started = [self.states.index(m.variable) for m in model.starts]
        self._cache: dict[tuple[bool, int], Any] = {}

    def vectors(
        self, values: Mapping[str, float], start: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """State at the start and parameter vector."""
        x, p = self._x.copy(), self._p.copy()
        x[self._started] = start
        for i, name in enumerate(self.tunable):
            p[i] = values.get(name, p[i])
        return x, p

    def _all_inputs(self, window: Window) -> FloatArray:
        u = np.tile(self._u[:, None], (1, len(window.time)))
        u[self._driven] = window.inputs.T
        return u

    # --- steps ------------------------------------------------------------------------------------

    def _stepper(self, moving: bool, substeps: int) -> Any:
        """One chunk of samples: (state, inputs and step lengths, parameters) -> states after,
        outputs before each step.
        """
        if (moving, substeps) in self._cache:
            return self._cache[moving, substeps]
        import casadi as ca

        nx, n_p, nu = len(self.states), len(self.tunable), len(self.inputs)
        n_s = nx + n_p
        z0, v, p = (
            ca.MX.sym("z", nx * (1 + n_s) if moving else nx),
            ca.MX.sym("v", nu + 1),
            ca.MX.sym("p", n_p),
        )
        u, h = v[:nu], v[nu] / substeps
        seed = ca.MX(ca.DM(np.hstack([np.zeros((n_p, nx)), np.eye(n_p)])))

        def slopes(z: Any) -> Any:
            if not moving:
                return self._f(z, u, p)[0]
            ode, _, a, b, *_ = self._j(z[:nx], u, p)
            return ca.vertcat(ode, ca.vec(a @ ca.reshape(z[nx:], nx, n_s) + b @ seed))

        z = z0
        for _ in range(substeps):
            z = runge_kutta(lambda _, at: slopes(at), z, h)
        if moving:
            _, y, _, _, c, d = self._j(z0[:nx], u, p)
            dy = c @ ca.reshape(z0[nx:], nx, n_s) + d @ seed
            out = ca.vertcat(y[self.rows], ca.vec(dy[self.rows, :]))
        else:
            out = self._f(z0, u, p)[1][self.rows]
        one = ca.Function("one", [z0, v, p], [z, ca.densify(out)])
        self._cache[moving, substeps] = one.mapaccum("chunk", _CHUNK)
        return self._cache[moving, substeps]

    def _along(
        self, window: Window, z: FloatArray, p: FloatArray, moving: bool, substeps: int
    ) -> FloatArray:
        chunk = self._stepper(moving, substeps)
        n = len(window.time)
        padded = _CHUNK * (-(-n // _CHUNK))
        v = np.zeros((len(self.inputs) + 1, padded))
        v[:-1, :n] = self._all_inputs(window)
        v[:-1, n:] = v[:-1, n - 1 : n]
        v[-1, : n - 1] = np.diff(window.time)
        every = np.tile(p[:, None], (1, _CHUNK))
        parts = []
        try:
            for first in range(0, padded, _CHUNK):
                after, out = chunk(z, v[:, first : first + _CHUNK], every)
                z = np.asarray(after)[:, -1]
                parts.append(np.asarray(out))
        except RuntimeError as error:
            raise FmuError(
                f"{self.model.fmu.path.name}: the imported FMU fails ({_first_line(error)})"
            ) from error
        return np.concatenate(parts, axis=1)[:, :n].T

    def outputs_along(
        self, window: Window, values: Mapping[str, float], start: FloatArray, substeps: int
    ) -> FloatArray:
        """Outputs (n, outputs)."""
        x, p = self.vectors(values, start)
        return self._along(window, x, p, False, substeps)

    def sensitivities_along(
        self,
        window: Window,
        values: Mapping[str, float],
        start: FloatArray,
        names: Sequence[str],
        substeps: int,
    ) -> tuple[FloatArray, FloatArray]:
        """Outputs, and derivatives (n, outputs, names + starts)."""
        x, p = self.vectors(values, start)
        nx, n_p, ny = len(x), len(p), len(self.rows)
        seed = np.hstack([np.eye(nx), np.zeros((nx, n_p))])
        found = self._along(window, np.concatenate([x, seed.T.ravel()]), p, True, substeps)
        cube = found[:, ny:].reshape(len(found), nx + n_p, ny).transpose(0, 2, 1)
        columns = [nx + self.tunable.index(n) for n in names] + self._started
        return found[:, :ny], cube[:, :, columns]

    # --- checks -----------------------------------------------------------------------------------

    def check(self, windows: Sequence[Window]) -> None:
        """Hold values and derivatives to those of a fresh instance.

        Raises
        ------
        NotExact
            With what does not agree.
        """
        x, p = self.vectors(self.model.values, windows[0].start)
        inputs = (
            self._all_inputs(windows[0])[:, len(windows[0].time) // 2] if self._driven else self._u
        )
        generator = np.random.default_rng(0)
        size = np.maximum(np.abs(x), 0.1)
        for _ in range(2):
            at = x + size * generator.standard_normal(len(x))
            moved = p * (1 + 0.02 * generator.standard_normal(len(p)))
            try:
                value = [np.asarray(r) for r in self._j(at, inputs, moved)]
            except RuntimeError as error:
                raise NotExact(
                    f"it refuses what the import asks for ({_first_line(error)})"
                ) from error
            self._check_value(at, inputs, moved, value[0].ravel())
            for name, point, columns in (("states", at, (2, 4)), ("parameters", moved, (3, 5))):
                quotient = self._quotient(name, at, inputs, moved)
                found = np.vstack([value[c].reshape(-1, len(point)) for c in columns])
                scale = np.maximum(np.abs(quotient).max(axis=0, initial=0.0), 1e-6)
                if point.size and np.any(np.abs(found - quotient).max(axis=0) > _AGREE * scale):
                    raise NotExact(
                        f"its derivatives with respect to {name} differ from difference quotients"
                    )

    def _check_value(self, x: FloatArray, u: FloatArray, p: FloatArray, found: FloatArray) -> None:
        """A fresh instance whose parameters are set before initialization must give the same
        right-hand side.
        """
        model = self.model
        with UserInstance(model.fmu, "me") as fresh:
            fresh.begin(
                0.0, {**model.constants, **dict(zip(self.tunable, p.tolist(), strict=True))}
            )
            block = fresh.block(self.inputs)
            block.array[:] = u
            fresh.write(block)
            fresh.ready()
            order = [self.states.index(n) for n in model.fmu.states]
            slope = fresh.slope(0.0, x[order])
        if np.any(np.abs(slope - found[order]) > 1e-9 * np.maximum(np.abs(slope), 1.0)):
            raise NotExact(
                "the imported right-hand side differs from that of an instance started with the "
                "same parameters"
            )

    def _quotient(self, name: str, x: FloatArray, u: FloatArray, p: FloatArray) -> FloatArray:
        """Central differences of derivatives and outputs, (states + all outputs, columns)."""
        point = x if name == "states" else p
        columns = []
        for i in range(len(point)):
            # small enough for a law that turns within a thousandth of its argument
            step = 1e-6 * max(abs(point[i]), 1e-2)
            sides = []
            for sign in (1.0, -1.0):
                moved = point.copy()
                moved[i] += sign * step
                pair = self._f(moved, u, p) if name == "states" else self._f(x, u, moved)
                sides.append(np.concatenate([np.asarray(part).ravel() for part in pair]))
            columns.append((sides[0] - sides[1]) / (2 * step))
        return np.column_stack(columns) if columns else np.empty((0, 0))


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:160] if lines else type(error).__name__


__all__ = ["Exact", "Imported", "NotExact", "patched_copy"]
