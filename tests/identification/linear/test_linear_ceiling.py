"""The linear ceiling in compare: what linear models without physics explain, beside the
physical model.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from identification.data.joint_file import Joint
from identification.data.record import Provenance, Record
from identification.diagnosis.compare import compare
from identification.errors import InputError
from identification.fitting.fit import Fit, fit
from identification.linear import ceiling as module
from identification.linear.blackbox import linear_ceiling

NOISE = 0.02
SPRING = ("viscous", "added_spring")


def axis(
    seed: int,
    *,
    coulomb: float = 0.0,
    viscous: float = 1.5,
    seconds: float = 24.0,
    second: float = 0.3,
    runs: int = 1,
    name: str = "axis",
) -> Record:
    """An axis of inertia 2 seen from one side, moved by two sines."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, seconds, 0.002)
    w1, w2 = 2 * math.pi * 0.25, 2 * math.pi * 0.67
    q = 0.9 * np.sin(w1 * time) + second * np.sin(w2 * time + seed)
    v = 0.9 * w1 * np.cos(w1 * time) + second * w2 * np.cos(w2 * time + seed)
    a = -0.9 * w1**2 * np.sin(w1 * time) - second * w2**2 * np.sin(w2 * time + seed)
    torque = 2.0 * a + viscous * v + coulomb * np.sign(v) + NOISE * rng.standard_normal(len(time))
    channels = {
        "motor_torque": torque,
        "motor_position": q + 1e-6 * rng.standard_normal(len(time)),
        "run": np.floor(runs * np.arange(len(time)) / len(time)),
    }
    return Record.from_channels(time, channels, name=name)


def fitted(record: Record, *effects: str) -> Fit:
    return fit(Joint(name="axis", effects=effects), record)


def test_coulomb_friction_in_a_sinusoid_leaves_what_its_harmonics_hold() -> None:
    """The best linear predictor of a square wave from a sine is its fundamental: 1 - 8/pi^2 of
    its power is left.
    """
    record, other = axis(1, coulomb=2.0, second=0.0), axis(2, coulomb=2.0, second=0.0)
    found = compare(fitted(record, "viscous", "coulomb"), other).linear
    assert found is not None
    motion = 0.5 * (0.9 * (2 * math.pi * 0.25)) ** 2
    # fundamental of the square wave in phase with the velocity, inertia out of phase with it
    torque = (
        0.5 * (1.5 * math.sqrt(2 * motion) + 2.0 * 4 / math.pi) ** 2
        + (2.0 * 2 * math.pi * 0.25) ** 2 * motion
    )
    harmonics = 2.0**2 * (1 - 8 / math.pi**2)
    assert 100 - found.vaf_percent == pytest.approx(
        100 * harmonics / (torque + harmonics), rel=0.08
    )
    assert 100 - found.physical_vaf_percent < 0.2 * (100 - found.vaf_percent)
    assert "nonlinear laws earn their place" in found.meaning


def test_a_linear_joint_reaches_its_ceiling() -> None:
    found = compare(fitted(axis(1), "viscous"), axis(2)).linear
    assert found is not None
    assert found.vaf_percent > 99.99
    assert found.physical_vaf_percent == pytest.approx(found.vaf_percent, abs=1e-3)
    assert "as much as a linear one can" in found.meaning
    assert found.unseen


def test_a_missing_linear_effect_is_seen_as_such() -> None:
    found = compare(fitted(axis(1, viscous=6.0)), axis(2, viscous=6.0)).linear
    assert found is not None
    assert found.vaf_percent > found.physical_vaf_percent + 5
    assert "something linear is missing" in found.meaning


def test_it_is_in_text_json_and_page_and_can_be_left_out() -> None:
    record = axis(1, coulomb=1.0)
    first = fitted(record, "viscous")
    shown = compare(first, record)
    assert shown.linear is not None
    assert not shown.linear.unseen
    assert "linear ceiling: the best of 7 linear models" in str(shown)
    assert "records both were fitted to" in str(shown)
    data = json.loads(json.dumps(shown.as_json()))["linear_ceiling"]
    assert data["balances"]["axis"]["vaf_percent"] == pytest.approx(data["vaf_percent"])
    assert data["tried"] == 7
    assert "best linear model leaves" in shown._repr_html_()
    without = compare(first, record, linear=False)
    assert without.linear is None
    assert without.as_json()["linear_ceiling"] is None
    assert "linear" not in str(without)


def test_the_report_has_the_section_where_there_is_something_to_show() -> None:
    from workbench.show.fragments import linear_html
    from workbench.show.plots import ReportPlots

    record = axis(1, coulomb=1.0)
    found = compare(fitted(record, "viscous"), record).linear
    page = linear_html(ReportPlots((), (), (), False, found))
    assert "best linear model leaves" in page
    assert "training records" in page
    assert linear_html(ReportPlots((), (), (), False)) == ""


