"""`irj track`: the replay with faults put in, its report, and what a hostile user gets."""

from __future__ import annotations

import dataclasses
import re
from argparse import Namespace
from functools import cache
from html.parser import HTMLParser
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from identification.data.joint_file import Joint, load_joint
from identification.data.read import read
from identification.data.record import Record
from identification.errors import InputError
from workbench.cli.online import (
    limits,
    parse_fault,
    replay,
    run_track,
)
from workbench.show.replayed import READINGS, UNESTIMATED, Replay
from workbench.show.track_pictures import signal_picture, timeline_picture
from workbench.show.track_report import track_page

DEMO = Path(str(files("workbench"))) / "demo"
FITTED = """
[joint]
name = "Gelenk <ä> & co"
kind = "rotary"
gear_ratio = -160.0
torque_per_current = -8.848
model = "hd3"
effects = ["transmission_compliance", "structural_damping", "viscous@motor", "viscous@link",
  "coulomb@motor", "coulomb@link", "gravity", "stribeck@motor"]
[fitted]
motor_inertia = { value = 4.4488, unit = "kg.m2", side = "link" }
link_inertia = { value = 10.2715, unit = "kg.m2", side = "link" }
stiffness = { value = 22001.4, unit = "N.m/rad", side = "link" }
structural_damping = { value = 59.7186, unit = "N.m.s/rad", side = "link" }
motor_viscous = { value = 10.99837, unit = "N.m.s/rad", side = "link" }
link_viscous = { value = 2.0081, unit = "N.m.s/rad", side = "link" }
motor_coulomb = { value = 21.5048, unit = "N.m", side = "link" }
link_coulomb = { value = 0.39611, unit = "N.m", side = "link" }
gravity_torque = { value = 105.18597, unit = "N.m", side = "link" }
motor_stribeck_extra = { value = 11.8542, unit = "N.m", side = "link" }
motor_stribeck_velocity = { value = 0.0706309, unit = "rad/s", side = "link" }
motor_stribeck_exponent = { value = 1.007415, unit = "1", side = "link" }
motor_smoothing_velocity = { value = 0.0052153, unit = "rad/s", side = "link" }
link_smoothing_velocity = { value = 0.0035809, unit = "rad/s", side = "link" }
"""
"""The demo's joint with the values that `irj improve` finds."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("Spur ü")
    (made / "gelenk ö.toml").write_text(FITTED, encoding="utf-8")
    return made


@pytest.fixture(scope="module")
def joint(folder: Path) -> Joint:
    return load_joint(folder / "gelenk ö.toml")


@cache
def record(name: str) -> Record:
    return read(DEMO / f"{name}.npz")


@pytest.fixture(scope="module")
def state(joint: Joint) -> bytes:
    found = limits(joint, record("held_out"), [record("train")])
    assert found is not None
    return found


FAULTS = ("link_position:stuck:8.2:0:9.2", "torque:dropout:10:0:11")


@pytest.fixture(scope="module")
def failed(joint: Joint, state: bytes) -> Replay:
    return replay(record("held_out"), joint, state, [parse_fault(f) for f in FAULTS])


@pytest.fixture(scope="module")
def page(failed: Replay, joint: Joint) -> str:
    return track_page(
        [failed], joint, command="irj track <it>", notes=["held_out: 1 <row> repaired"]
    )


class Tags(HTMLParser):
    """Every tag is closed; nothing points outside."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.links += [str(given[k]) for k in ("href", "src") if given.get(k)]
        self.ids += [str(given["id"])] if given.get("id") else []
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def namespace(folder: Path, **given: object) -> Namespace:
    base: dict[str, object] = {
        "joint": str(folder / "gelenk ö.toml"),
        "records": [str(DEMO / "held_out.npz")],
        "healthy": [],
        "json": None,
        "report": None,
        "inject": [],
        "fail_on_fault": False,
        "command": "irj track",
    }
    return Namespace(**{**base, **given})


# --- the replay -----------------------------------------------------------------------------------


def test_a_fault_that_was_put_in_is_reported_at_once_and_once(failed: Replay) -> None:
    assert [e["text"] for e in failed.events] == [
        "link position: sensor failed",
        "torque: reading missing",
    ]
    assert [
        round(1e3 * (e["time"] - t)) for e, t in zip(failed.events, (8.2, 10.0), strict=True)
    ] == [2, 0]


def test_replaced_spans_begin_with_the_fault_and_end_after_it(failed: Replay) -> None:
    position, torque = (
        failed.spans(READINGS.index("link position")),
        failed.spans(READINGS.index("torque")),
    )
    assert len(position) == len(torque) == 1
    assert 8.2 <= position[0][0] <= 8.21
    assert 9.2 < position[0][1] < 10.5, (
        "used again once it has agreed with the estimate for a while"
    )
    assert torque[0][0] == pytest.approx(10.0, abs=1e-9)
    assert all(
        failed.spans(READINGS.index(r)) == []
        for r in ("motor current", "motor position", "motor velocity", "link velocity")
    )


