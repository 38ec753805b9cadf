"""simulate: the joint in closed loop with its sensors, on request with an effect that nobody is
told.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS, JointModel
from casadi_models.simulate import sampled_step
from identification.data.check.stamps import MINIMUM_SAMPLES
from identification.data.joint_file import Joint
from identification.data.typical import true_values
from identification.errors import InputError
from irj_fmu.command_line import is_special
from workbench.cli.files import open_joint, progress_bar, write_bytes, write_json, write_text

MOST_SAMPLES: Final = 10_000_000
"""Of a simulated record: as CSV it takes about 1 GB."""
FloatArray = npt.NDArray[np.float64]


def run_simulate(arguments: Namespace) -> int:
    """`irj simulate`."""
    joint = open_joint(arguments.joint)
    if not 1 <= arguments.rate <= 1e5 or not 0.5 <= arguments.seconds <= 1e4:
        raise InputError("--rate takes 1 to 100000 samples per second and --seconds 0.5 to 10000")
    count = round(arguments.seconds * arguments.rate)
    if not MINIMUM_SAMPLES <= count <= MOST_SAMPLES:
        raise InputError(
            f"--rate and --seconds make {count} samples; give {MINIMUM_SAMPLES} to {MOST_SAMPLES}"
        )
    if arguments.seed < 0:
        raise InputError(f"--seed {arguments.seed}: give a whole number from 0 up")
    if Path(arguments.output).suffix not in (".csv", ".npz") and not is_special(
        Path(arguments.output)
    ):
        raise InputError(
            f"{arguments.output}: a record is written as .csv or .npz; give such a name with -o"
        )
    model = joint.model()
    for key in arguments.hide:
        try:
            more = model.add(key)
            if more is model:
                raise ValueError(
                    f"is a part of {EFFECTS[key].key}, which is in the model; set its parameters "
                    "with --set"
                )
            model = more
        except (KeyError, ValueError) as error:
            raise InputError(f"--hide {key}: {error.args[0]}") from None
    try:
        model = model.with_values({**true_values(model, joint), **_given(arguments.set, model)})
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"--set: {error.args[0]}") from None
    _check_hidden(model, arguments.hide)
    table = recording(
        model, joint, arguments.seconds, arguments.rate, arguments.seed, arguments.motion
    )
    write_table(Path(arguments.output), table)
    truth = {
        "hidden": arguments.hide,
        "parameters": dict(zip(model.parameter_names, model.value_vector(), strict=True)),
    }
    write_json(arguments.truth, truth)
    write_json(arguments.json, {"file": arguments.output, "samples": len(table["time_s"])})
    print(f"{arguments.output}: {len(table['time_s'])} samples, channels {', '.join(table)}")
    return 0


def _given(pairs: Sequence[str], model: JointModel) -> dict[str, float]:
    """Values of ``--set NAME=VALUE``, inside the bounds of the parameters."""
    out = {}
    known = {p.name: p for p in model.parameters}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            out[name.strip()] = float(value)
        except ValueError:
            raise InputError(
                f"--set {pair}: give NAME=VALUE with a number, as motor_coulomb=20"
            ) from None
        p = known.get(name.strip())
        if p is not None and not (np.isfinite(out[p.name]) and p.low <= out[p.name] <= p.high):
            raise InputError(
                f"--set {pair}: {p.name} lies between {p.low:g} and {p.high:g} {p.unit}; give "
                "such a value"
            )
    return out


def _check_hidden(model: JointModel, keys: Sequence[str]) -> None:
    """An effect whose amplitudes are all 0 would be hidden from everybody."""
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    for key in keys:
        bare = key.partition("#")[0].partition("@")[0]
        sizes = [
            p.name
            for t in model.terms
            if t.effect.key == bare
            for p in t.parameters
            if not p.is_shape
        ]
        if not any(values[n] for n in sizes):
            raise InputError(
                f"--hide {key}: no typical size is known, so it would do nothing; give one with "
                f"--set {sizes[0]}=VALUE"
            )


def reference(
    time: FloatArray, motion: str, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Position and velocity of the link to follow [rad, rad/s]; starts at rest."""
    if motion == "triangle":
        period, height = rng.uniform(5.5, 7.0), rng.uniform(1.0, 1.25)
        q = height * 2 / np.pi * np.arcsin(0.995 * np.sin(2 * np.pi * time / period))
    else:
        periods = np.array([9.0, 4.1, 2.3, 1.1, 0.55]) * rng.uniform(0.9, 1.1, 5)
        sizes = np.array([0.75, 0.3, 0.12, 0.035, 0.01])
        phases = rng.uniform(0, 2 * np.pi, 5)
        q = sum(
            a * np.sin(2 * np.pi * time / T + f)
            for a, T, f in zip(sizes, periods, phases, strict=True)
        )
        q = q - q[0]
    blend = np.clip(time / 1.0, 0, 1)
    q = q * blend**2 * (3 - 2 * blend)
    return q, np.gradient(q, time)


