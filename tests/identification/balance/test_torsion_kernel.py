"""Laws with memory of the torsion follow both positions through one kernel."""

from pathlib import Path

import numpy as np
import pytest

from casadi_models.joint import TWIST
from identification import improve, load_joint, read
from identification.balance.balances import balances_of
from identification.balance.calibration import is_of_run
from identification.balance.dataset import TWIST_NOISE
from identification.balance.weak import PAIR, kernel
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.fitting.assess import RATIO_LIMIT, assess
from identification.fitting.engine import load_dataset, posed, prepared_model, solve
from identification.fitting.weak_form import WeakForm
from tests.recorded_world.world import make_case, write_case
from tests.user_fmus.plant import GEAR, HIDDEN, NOISE, TRUTH, recorded

LAWS = ("viscous@motor", "coulomb@motor", "gravity")
JOINT = Joint(
    name="axis",
    gear_ratio=GEAR,
    model_name="hd1",
    effects=(TWIST, "structural_damping", *LAWS, "hysteresis"),
)


@pytest.fixture(scope="module")
def exact() -> Record:
    """Positions without the noise of encoders: each test adds its own."""
    return recorded("hysteresis", 8.0, 3, noise={"motor_position": 0.0, "link_position": 0.0})


def noisy(exact: Record, motor: float, link: float) -> Record:
    """The record with such noise of the two positions, both in radians of the link."""
    rng = np.random.default_rng(5)
    for channel, size in (("motor_position", motor * GEAR), ("link_position", link)):
        values = exact[channel] + size * rng.standard_normal(len(exact))
        exact = exact.with_channel(channel, values)
    return exact


@pytest.mark.parametrize(
    ("motor", "link"), [(1e-8, 2e-6), (1e-6, 1e-9), (1e-6, 2e-6)], ids=["link", "motor", "both"]
)
def test_a_loop_of_the_torsion_is_seen_whichever_encoder_is_the_finer(
    exact: Record, motor: float, link: float
) -> None:
    """Each position smoothed by what its own noise asks for: 3 to 36 times the floor."""
    record = noisy(exact, motor, link)
    model = prepared_model(JOINT, record)
    data = load_dataset([record], [], JOINT, model)
    found = solve(model, data, start={**TRUTH, **HIDDEN["hysteresis"][1]})
    error = assess(model, data, data.train, found.values)
    assert error.balances["transmission"].ratio < RATIO_LIMIT
    assert found.values["hysteresis_width"] == pytest.approx(1e-4, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [209004, 210001])
def test_a_loop_of_another_bend_is_followed_to_its_noise(seed: int, tmp_path: Path) -> None:
    """Elements as far apart as 1, 3 and 9 left 1.8 and 1.9 times the noise of these loops."""
    case = make_case(seed, names=("hysteresis",), size=1.0)
    folder = write_case(case, tmp_path, "all")
    joint = load_joint(folder / "joint.toml")
    train, test = (read(folder / f"{n}.csv", joint=joint) for n in ("train", "test"))
    found = improve([train], joint, [test])
    assert [c.effects for c in found.claims] == [("hysteresis",)]
    assert found.verdict == "complete"
    assert 1.5 < found.steps[-1].solution.values["hysteresis_spread"] < 3.0


def test_a_coarse_encoder_keeps_the_kernel_of_its_velocity(exact: Record) -> None:
    fine, coarse = (noisy(exact, size, 2 * size) for size in (1e-6, 2e-5))
    kernels = []
    for record in (fine, coarse):
        data = load_dataset([record], [], JOINT, prepared_model(JOINT, record))
        grid = data.train[0].grid
        kernels.append(grid.torsion)
        assert grid.torsion <= max(grid.pointwise[c] for c in ("motor_position", "link_position"))
        twist = record["motor_position"] / GEAR - record["link_position"]
        left = np.sqrt(5) * (1e-6 if record is fine else 2e-5)
        left *= np.linalg.norm(kernel(grid.torsion, record.dt, 0))
        assert left <= TWIST_NOISE * np.ptp(twist) or record is coarse
    assert kernels[0] < kernels[1]


def test_both_positions_stand_still_alike_where_the_joint_turns_as_one(exact: Record) -> None:
    """A rigid turn of both sides is no torsion, whatever the two velocities ask for."""
    record = noisy(exact, 1e-8, 2e-6).with_channel(
        "link_position", noisy(exact, 1e-8, 2e-6)["motor_position"] / GEAR
    )
    data = load_dataset([record], [], JOINT, prepared_model(JOINT, record))
    paired = data.train[0].paired
    assert np.abs(paired["motor_position"] - paired["link_position"]).max() < 1e-12


def damping_at_the_truth(record: Record) -> float:
    """Step of the damping from the true values, clocks held, the loop free beside it."""
    model = prepared_model(JOINT, record)
    data = load_dataset([record], [], JOINT, model)
    truth = {**TRUTH, **HIDDEN["hysteresis"][1]}
    weights = solve(model, data, start=truth).weights
    values, free, _, _ = posed(model, data, truth, frozenset())
    values |= dict.fromkeys((n for n in free if is_of_run(n)), 0.0)
    loop = [n for n in free if n == "structural_damping" or n.startswith("hysteresis")]
    balances = balances_of(model, data.sensing, wrt=loop)
    form = WeakForm(balances, data, values, tuple(loop), weights)
    x = np.array([values[n] for n in loop])
    found = np.linalg.lstsq(form.jacobian(x), -form.residual(x), rcond=None)[0]
    return float(found[loop.index("structural_damping")])


def test_the_noise_of_the_torsion_takes_no_speed_out_of_a_loop(exact: Record) -> None:
    """Noise turns a law with memory round, the more the slower the motion is: a loop that grows
    with speed took 2 N.m.s/rad off the damper beside it, of 25. A quarter of that may be left, as
    the smooth torsion to which noise is added has a quarter of the noise.
    """
    calm, off = damping_at_the_truth(noisy(exact, 1e-9, 2e-9)), []
    for seed in range(6):
        rng, record = np.random.default_rng(seed), exact
        for channel in PAIR:
            values = exact[channel] + NOISE[channel] * rng.standard_normal(len(exact))
            record = record.with_channel(channel, values)
        off.append(damping_at_the_truth(record) - calm)
    assert abs(np.mean(off)) < 0.5


def test_no_noise_is_guessed_where_a_position_is_read_in_steps(exact: Record) -> None:
    record = noisy(exact, 1e-6, 2e-6)
    step = 2e-5
    coarse = record.with_channel("link_position", step * np.rint(record["link_position"] / step))
    tracks = [
        len(load_dataset([r], [], JOINT, prepared_model(JOINT, r)).train[0].doubts)
        for r in (record, coarse)
    ]
    assert tracks == [3, 0]
