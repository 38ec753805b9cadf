"""A record that is being written while the estimator follows it."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from identification import load_joint, read
from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.faults.types import FaultEvent, Verdict
from workbench.cli.following import datagrams, growing
from workbench.cli.following.datagrams import Datagrams
from workbench.cli.following.growing import LOOKS, Growing, follow
from workbench.cli.main import main
from workbench.cli.online import limits, replay
from workbench.show.replayed import Replay, standing

DEMO = Path(str(files("workbench"))) / "demo"
SECONDS = 14.0
"""Of the demo's held-out record that are written."""
FAULT = (9.0, 10.5)
"""From when to when the link encoder is off [s]."""


@pytest.fixture(scope="module")
def joint_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's joint with what it lacks, fitted."""
    folder = tmp_path_factory.mktemp("joint")
    text = (DEMO / "joint.toml").read_text().replace('"gravity"]', '"gravity", "stribeck@motor"]')
    (folder / "start.toml").write_text(text)
    command = ["fit", str(DEMO / "train.npz"), "--joint", str(folder / "start.toml")]
    assert main([*command, "-o", str(folder / "fitted.toml")]) == 0
    return folder / "fitted.toml"


def lines(faulty: bool) -> list[str]:
    with np.load(DEMO / "held_out.npz") as archive:
        table = {k: archive[k].astype(float) for k in archive.files}
    keep = table["time_s"] - table["time_s"][0] < SECONDS
    table = {k: v[keep] for k, v in table.items()}
    off = (table["time_s"] >= FAULT[0]) & (table["time_s"] < FAULT[1]) & faulty
    table["link_position_rad"] = table["link_position_rad"] + 0.05 * off
    rows = np.column_stack(list(table.values()))
    return [",".join(table), *(",".join(f"{v:.12g}" for v in row) for row in rows.tolist())]


