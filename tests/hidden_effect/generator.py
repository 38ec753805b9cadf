"""Closed-loop recordings of simulated harmonic-drive joints with something hidden in them.

The generator is the other hand of the tests: it imports nothing of the project, has its own
equations (set-valued, smoothed or bristle friction in a midpoint time-stepping scheme, see
``_engine.py``), its own sensors and its own reference motions. Every case has other joint
parameters. Units are SI; joint parameters are link-referred.

``python -m tests.hidden_effect.generator FOLDER --seeds 2`` writes a set of every effect.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np

from tests.hidden_effect._engine import pack, simulate, write_csv
from tests.hidden_effect.hidden import LIBRARY, NEEDS_TORQUE_SENSOR, OUTSIDE, SIDED, Draw, Setting
from tests.hidden_effect.motion import plan, with_rests

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

Hidden = str | tuple[str, ...] | None
RECORDS = ("train", "train2", "test", "test2")
DT = 0.002
SPAN = 24.0
KM = 0.0553
TURNS = 160.0
COLUMNS = (
    "time_s",
    "motor_current_A",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "link_velocity_rad_s",
    "link_torque_Nm",
)
NOISE: dict[str, float] = {
    "motor_current_A": 0.004,
    "motor_velocity_rad_s": 0.24,
    "link_velocity_rad_s": 0.0025,
    "link_torque_Nm": 0.05,
}
"""Standard deviations; positions get half (motor) and a quarter (link) of a step before they
are rounded to steps.
"""
QUANTUM: dict[str, float] = {
    "motor_position_rad": TURNS * float(np.radians(0.001)),
    "link_position_rad": float(np.radians(0.0036)),
}
_TRUTH = {
    "JM": "motor_inertia_kg_m2",
    "JL": "link_inertia_kg_m2",
    "TG": "gravity_torque_Nm",
    "K": "stiffness_Nm_per_rad",
    "C": "structural_damping_Nms_per_rad",
    "M_B": "motor_viscous_Nms_per_rad",
    "M_TC": "motor_coulomb_Nm",
    "L_B": "link_viscous_Nms_per_rad",
    "L_TC": "link_coulomb_Nm",
}


@final
@dataclass(frozen=True)
class Case:
    """One joint with its recordings.

    Attributes
    ----------
    gear_ratio
        Signed ratio of motor to link angle.
    parameters
        Names and values of the integrator's parameters (link-referred).
    exact
        Per record, the noise-free columns of `COLUMNS`, shape (12000, 7).
    measured
        The same through the sensors.
    truth
        What ``truth.json`` says.
    """

    gear_ratio: float
    parameters: Mapping[str, float]
    exact: Mapping[str, FloatArray]
    measured: Mapping[str, FloatArray]
    truth: Mapping[str, object] = field(default_factory=dict)


def _stream(seed: int, *labels: object) -> np.random.Generator:
    text = "/".join(str(x) for x in (seed, *labels))
    return np.random.default_rng(
        int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
    )


def names_of(effect: Hidden) -> tuple[str, ...]:
    """The hidden names as a tuple (empty for None)."""
    if effect is None:
        return ()
    return (effect,) if isinstance(effect, str) else tuple(effect)


def draw_joint(rng: np.random.Generator) -> dict[str, float]:
    """Parameters of a plain joint near the thesis's tables 4.1 to 4.3, link-referred; NKM
    carries the ratio's sign.
    """
    ratio = TURNS if rng.random() < 0.5 else -TURNS
    smooth = float(rng.uniform(0.002, 0.006)) if rng.random() < 0.6 else 0.0
    return {
        "JM": 4.447 * rng.uniform(0.88, 1.15),
        "JL": 10.277 * rng.uniform(0.88, 1.15),
        "TG": 105.18 * rng.uniform(0.90, 1.15),
        "K": 2.1513e4 * rng.uniform(0.85, 1.18),
        "C": rng.uniform(50.0, 75.0),
        "M_B": rng.uniform(9.5, 12.5),
        "M_TC": rng.uniform(18.0, 26.0),
        "L_B": rng.uniform(1.5, 3.5),
        "L_TC": rng.uniform(0.3, 0.6),
        "N": TURNS,
        "NKM": ratio * KM,
        "KP": 13000.0 * rng.uniform(0.9, 1.1),
        "KD": 620.0 * rng.uniform(0.95, 1.05),
        "M_V0": smooth,
        "L_V0": smooth,
    }


def _dirt(rng: np.random.Generator) -> tuple[dict[str, float], dict[str, float]]:
    """Small disturbances of every dirty record: bump, odd-order error, stiff link mode, other
    friction smoothing.
    """
    smooth = float(rng.uniform(0.002, 0.008))
    changes = {
        "BUMP": 1.0,
        "BUMP_X": rng.uniform(-0.8, 0.8),
        "BUMP_W": rng.uniform(0.06, 0.12),
        "KE2": 1.5e-5,
        "KE2_O": float(np.round(rng.uniform(2.3, 5.7), 2)),
        "KE2_P": rng.uniform(0.0, 6.28),
        "FLEX": 0.03,
        "FLEX_F": 24.0,
        "FLEX_Z": 0.02,
        "M_V0": smooth,
        "L_V0": smooth,
    }
    return changes, {"dirt_bump_Nm": 1.0, "dirt_snag_Nm": 0.8, "dirt_smoothing_rad_s": smooth}


def _snag_rows(rng: np.random.Generator, torque: float, count: int) -> FloatArray:
    rows = np.zeros((count, 3))
    rows[:, 0] = np.sort(rng.uniform(0.3, SPAN - 0.3, count))
    rows[:, 1] = rng.uniform(0.04, 0.25, count)
    rows[:, 2] = torque * rng.uniform(0.6, 1.0, count)
    return rows


def _sense(rng: np.random.Generator, exact: FloatArray, sensor: Mapping[str, float]) -> FloatArray:
    table = exact.copy()
    column = {name: i for i, name in enumerate(COLUMNS)}
    table[:, column["motor_current_A"]] += sensor.get("current_offset", 0.0)
    torque = column["link_torque_Nm"]
    table[:, torque] = sensor.get("torque_gain", 1.0) * table[:, torque] + sensor.get(
        "torque_offset", 0.0
    )
    for name, deviation in NOISE.items():
        table[:, column[name]] += deviation * rng.standard_normal(len(table))
    for name, share in (("motor_position_rad", 0.5), ("link_position_rad", 0.25)):
        step, i = QUANTUM[name], column[name]
        table[:, i] = step * np.round(table[:, i] / step + share * rng.standard_normal(len(table)))
    return table


def _draws(
    effect: Hidden, seed: int, base: Mapping[str, float], size: float, side: str
) -> dict[str, Draw]:
    found: dict[str, Draw] = {}
    for name in names_of(effect):
        make = LIBRARY.get(name) or OUTSIDE.get(name)
        if make is None:
            raise ValueError(f"no such effect: {name!r}")
        place = "L" if side == "link" and name in SIDED else "M"
        found[name] = make(Setting(_stream(seed, name), size, base, place))
    return found


def simulate_case(
    effect: Hidden,
    seed: int,
    *,
    size: float = 1.0,
    dirt: bool = False,
    torque_sensor: bool = True,
    unloaded: bool = False,
    side: str = "motor",
    overrides: Mapping[str, float] | None = None,
    records: Iterable[str] = RECORDS,
    span: float = SPAN,
    rests: float = 0.0,
    references: Mapping[str, tuple[FloatArray, FloatArray]] | None = None,
) -> Case:
    """Draw a joint, hide the effect in it, record it.

    Parameters
    ----------
    effect
        Key of the library, kind from outside, tuple of several, or None.
    seed
        Same seed and effect, same case, bit by bit. ``unloaded`` keeps the joint and changes the
        motion.
    size
        Factor on the strength of the effect.
    dirt
        Small unmodelled disturbances in every record.
    torque_sensor
        False: effects of the torque sensor are not allowed, a delay sits in the current.
    unloaded
        Payload off and axis upright: no gravity torque, half the link inertia.
    side
        "motor" or "link" for friction, position torques and the added spring.
    overrides
        Parameters of the integrator to set by hand after all draws (for example ``{"KM": 0.82}``).
    records, span
        Which records, and how long [s].
    rests
        Share of the time in which the reference stands still; the joint and its path are the same.
    references
        Motions of the same joint to record in the place of the drawn ones: record name to position
        [rad] and velocity [rad/s] at each sample. Their sensors have noise of their own.
    """
    names = names_of(effect)
    if not torque_sensor and NEEDS_TORQUE_SENSOR & set(names):
        raise ValueError(f"{names} cannot be seen without a torque sensor")
    label = "+".join(names) or "none"
    base = draw_joint(_stream(seed, label, "joint"))
    draws = _draws(effect, seed, {**base, "torque_sensor": float(torque_sensor)}, size, side)
    values = dict(base)
    extra: dict[str, float] = {}
    if dirt:
        changes, extra = _dirt(_stream(seed, label, "dirt"))
        values |= changes
    sensor: dict[str, float] = {}
    for draw in draws.values():
        values |= draw.changes
        sensor |= draw.sensor or {}
    if unloaded:
        values["TG"], values["JL"] = 0.0, 0.5 * values["JL"]
    values |= overrides or {}
    given = dict(references or {})
    exact = _run(
        _stream(seed, label, "motion", unloaded),
        values,
        draws,
        dirt,
        tuple(given or records),
        span=span,
        rests=rests,
        given=given,
    )
    ratio = float(np.sign(values["NKM"])) * TURNS
    for table in exact.values():
        table[:, 2:4] *= ratio
    noise = _stream(seed, label, "noise", unloaded, *given)
    measured = {name: _sense(noise, table, sensor) for name, table in exact.items()}
    hidden = {n: dict(d.truth) for n, d in draws.items()}
    if "motor_constant_error" in hidden:
        hidden["motor_constant_error"]["motor_constant_factor"] = values["KM"]
    truth: dict[str, object] = {
        "hidden_effect": None if not names else names[0] if len(names) == 1 else list(names),
        "outside": [n for n in names if n in OUTSIDE],
        "balance": {n: d.balance for n, d in draws.items()},
        "gear_ratio": ratio,
        "seed": seed,
        "options": {"size": size, "dirt": dirt, "unloaded": unloaded, "side": side}
        | ({"rests": rests} if rests else {}),
        "link_referred": {text: values[key] for key, text in _TRUTH.items()}
        | {"friction_smoothing_rad_s": values["M_V0"]},
        "hidden": hidden | ({"dirt": dict(extra)} if dirt else {}),
        "overrides": dict(overrides or {}),
        "note": "kinematic error: T = k (q_m - q_l + A sin(order |N| q_m + phase)); cyclic: A "
        "sin(q_l + phase)",
    }
    return Case(ratio, values, exact, measured, truth)


def _run(
    rng: np.random.Generator,
    values: dict[str, float],
    draws: Mapping[str, Draw],
    dirt: bool,
    records: tuple[str, ...],
    *,
    span: float,
    rests: float,
    given: Mapping[str, tuple[FloatArray, FloatArray]],
) -> dict[str, FloatArray]:
    rows = round(span / DT)
    references = plan(rng, rows, DT)
    if rests > 0.0:
        references = {
            name: with_rests(rng, reference, DT, rests) for name, reference in references.items()
        }
    if given:
        references = dict(given)
    kept = tuple(references)
    vector = pack(values)
    states: list[FloatArray] = []
    snags: list[FloatArray] = []
    for name in kept:
        start = references[name][0][0]
        states.append(
            np.array([start - values["TG"] * np.sin(start) / values["K"], 0.0, start, 0.0])
        )
        rows_of = [np.zeros((0, 3))]
        if dirt:
            rows_of.append(_snag_rows(rng, 0.8, 12))
        if "snags" in draws:
            rows_of.append(_snag_rows(rng, float(draws["snags"].truth["snag_Nm"]), 25))
        snags.append(np.concatenate(rows_of))
    pick = [kept.index(name) for name in records]
    tables = simulate(
        [vector] * len(pick),
        [references[n] for n in records],
        [states[i] for i in pick],
        [snags[i] for i in pick],
        dt=DT,
    )
    return dict(zip(records, tables, strict=True))


def kept_columns(torque_sensor: bool, one_sided: bool) -> list[int]:
    """Indices of the columns that a joint with these sensors records."""
    count = 4 if one_sided else 7 if torque_sensor else 6
    return list(range(count))


def generate_case(
    effect: Hidden,
    seed: int,
    *,
    size: float = 1.0,
    dirt: bool = False,
    torque_sensor: bool = True,
    one_sided: bool = False,
    folder: Path,
    unloaded: bool = False,
    side: str = "motor",
    overrides: Mapping[str, float] | None = None,
    rests: float = 0.0,
) -> Path:
    """Write a case: train, train2, test, test2 (csv), joint.toml, truth.json; see `simulate_case`.

    ``one_sided`` keeps the motor's columns only, with a rigid start model (hd1). Returns the
    folder.
    """
    case = simulate_case(
        effect,
        seed,
        size=size,
        dirt=dirt,
        torque_sensor=torque_sensor,
        unloaded=unloaded,
        side=side,
        overrides=overrides,
        rests=rests,
    )
    folder.mkdir(parents=True, exist_ok=True)
    keep = kept_columns(torque_sensor, one_sided)
    header = ",".join(COLUMNS[i] for i in keep)
    for name, table in case.measured.items():
        write_csv(folder / f"{name}.csv", header, table[:, keep])
    effects = '["viscous", "coulomb"]' if unloaded else '["viscous", "coulomb", "gravity"]'
    lines = [
        "[joint]",
        f'name = "{folder.name}"',
        f"gear_ratio = {case.gear_ratio}",
        f"motor_constant = {KM}   # Nm/A on the motor shaft",
        f'model = "{"hd1" if one_sided else "hd3"}"',
        f"effects = {effects}",
    ]
    (folder / "joint.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    truth = dict(case.truth)
    truth["options"] = {
        **dict(case.truth["options"]),
        "torque_sensor": torque_sensor,
        "one_sided": one_sided,
    }  # type: ignore[call-overload]
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return folder


def main(argv: list[str] | None = None) -> int:
    """Write a set of cases: every effect of the library, plus some with nothing hidden."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--none", type=int, default=6)
    parser.add_argument("--outside", type=int, default=0)
    parser.add_argument("--size", type=float, default=1.0)
    parser.add_argument("--dirt", action="store_true")
    options = parser.parse_args(argv)
    jobs: list[tuple[Hidden, int]] = [(e, s) for e in LIBRARY for s in range(options.seeds)]
    jobs += [(None, s) for s in range(options.none)]
    jobs += [(e, s) for e in OUTSIDE for s in range(options.outside)]
    for effect, seed in jobs:
        name = f"{'+'.join(names_of(effect)) or 'none'}_{seed}"
        generate_case(
            effect, seed, size=options.size, dirt=options.dirt, folder=options.folder / name
        )
    sys.stdout.write(f"{len(jobs)} cases in {options.folder}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