def recording(
    model: JointModel, joint: Joint, seconds: float, rate: float, seed: int, motion: str
) -> dict[str, FloatArray]:
    """Closed-loop record with the sensors of the thesis's table B.1, as columns of a record
    file.
    """
    rng = np.random.default_rng(seed)
    dt = 1.0 / rate
    time: FloatArray = np.arange(round(seconds * rate)).astype(np.float64) * dt
    q, v = reference(time, motion, rng)
    step = sampled_step(model, dt, max(2, round(dt / 2e-4)))
    outputs = model.functions.outputs
    values = np.array(model.value_vector())
    inertia = sum(float(model.values.get(n, 1.0)) for n in model.inertias)
    natural = 2 * np.pi * 3.0
    stiff, damp = inertia * natural**2, 2 * 0.8 * inertia * natural
    x = np.zeros(step.size1_in(0))
    warm = 20.0 * (1.0 - np.exp(-time / 60.0)) * any(t.effect.warms for t in model.terms)
    drive = np.zeros(len(time))
    rows = np.zeros((len(time), 5))
    for k in range(len(time)):
        drive[k] = stiff * (q[k] - x[0]) + damp * (v[k] - x[1])
        u = np.array([drive[k], warm[k], time[k]])
        rows[k] = np.array(outputs(x, u, values)).ravel()
        x = np.array(step(x, u, values)).ravel()
        if k % 2000 == 0:
            progress_bar("simulating", k / len(time))
    progress_bar("done", 1.0)
    if not np.all(np.isfinite(rows)):
        raise InputError(
            f"{joint.name}: the simulation diverges; check the values in the joint file"
        )
    return _read_off(
        model,
        joint,
        time=time,
        drive=_late_drive(model, time, drive),
        rows=rows,
        warm=warm,
        rng=rng,
    )


def _late_drive(model: JointModel, time: FloatArray, drive: FloatArray) -> FloatArray:
    """The drive as a late logger writes it; delays of the sensors are in the model's readings
    already.
    """
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    late = sum(values[n] for n in model.named("delay", "drive"))
    return np.interp(time - late, time, drive) if late else drive


def _read_off(
    model: JointModel,
    joint: Joint,
    time: FloatArray,
    drive: FloatArray,
    rows: FloatArray,
    warm: FloatArray,
    rng: np.random.Generator,
) -> dict[str, FloatArray]:
    """What the sensors of the thesis's table B.1 would have logged."""
    noise, count, ratio = rng.standard_normal, len(time), joint.gear_ratio
    length, torque, grain_link = (
        ("rad", "Nm", np.deg2rad(0.0036)) if model.kind == "rotary" else ("m", "N", 1e-6)
    )
    grain_motor = min(np.deg2rad(0.16) / abs(ratio), grain_link)
    table: dict[str, FloatArray] = {"time_s": time}
    if joint.torque_per_current is not None:
        table["motor_current_A"] = drive / joint.torque_per_current + noise(count) * 0.035 / abs(
            joint.torque_per_current
        )
    else:
        table[f"motor_torque_{torque}"] = drive / ratio + noise(count) * 0.035 / abs(ratio)
    table[f"motor_position_{length}"] = np.round(rows[:, 0] / grain_motor) * grain_motor * ratio
    table[f"motor_velocity_{length}_s"] = rows[:, 1] * ratio + noise(count) * 2e-3 * abs(ratio)
    if model.is_elastic:
        table[f"link_position_{length}"] = np.round(rows[:, 2] / grain_link) * grain_link
        table[f"link_velocity_{length}_s"] = rows[:, 3] + noise(count) * 2e-3
        table[f"link_torque_{torque}"] = rows[:, 4] + noise(count) * 0.05
    if warm.any():
        table["temperature_K"] = np.round((293.15 + warm + noise(count) * 0.1) / 0.0625) * 0.0625
    return table


def write_table(path: Path, table: dict[str, FloatArray]) -> None:
    """Write columns as a record file, .csv or .npz by the name."""
    if path.suffix == ".npz":
        _write_npz(path, table)
        return
    header = ",".join(table)
    body = np.column_stack(list(table.values()))
    lines = "\n".join(",".join(f"{v:.9g}" for v in row) for row in body)
    write_text(path, f"{header}\n{lines}\n")


def _write_npz(path: Path, table: dict[str, FloatArray]) -> None:
    import io

    small: dict[str, Any] = {
        k: v if k == "time_s" or "_position_" in k else v.astype(np.float32)
        for k, v in table.items()
    }
    content = io.BytesIO()
    np.savez_compressed(content, **small)
    write_bytes(path, content.getvalue())