def written(path: Path, text: list[str], pieces: int = 8) -> threading.Thread:
    """A logger that writes in pieces that end within a line."""
    whole = ("\n".join(text) + "\n").encode()
    cuts = [len(whole) * k // pieces for k in range(pieces + 1)]

    def write() -> None:
        with path.open("ab", buffering=0) as stream:
            for a, b in zip(cuts[:-1], cuts[1:], strict=True):
                stream.write(whole[a:b])
                time.sleep(0.1)

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    return thread


def followed(path: Path, joint: Joint, text: list[str], pieces: int = 8) -> Iterator[Replay]:
    """A piece more, which ends within a line, after every look at the file."""
    healthy = [read(DEMO / "train.npz", joint=joint)]
    whole = ("\n".join(text) + "\n").encode()
    cuts = [len(whole) * k // pieces for k in range(pieces + 1)]
    left = [whole[a:b] for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
    path.write_bytes(left.pop(0))

    def stop() -> bool:
        if not left:
            return True
        with path.open("ab") as stream:
            stream.write(left.pop(0))
        return False

    with Growing(path, joint) as source:
        yield from follow(source, joint, lambda first: limits(joint, first, healthy), stop=stop)


def test_a_growing_file_gives_what_the_whole_record_gives(joint_file: Path, tmp_path: Path) -> None:
    joint = load_joint(joint_file)
    made = list(followed(tmp_path / "live.csv", joint, lines(faulty=True)))
    assert len(made) == 8, "it was followed while it grew"
    healthy = [read(DEMO / "train.npz", joint=joint)]
    record = read(tmp_path / "live.csv")
    whole = replay(record, joint, limits(joint, record, healthy))
    assert [(e["fault"], e["text"]) for e in made[-1].events] == [
        (e["fault"], e["text"]) for e in whole.events
    ]
    assert [e.verdict for _, e in made[-1].verdicts] == [e.verdict for _, e in whole.verdicts]
    np.testing.assert_allclose(
        [t for t, _ in made[-1].verdicts], [t for t, _ in whole.verdicts], atol=2 * record.dt
    )
    last, sigma = made[-1].values[-1], made[-1].sigmas[-1]
    assert (np.abs(last - whole.values[-1]) < 0.1 * sigma).all()
    assert len(made[-1].looks) <= 2 * LOOKS + 1

    said = standing(made[-1].verdicts)
    assert "link position, said at 9" in said
    assert "withdrawn at 1" in said
    then = next(m for m in made if any(e.is_sensor for _, e in m.verdicts))
    if all(e.verdict is not Verdict.RECOVERED for _, e in then.verdicts):
        assert standing(then.verdicts).startswith("Link position at 9")


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "mark, utf-16-be"]
)
def test_a_file_of_wide_characters_grows_as_any(
    encoding: str, joint_file: Path, tmp_path: Path
) -> None:
    """As a logger under Windows writes it; it is looked at within a line and within a letter."""
    joint, path = load_joint(joint_file), tmp_path / "live.csv"
    mark, _, encoding = encoding.rpartition(", ")
    text = "\n".join(lines(faulty=False)[:2001]) + "\n"
    whole = (("\ufeff" if mark else "") + text).encode(encoding)
    ends = sorted({*range(9_001, len(whole), 30_011), len(whole)})
    assert {end % 2 for end in ends[:-1]} == {0, 1}
    rows = []
    with Growing(path, joint) as source:
        for end in ends:
            path.write_bytes(whole[:end])
            if (part := source.new()) is not None:
                rows.append(part)
    assert len(rows) > 3
    record = read(path, joint=joint)
    np.testing.assert_array_equal(np.concatenate([r.time for r in rows]), record.time)
    for channel in record.channels:
        found = np.concatenate([r[channel] for r in rows])
        np.testing.assert_array_equal(found, record[channel], err_msg=channel)


def test_a_long_recording_is_thinned_and_no_peak_is_lost(
    joint_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    joint, text = load_joint(joint_file), lines(faulty=True)
    whole = list(followed(tmp_path / "a.csv", joint, text))[-1]
    monkeypatch.setattr(growing, "LOOKS", 40)
    thin = list(followed(tmp_path / "b.csv", joint, text))[-1]
    assert 40 < len(thin.looks) <= 81 < len(whole.looks)
    assert thin.record.time[0] == whole.record.time[0]
    assert (np.diff(thin.record.time) > 0).all()
    ended = whole.record.time <= thin.record.time[-1]
    np.testing.assert_allclose(thin.scores.max(axis=0), whole.scores[ended].max(axis=0))
    at = np.searchsorted(whole.time, thin.time)
    np.testing.assert_array_equal(whole.time[at], thin.time)
    np.testing.assert_array_equal(whole.values[at], thin.values)


def test_the_terminal_says_it_while_the_file_grows(
    joint_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "live.csv"
    path.touch()
    logger = written(path, lines(faulty=True))
    command = ["track", str(path), "--joint", str(joint_file), "--healthy", str(DEMO / "train.npz")]
    assert main([*command, "--follow", "1", "--fail-on-fault"]) == 1
    logger.join()
    out = capsys.readouterr().out
    assert "s: link position: A sensor failed; its reading is replaced by the estimate." in out
    assert "residual over floor" in out
    assert "withdrawn at" in out


def test_a_file_that_is_cut_empty_or_not_there_is_said(joint_file: Path, tmp_path: Path) -> None:
    joint, path = load_joint(joint_file), tmp_path / "live.csv"
    with Growing(path, joint) as source, pytest.raises(InputError, match="cannot be read"):
        source.new()
    path.write_text("time_s,motor_position_rad\n")
    with (
        Growing(path, joint) as source,
        pytest.raises(InputError, match="fewer than 100 lines came within 0.3 s"),
    ):
        list(follow(source, joint, quiet=0.3))
    path.write_text("\n".join(lines(faulty=False)[:400]) + "\n0.4,1")
    with Growing(path, joint) as source:
        first = source.new()
        assert first is not None
        assert len(first) == 399, "the part of a line at the end waits"
        assert source.new() is None
        path.write_text("time_s\n")
        with pytest.raises(InputError, match="shorter than it was"):
            source.new()


def test_what_stands_is_what_was_not_withdrawn() -> None:
    def event(verdict: Verdict, *sensors: str) -> FaultEvent:
        return FaultEvent(0, 0, verdict, sensors, ())

    armed = (1.0, event(Verdict.ARMED))
    link, torque = event(Verdict.SENSOR, "link_position"), event(Verdict.DROPOUT, "torque")
    assert standing([armed]) == "No reading was doubted."
    assert standing([armed], watched=False) == "Sensor faults were not looked for."
    assert standing([armed, (9.0, link)]) == (
        "Link position at 9 s: a sensor failed; its reading is replaced by the estimate."
    )
    both = [(9.0, link), (10.0, torque), (11.0, event(Verdict.RECOVERED, "link_position"))]
    assert standing(both) == (
        "Torque at 10 s: a reading is missing; it is replaced by the estimate. "
        "Withdrawn: link position, said at 9 s, withdrawn at 11 s."
    )
    assert standing([both[0], both[2]]).startswith("No reading is doubted any more: link position")


def test_a_stream_gives_what_the_file_gives(joint_file: Path, tmp_path: Path) -> None:
    """Begun before a head, the head said again now and then, two datagrams the wrong way round, one
    twice: what comes late is left out, its hole is bridged, and the rest says what the file says.
    """
    joint, text = load_joint(joint_file), lines(faulty=True)
    head, rows = text[0], text[1:]
    pieces = ["\n".join(rows[k : k + 10]) for k in range(0, len(rows), 10)]
    late = 30
    kept = [*pieces[:late], *pieces[late + 1 :]]
    sent = [rows[0], *(f"{head}\n{p}" if k % 10 == 0 else p for k, p in enumerate(pieces))]
    sent[late + 1 : late + 3] = [sent[late + 2], sent[late + 1], sent[late + 2]]
    healthy = [read(DEMO / "train.npz", joint=joint)]
    with (
        Datagrams("udp://127.0.0.1:0", joint) as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):

        def stop() -> bool:
            now, sent[:] = sent[:80], sent[80:]
            for piece in now:
                sender.sendto(piece.encode(), ("127.0.0.1", source.port))
            return not now

        stop()
        streamed = list(
            follow(source, joint, lambda first: limits(joint, first, healthy), stop=stop)
        )
        assert source.late == 2 * 10, "those that were overtaken, and those that came twice"
    (tmp_path / "whole.csv").write_text("\n".join([head, *kept, ""]))
    record = read(tmp_path / "whole.csv")
    whole = replay(record, joint, limits(joint, record, healthy))
    assert len(streamed) > 5, "it was followed while it came"
    said = [[(e["fault"], e["text"]) for e in r.events] for r in (streamed[-1], whole)]
    assert said[0] == said[1]
    assert [e.verdict for _, e in streamed[-1].verdicts] == [e.verdict for _, e in whole.verdicts]
    last, sigma = streamed[-1].values[-1], streamed[-1].sigmas[-1]
    assert (np.abs(last - whole.values[-1]) < 0.1 * sigma).all()


@pytest.mark.parametrize("bad", ["1,2,3", "ERROR: logger restarted", "5.0,x,0,0,0,0,0"])
@pytest.mark.parametrize("first", [True, False], ids=["first of its part", "within its part"])
def test_a_line_that_cannot_be_used_ends_it_and_what_came_is_told(
    bad: str,
    first: bool,
    joint_file: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The line has the number that it has in the file, and hours before it are not lost."""
    path, text, out = tmp_path / "live.csv", lines(faulty=False), tmp_path / "live.json"
    cut, at = 1500, 1500 if first else 1700
    parts = [text[:cut], [*text[cut:at], bad, *text[at:2000]]]
    path.write_text("\n".join(parts[0]) + "\n")

    def write() -> None:
        time.sleep(1.0)
        with path.open("a") as stream:
            stream.write("\n".join(parts[1]) + "\n")

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    command = ["track", str(path), "--joint", str(joint_file), "--follow", "5", "--json", str(out)]
    assert main(command) == 2
    thread.join()
    said = capsys.readouterr()
    assert said.err.startswith(f"irj: {path}, line {at + 1}")
    assert len(said.err.splitlines()) == 1
    assert "No reading was doubted" in said.out
    followed_to = json.loads(out.read_text())["records"][0]
    assert followed_to["record"] == "live"


def test_a_stream_that_cannot_be_is_said_in_one_line(
    joint_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = load_joint(joint_file)
    with Datagrams("udp://127.0.0.1:0", joint) as source:
        taken = f"udp://127.0.0.1:{source.port}"
        for address, says in (
            (taken, "cannot listen there (Address already in use)"),
            ("udp://127.0.0.1", "give the address as udp://HOST:PORT"),
            ("udp://127.0.0.1:99999", "give the address as udp://HOST:PORT"),
            ("udp://192.0.2.1:9870", "cannot listen there"),
        ):
            assert main(["track", address, "--joint", str(joint_file), "--follow", "0.3"]) == 2
            assert says in capsys.readouterr().err
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            junk = "time_s,motor_position_rad\n" + "\n".join(f"{k},x" for k in range(200))
            for piece in (b"\xff\x00junk", b"", junk.encode()):
                sender.sendto(piece, ("127.0.0.1", source.port))
            with pytest.raises(InputError) as caught:
                list(follow(source, joint, quiet=0.3))
        assert "udp://127.0.0.1:0" in str(caught.value)
        assert "\n" not in str(caught.value)


def test_nothing_of_a_stream_is_lost_while_nobody_looks(
    joint_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A detector learns for a second and more before the first look: ten times what the system
    keeps is sent meanwhile.
    """
    monkeypatch.setattr(datagrams, "AT_ONCE", 1 << 15)
    text = lines(faulty=False)
    head, rows = text[0], text[1:]
    with (
        Datagrams("udp://127.0.0.1:0", load_joint(joint_file)) as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        for k in range(0, len(rows), 40):
            piece = "\n".join([head, *rows[k : k + 40]])
            sender.sendto(piece.encode(), ("127.0.0.1", source.port))
            time.sleep(0.001)
        found = source.new()
    assert found is not None
    assert len(found) == len(rows)
    assert sum(map(len, rows)) > 400_000