def test_the_reconstructed_reading_goes_on_where_the_reading_does_not(failed: Replay) -> None:
    rows = failed.failed[:, 3]
    assert np.ptp(failed.readings[rows & (failed.record.time < 9.19), 3]) == 0.0, (
        "the reading is stuck"
    )
    assert np.ptp(failed.used[rows, 3]) > 0.05
    assert np.abs(failed.used[rows, 3] - failed.healthy[rows, 3]).max() < 5e-4
    gone = ~np.isfinite(failed.readings[:, 5])
    assert gone.sum() == 400
    assert np.isfinite(failed.used).all()


def test_readings_that_are_not_replaced_pass_unchanged(failed: Replay) -> None:
    assert np.array_equal(failed.used[:3000], failed.readings[:3000])
    assert np.array_equal(failed.used[:, 1], failed.readings[:, 1])


def test_bands_and_values_are_finite_and_hold_the_joint_file(failed: Replay, joint: Joint) -> None:
    assert np.isfinite(failed.values).all()
    assert (failed.sigmas > 0).all()
    for name in ("stiffness", "motor_inertia", "link_inertia", "gravity_torque"):
        i = failed.estimator.names.index(name)
        assert failed.values[-1, i] == pytest.approx(joint.fitted[name], rel=0.03), name


def test_data_of_the_replay(failed: Replay) -> None:
    data = failed.as_json()
    assert [r["reading"] for r in data["replaced"]] == ["link position", "torque"]
    assert data["calibrated"]
    stiffness = data["parameters"]["stiffness"]
    assert len(data["time"]) == len(stiffness["history"]) == len(stiffness["sigma_history"])