def test_the_same_file_read_again_is_not_unseen() -> None:
    record = axis(1)
    read_again = [
        Record.from_channels(
            record.time,
            dict(record.channels),
            name="axis",
            provenance=Provenance(("a.csv",), ("ab12",)),
        )
        for _ in range(2)
    ]
    first = fitted(read_again[0], "viscous")
    same, other = (
        compare(first, read_again[1]).linear,
        compare(first, read_again[1].window(0.0, 12.0)).linear,
    )
    assert same is not None
    assert other is not None
    assert not same.unseen
    assert other.unseen is True  # a part counts as another record: its rows may have been held out


def test_rows_are_capped_and_the_text_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    record = axis(1, coulomb=1.0, runs=3)
    first = fitted(record, "viscous")
    whole = compare(first, record).linear
    monkeypatch.setattr(module, "FIT_ROWS", 240)
    monkeypatch.setattr(module, "TEST_ROWS", 200)
    capped = compare(first, record).linear
    assert whole is not None
    assert capped is not None
    assert whole.rows == whole.all_rows
    assert capped.rows <= 210 < capped.all_rows
    assert capped.fit_rows <= 250
    assert f"{capped.rows} of {capped.all_rows} rows" in str(capped)
    assert capped.vaf_percent == pytest.approx(whole.vaf_percent, abs=3.0)


def test_many_short_stretches_stay_under_the_cap(monkeypatch: pytest.MonkeyPatch) -> None:
    record = axis(1, runs=4)
    first = fitted(record, "viscous")
    monkeypatch.setattr(module, "TEST_ROWS", 150)
    found = compare(first, record).linear
    assert found is not None
    assert found.rows <= 150


def test_records_too_short_for_a_black_box_have_no_ceiling() -> None:
    first = fitted(axis(1, runs=40), "viscous")  # stretches of 0.6 s, 33 rows each
    assert compare(first, axis(2)).linear is None


def test_stretches_never_span_two_runs() -> None:
    record = fitted(axis(1, runs=2), "viscous").data.train[0]
    parts = module.stretches(record)
    assert len(parts) == 2
    assert sum(p.stop - p.start for p in parts) == record.rows
    gaps = np.diff(record.time)
    assert all(np.ptp(gaps[p.start : p.stop - 1]) < 1e-9 for p in parts)
    assert gaps[parts[0].stop - 1] > 1.5 * np.median(gaps)


# --- the search behind it -------------------------------------------------------------------------


def test_a_static_system_is_explained_by_the_static_model() -> None:
    rng = np.random.default_rng(3)
    u, late = rng.standard_normal((400, 2)), rng.standard_normal((300, 2))
    found = linear_ceiling(
        u, u @ [2.0, -1.0], structures=("static",), orders=(1,), test=(late, late @ [2.0, -1.0])
    )
    assert found.best == "static"
    assert found.vaf_percent == pytest.approx([100.0])


def test_models_are_fitted_without_the_test_records() -> None:
    """On a test record of another system the static gain is the one of the training record."""
    rng = np.random.default_rng(4)
    u, late = rng.standard_normal(400), rng.standard_normal(300)
    found = linear_ceiling(u, 2.0 * u, structures=("static",), orders=(1,), test=(late, 3.0 * late))
    assert found.vaf_percent == pytest.approx([100 * (1 - 1 / 9)], abs=1e-6)


def test_the_best_on_the_test_records_is_named_first() -> None:
    rng = np.random.default_rng(5)
    u, late = rng.standard_normal(600), rng.standard_normal(500)

    def response(
        x: np.ndarray[tuple[int], np.dtype[np.float64]],
    ) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        y = np.zeros(len(x))
        for k in range(1, len(x)):
            y[k] = 0.9 * y[k - 1] + x[k - 1]
        return y

    found = linear_ceiling(
        u,
        response(u),
        structures=("static", "arx", "moesp"),
        orders=(1,),
        test=(late, response(late)),
    )
    assert found.best in ("arx 1", "moesp 1")
    assert found.vaf_percent == pytest.approx([100.0], abs=1e-6)
    assert dict(found.tried)["static"] < 30


def test_bad_test_records_are_refused() -> None:
    u = np.random.default_rng(6).standard_normal(300)
    with pytest.raises(InputError, match="u has 9 samples and y has 8"):
        linear_ceiling(u, u, test=(np.arange(9.0), np.arange(8.0)))


def test_masked_balances_of_a_record_with_another_payload_do_not_count() -> None:
    first = fitted(axis(1, coulomb=1.0), "viscous")
    tested = first.data.train
    residual = {"axis": np.zeros(tested[0].rows)}
    masked = tuple(replace(w, masked=frozenset({"axis"})) for w in tested)
    assert module.ceiling(first.data, tested, residual, {"axis": 0.1}, unseen=False) is not None
    assert module.ceiling(first.data, masked, residual, {"axis": 0.1}, unseen=False) is None
