"""Claims that a table over one variable would do as well as, lines in one place only,
amplitudes that may leave their bound.
"""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import numpy.typing as npt
import pytest

from identification import Improvement, improve, load_joint, read
from identification.diagnosis.order_tracking import BLOCK, Peak, Samples, clipped, peaks
from tests.hidden_effect.generator import generate_case

SCHEMA = Path(__file__).parents[2] / "data" / "improve.schema.json"
FloatArray = npt.NDArray[np.float64]


def improved(folder: Path) -> Improvement:
    train, held = ([read(folder / f"{n}{i}.csv") for i in ("", "2")] for n in ("train", "test"))
    return improve(train, load_joint(folder / "joint.toml"), held)


@pytest.mark.slow
def test_laws_of_the_position_that_imitate_a_soft_stop_give_way_to_its_curve(
    tmp_path: Path,
) -> None:
    found = improved(generate_case("soft_stop", 6003, folder=tmp_path / "case"))
    assert found.verdict == "unexplained"
    assert all(c.partial for c in found.claims)
    assert "Missing:" not in found.reason
    # they were taken up, and the curve showed that they are not the law
    gone = [r for r in found.refused if "held against a curve" in r.why]
    assert gone
    assert all("explains" in r.why for r in gone)
    left = next(u for u in found.unexplained if u.balance == "link")
    assert left.axis == "link_position"
    # what no name explains is a curve over that variable, and a claim of its own in the data; the
    # stop is steeper than the knots, of which a further curve takes a rest
    learned = found.learned[0]
    assert (learned.balance, learned.curve.label) == ("link", "learned_position@link")
    assert all(other.curve.gain.fall < 0.3 * learned.curve.gain.fall for other in found.learned[1:])
    data = json.loads(json.dumps(found.as_json()))
    jsonschema.validate(data, json.loads(SCHEMA.read_text()))
    curves = [c["effects"] for c in data["claims"] if "curve" in c]
    assert curves == [["learned"]] * len(found.learned)


@pytest.mark.slow
def test_a_spring_that_does_most_of_a_soft_stop_is_like_it_and_in_part(tmp_path: Path) -> None:
    """Where the stop takes most of the travel; the curve beside it takes the rest."""
    found = improved(generate_case("soft_stop", 6005, folder=tmp_path / "case"))
    assert found.verdict == "unexplained"
    (claim,) = found.claims
    assert (claim.effects, claim.partial) == (("added_spring",), True)
    assert claim.like.startswith("like additional spring to ground, which explains 9")
    assert found.curved is not None
    errors = [s.held_out.relative_error_percent for s in found.stairs]
    assert errors[1] < 0.3 * errors[0]
    assert errors[2] < 0.4 * errors[1]


def test_a_law_of_the_position_that_is_really_there_is_whole(tmp_path: Path) -> None:
    found = improved(generate_case("cyclic_torque", 6, folder=tmp_path / "case"))
    assert any("cyclic_torque" in c.effects for c in found.claims)
    assert not any(c.partial for c in found.claims)


def test_a_delay_of_a_sample_is_a_skew_of_the_clock_and_no_claim(tmp_path: Path) -> None:
    found = improved(
        generate_case("channel_delay", 7000, size=0.5, dirt=True, folder=tmp_path / "case")
    )
    assert found.claims == ()
    assert found.verdict == "nothing_missing"
    late = [c for c in found.calibration if c.sensor == "link_torque"]
    assert [c.what for c in late] == ["skew", "skew"]
    for skew in late:
        assert skew.value == pytest.approx(0.00265, rel=0.1)
    assert "structural_damping" not in found.steps[-1].solution.at_bound


def test_a_line_goes_on_over_the_stroke_and_a_burst_does_not() -> None:
    """A line over the whole stroke or the most of it is found with its order; a burst of three
    times its size in one place is cut and is no line anywhere.
    """
    rng = np.random.default_rng(2)
    time = np.arange(20_000) * 0.002
    angle = 30 * np.pi * (1 - np.cos(2 * np.pi * time / 40))
    noise = 0.5 * rng.standard_normal(len(angle))

    def found(residual: FloatArray) -> list[Peak]:
        speed = np.abs(np.gradient(angle, time))
        samples = Samples(angle, residual, speed, (time / BLOCK).astype(np.int64))
        return peaks(clipped(samples), 20.0, lowest=0.25)

    for share in (1.0, 0.6):
        here = angle < share * 60 * np.pi
        line, *lobes = found(np.sin(3.37 * angle + 0.4) * here + noise)
        assert line.order == pytest.approx(3.37, abs=0.01), share
        # what the end of a line leaves beside it lies nearer than two orders that can be told apart
        assert all(abs(p.order - line.order) < 2 * line.apart for p in lobes)
        assert not lobes or share < 1.0
    assert not found(np.where(np.abs(angle - 40) < 4, 3 * np.sin(3.37 * angle), 0.0) + noise)