def test_a_sensor_dead_from_the_start_is_reported_without_parameters(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first window never has every reading, so nothing can be estimated; the fault is still
    told.
    """
    assert (
        run_track(
            namespace(
                folder,
                inject=["link_position:stuck:2"],
                report=str(folder / "tot.html"),
                fail_on_fault=True,
            )
        )
        == 1
    )
    said = capsys.readouterr().out
    assert UNESTIMATED in said
    assert "link position: sensor failed" in said
    assert UNESTIMATED[1:] in (folder / "tot.html").read_text(encoding="utf-8")


# --- the report -----------------------------------------------------------------------------------


def test_page_is_one_sound_document_that_fetches_nothing(page: str) -> None:
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert all(link.startswith("#") and link[1:] in tags.ids for link in tags.links)
    assert len(set(tags.ids)) == len(tags.ids)
    assert "<script" not in page
    assert "default-src 'none'" in page
    assert not re.search(r"url\(|https?://(?!www\.w3\.org)|@import", page)


def test_page_escapes_what_comes_from_outside(page: str) -> None:
    assert "Gelenk &lt;ä&gt; &amp; co" in page
    assert "irj track &lt;it&gt;" in page
    assert "1 &lt;row&gt; repaired" in page
    assert "nan" not in re.sub(r"\b\w*nan\w+|\w+nan\b", "", page)


def test_page_shows_faults_readings_and_parameters(page: str) -> None:
    for words in (
        "Faults along time",
        "Reconstructed readings",
        "Parameters",
        "8.202 s: link position: sensor failed",
        "put into healthy readings on purpose",
    ):
        assert words in page
    assert page.count('class="s-after band"') == 15, (
        "a band for every parameter, the hold of the current and what the sensors are off by, too"
    )


def test_timeline_draws_the_failure_where_it_was(failed: Replay) -> None:
    drawn = timeline_picture(failed)
    bars = re.findall(
        r'<rect class="s-bad"[^>]* x="([\d.]+)" y="([\d.]+)" width="([\d.]+)"[^>]*><title>([^<]*)',
        drawn,
    )
    assert [b[3].split(":")[0] for b in bars] == ["link position", "torque"]
    put_in = re.findall(r'<rect class="s-ink"[^>]* x="([\d.]+)"', drawn)
    for bar, ink in zip(bars, put_in, strict=True):
        assert 0 <= float(bar[0]) - float(ink) < 1.0, (
            "the failure begins where the fault was put in"
        )
    assert len({b[1] for b in bars}) == 2, "each reading has a lane of its own"


def test_a_model_that_explained_little_before_puts_a_verdict_in_doubt(
    failed: Replay, joint: Joint
) -> None:
    assert failed.doubt == ""
    begun = failed.time < failed.events[0]["time"]
    ratios = np.where(begun[:, None], [[8.0, 1.0, 1.0]], failed.ratios)
    lacking = dataclasses.replace(failed, ratios=ratios)
    assert "motor at 8 times the noise" in lacking.doubt
    assert lacking.as_json()["doubt"][1:] in track_page([lacking], joint, command="")
    # what stands over the noise from the failure on is the failure
    assert dataclasses.replace(failed, ratios=np.where(begun[:, None], 1.0, 9.0)).doubt == ""
    assert dataclasses.replace(lacking, events=()).doubt == ""


def test_curves_of_a_reading_part_at_the_failure(failed: Replay) -> None:
    """The reading stays where it was stuck; the reconstruction goes on."""
    drawn = signal_picture(failed, 3, (8.0, 8.9), 860)
    curves = {}
    for kind in ("before", "after"):
        path = re.search(rf'<path class="s-{kind}" fill="none"[^>]* d="([^"]+)"', drawn)
        assert path is not None
        curves[kind] = np.array(
            [[float(v) for v in p.split()] for p in re.split("[ML]", path[1]) if p]
        )
    late = curves["before"][:, 0] > 500
    assert np.ptp(curves["before"][late, 1]) < 1.0
    assert np.ptp(curves["after"][curves["after"][:, 0] > 500, 1]) > 50


def test_missing_samples_interrupt_the_curve(failed: Replay) -> None:
    path = re.search(
        r'<path class="s-before" fill="none"[^>]* d="([^"]+)"',
        signal_picture(failed, 5, (9.5, 11.5), 860),
    )
    assert path is not None
    assert path[1].count("M") == 2


def test_healthy_record_says_so(joint: Joint, state: bytes) -> None:
    made = replay(record("held_out"), joint, state)
    shown = track_page([made], joint)
    assert "No sensor fault and no change of the joint" in shown
    assert "Reconstructed readings" not in shown


# --- wrong input ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("foo", "SENSOR:KIND:START"),
        ("link_position:stuck", "SENSOR:KIND:START"),
        ("link_position:bias:9", "needs a size"),
        ("link_position:bias:nine:1", "SENSOR:KIND:START"),
        ("link_position:bias:nan:1", "give finite numbers"),
        ("link_position:stuck:9:0:8", "start < end"),
        ("link_position:stuck:9:0:8:7", "SENSOR:KIND:START"),
        ("thumb:stuck:9", "unknown sensor 'thumb'"),
        ("torque:melt:9:1", "unknown kind 'melt'"),
    ],
)
def test_unusable_faults_are_one_line(text: str, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        parse_fault(text)
    assert "\n" not in str(caught.value)


def test_a_fault_outside_the_record_is_refused(joint: Joint) -> None:
    with pytest.raises(InputError, match=r"a fault at 99 s is asked for, the record is 12 s long"):
        replay(record("held_out"), joint, None, [parse_fault("torque:stuck:99")])


def test_pieces_too_short_say_how_long_they_are(joint: Joint) -> None:
    whole = record("held_out")
    gone = np.ones(len(whole), dtype=bool)
    gone[[1600, 3200]] = False
    with pytest.raises(
        InputError, match=r"3 pieces, the longest of 4 s, are too short for the first window of 7 s"
    ):
        replay(whole.take(gone, "a hole"), joint)


def test_short_record_is_refused(joint: Joint) -> None:
    with pytest.raises(
        InputError, match=r"4 s are too short for the first window of 7 s; give a longer record"
    ):
        replay(record("held_out").take(np.arange(4800) < 1600, "short"), joint)


def test_healthy_records_must_fit(joint: Joint, folder: Path) -> None:
    other = record("train")
    poor = dataclasses.replace(
        other, channels={k: v for k, v in other.channels.items() if k != "link_torque"}
    )
    with pytest.raises(InputError, match=r"no link_torque, which held_out has"):
        limits(joint, record("held_out"), [poor])
    with pytest.raises(InputError, match=r"sampled every 0\.005 s, held_out every 0\.0025 s"):
        limits(joint, record("held_out"), [other.resampled(5e-3)])
    (folder / "bare.toml").write_text(FITTED.partition("[fitted]")[0], encoding="utf-8")
    with pytest.raises(InputError, match=r"needs an elastic joint with fitted values"):
        limits(load_joint(folder / "bare.toml"), record("held_out"), [other])


def test_without_healthy_records_the_limits_are_called_guesses(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_track(namespace(folder, report=str(folder / "bericht ä.html"))) == 0
    assert "limits of the fault detector are guesses" in capsys.readouterr().out
    assert "guesses" in (folder / "bericht ä.html").read_text(encoding="utf-8")


def test_joint_without_values_is_followed_but_not_watched(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        run_track(namespace(folder, joint=str(DEMO / "joint.toml"), report=str(folder / "r.html")))
        == 0
    )
    assert "sensor faults were not looked for" in capsys.readouterr().out
    assert "sensor faults were not looked for" in (folder / "r.html").read_text(encoding="utf-8")
