"""The app's server: what keeps it to one person, what it survives, and that a click gives the
numbers of the library.
"""

from __future__ import annotations

import gzip
import html
import http.client
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import unicodedata
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from identification.errors import InputError
from identification.scratch import part_of
from tests.workbench.served import Server, serving
from workbench.page.demo import demo_files
from workbench.page.desk import home
from workbench.page.records import decimated, guessed_role, thinned
from workbench.page.security import CSP
from workbench.page.server import _listen, with_files
from workbench.page.session import Session, State, Store, safe_name, stored_as, write_atomic
from workbench.page.uploads import check_unpacked

LIMIT = 8_000_000
JOINT = demo_files()["joint.toml"].decode()


def printed(folder: Path, code: str) -> str:
    """What the code that a page gives prints, run in a folder by a process of its own."""
    (folder / "session.py").write_text(code, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "session.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


class Client:
    """A plain HTTP client: it can also send what a browser would not."""

    def __init__(self, port: int) -> None:
        self.port = port

    def raw(
        self,
        method: str,
        path: str,
        body: bytes | Iterator[bytes] | None = None,
        headers: dict[str, str] | None = None,
    ) -> tuple[int, dict[str, str], bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.request(method, path, body, {"X-IRJ": "1", **(headers or {})})
            answer = connection.getresponse()
            return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def get(self, path: str) -> Any:
        status, _, body = self.raw("GET", path)
        assert status == 200, body
        return json.loads(body)

    def post(self, path: str, data: dict[str, Any] | None = None) -> tuple[int, Any]:
        status, headers, body = self.raw("POST", path, json.dumps(data or {}).encode())
        return status, json.loads(body) if "json" in headers.get(
            "content-type", ""
        ) else body.decode()

    def session(self) -> str:
        return f"/api/session/{self.post('/api/session')[1]['id']}"

    def upload(self, where: str, name: str, body: bytes) -> tuple[int, str]:
        status, _, answer = self.raw("PUT", f"{where}/files/{name}", body)
        return status, answer.decode()

    def wait(self, where: str, limit: float = 60, *, settled: bool = True) -> dict[str, Any]:
        end = time.monotonic() + limit
        while time.monotonic() < end:
            state: dict[str, Any] = self.get(where)
            if state["job"] is None and not (
                settled and state["steps"] and not state["steps"][-1]["settled"]
            ):
                return state
            time.sleep(0.02)
        pytest.fail("the job did not end")

    def run(self, where: str, action: str, *, settled: bool = True, **body: Any) -> dict[str, Any]:
        status, answer = self.post(f"{where}/run", {"action": action, **body})
        assert status == 202, answer
        return self.wait(where, settled=settled)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sessions")


@pytest.fixture(scope="module")
def client(root: Path) -> Iterator[Client]:
    with serving(root, max_upload=LIMIT) as there:
        yield Client(there.port)


@pytest.fixture(scope="module")
def fitted(client: Client) -> str:
    """A session with the demo, fitted and diagnosed."""
    where = client.session()
    assert client.post(f"{where}/demo")[0] == 200
    client.run(where, "fit")
    client.run(where, "diagnose")
    return where


# --- security -------------------------------------------------------------------------------------


def test_only_the_loopback_interface_is_bound() -> None:
    listening = _listen(0)
    try:
        assert listening.getsockname()[0] == "127.0.0.1"
        others = {
            i[4][0] for i in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
        } - {"127.0.0.1", "127.0.1.1"}
        for address in others:
            with (
                pytest.raises(OSError),
                socket.create_connection((str(address), listening.getsockname()[1]), timeout=1),
            ):
                pass
    finally:
        listening.close()


def test_a_taken_port_is_said() -> None:
    listening = _listen(0)
    try:
        with pytest.raises(InputError, match="is taken; give another with --port"):
            _listen(listening.getsockname()[1])
    finally:
        listening.close()


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "127.0.0.1.evil.example:8765", ""]
)
def test_another_host_name_is_refused(client: Client, host: str) -> None:
    """DNS rebinding: the browser would send the attacker's name."""
    assert client.raw("GET", "/", headers={"Host": host})[0] == 400
    assert client.raw("GET", "/", headers={"Host": f"localhost:{client.port}"})[0] == 200


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1:1"]
)
def test_another_origin_is_refused(client: Client, origin: str) -> None:
    for method, path in (("GET", "/api/config"), ("POST", "/api/session")):
        assert (
            client.raw(method, path, b"{}", {"Origin": origin.format(port=client.port)})[0] == 403
        )
    assert (
        client.raw("POST", "/api/session", b"{}", {"Origin": f"http://127.0.0.1:{client.port}"})[0]
        == 200
    )
    assert client.raw("GET", "/", headers={"Sec-Fetch-Site": "cross-site"})[0] == 403


def test_a_form_of_another_site_changes_nothing(client: Client) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", client.port, timeout=10)
    connection.request(
        "POST", "/api/session", b"", {"Content-Type": "application/x-www-form-urlencoded"}
    )
    assert connection.getresponse().status == 403
    connection.close()


@pytest.mark.parametrize("path", ["/", "/app.js", "/api/config", "/nothing", "/api/session/x"])
def test_every_answer_carries_the_policy(client: Client, path: str) -> None:
    headers = client.raw("GET", path)[1]
    assert headers["content-security-policy"] == CSP
    assert headers["x-content-type-options"] == "nosniff"
    scripts = next(p for p in CSP.split("; ") if p.startswith("script-src"))
    assert scripts == "script-src 'self'"
    assert "unsafe" not in CSP


def test_the_page_is_sent_packed_and_only_once(client: Client) -> None:
    status, headers, sent = client.raw("GET", "/app.js", headers={"Accept-Encoding": "gzip"})
    plain = client.raw("GET", "/app.js")[2]
    assert (status, headers["content-encoding"]) == (200, "gzip")
    assert gzip.decompress(sent) == plain
    assert 2 * len(sent) < len(plain)
    again = client.raw("GET", "/app.js", headers={"If-None-Match": headers["etag"]})
    assert (again[0], again[2]) == (304, b"")


def test_the_page_has_nothing_inline_and_no_network() -> None:
    web = Path(__file__).parents[3] / "workbench" / "web"
    page = (web / "index.html").read_text(encoding="utf-8")
    assert not re.search(r"<script(?![^>]*src=)|\sstyle=|\son\w+=|<style", page)
    for file in web.iterdir():
        text = file.read_text(encoding="utf-8")
        assert not re.search(r"""https?://(?!www\.w3\.org/2000/svg)""", text), file.name
        assert "innerHTML" not in text, file.name


@pytest.mark.parametrize(
    "path",
    [
        "/../app.py",
        "/..%2fapp.py",
        "/%2e%2e/app.py",
        "/web/app.js",
        "/assets/report.js",
        "/api/session/..%2f..%2fetc",
        "/api/session/../../etc/passwd",
        "{where}/files/..%2f..%2fstate.json",
        "{where}/view/..%2fstate.json",
        "{where}/view/state.json",
        "{where}/state.json",
    ],
)
def test_no_path_outside_is_readable(client: Client, fitted: str, path: str) -> None:
    status, _, body = client.raw("GET", path.format(where=fitted))
    assert status in (404, 405), body[:200]


def test_a_state_file_cannot_point_out_of_its_folder(tmp_path: Path) -> None:
    session = Store(tmp_path).create()
    (tmp_path / "secret.csv").write_text("time_s,motor_position_rad\n0,1\n")
    state = session.load().as_json()
    state["files"] = [{"id": "a", "name": "x.csv", "stored": "../../secret.csv"}]
    write_atomic(session.folder / "state.json", json.dumps(state).encode())
    with pytest.raises(InputError, match="leaves the session folder"):
        session.path_of(session.load().files[0])


def test_session_identifiers_cannot_be_guessed_or_listed(client: Client, root: Path) -> None:
    first, second = client.session(), client.session()
    assert first != second
    assert len(first.rsplit("/", 1)[1]) == 32
    assert client.raw("GET", "/api/session")[0] == 405
    assert client.raw("GET", "/api/home")[0] == 403
    wrong = {"X-IRJ-Home": "0" * 32}
    assert client.raw("GET", "/api/home", headers=wrong)[0] == 403
    assert client.raw("DELETE", f"/api/home/{first[-32:]}", headers=wrong)[0] == 403
    assert (root / "home.key").stat().st_mode & 0o077 == 0
    assert client.raw("GET", "/api/session/" + "0" * 32)[0] == 404
    assert all(folder.stat().st_mode & 0o077 == 0 for folder in root.glob("*/files"))


@pytest.mark.parametrize(
    ("given", "safe"),
    [
        ("../../etc/passwd", "passwd"),
        ("..\\x.csv", "x.csv"),
        (".hidden", "hidden"),
        ("", "record"),
        ("a\x00b.csv", "a_b.csv"),
        ("Prüfstand (2) – Lauf №1, 50 %.csv", "Prüfstand (2) – Lauf №1, 50 %.csv"),
        ("测试/关节 1号.csv", "关节 1号.csv"),
        ("u\u0308ber.csv", "über.csv"),
        ("نمونه\u200cها.csv", "نمونه\u200cها.csv"),
        ("axis\u202evsc.exe", "axis_vsc.exe"),
        ("a\u200bb.csv", "a_b.csv"),
        ("\udce9.csv", "_.csv"),
        ("what?.csv", "what_.csv"),
        ("C:run.csv", "C_run.csv"),
        ("aux.csv", "_aux.csv"),
        ("Com1", "_Com1"),
        ("console.csv", "console.csv"),
        ("\u3000 ... ", "record"),
        ("x.csv. ", "x.csv"),
    ],
)
def test_names_of_uploads_are_made_safe(given: str, safe: str) -> None:
    assert safe_name(given) == safe


@pytest.mark.parametrize("letter", ["a", "ü", "测", "🦾"])
@pytest.mark.parametrize("ending", [".csv", ".csv.gz", ".no-ending-is-as-long-as-this"])
def test_names_too_long_for_a_file_system_are_cut_between_letters(
    letter: str, ending: str, tmp_path: Path
) -> None:
    """The file system takes it with what is put before it, also while it comes."""
    made = safe_name(100 * letter + 200 * "b" + ending)
    assert made.startswith(10 * letter)
    assert made.endswith(ending) == (len(ending) < 20)
    assert set(made) <= {letter, *"b", *ending}
    (tmp_path / stored_as(made)).touch()
    part_of(tmp_path / stored_as(made)).touch()


def test_a_name_that_the_file_system_cannot_write_is_stored_under_another_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "fsencode", lambda name: name.encode("latin-1"))
    assert stored_as("über.csv").endswith("-über.csv")
    assert stored_as("关节.csv").endswith("-__.csv")


def test_names_in_any_script_stay_through_page_report_and_exports(
    client: Client, root: Path, tmp_path: Path
) -> None:
    """Also where the same letters come spelled in another way."""
    where = client.session()
    files = {n: c for n, c in demo_files().items() if n.endswith(".npz")}
    train, held = (next(c for n, c in files.items() if w in n) for w in ("train", "held"))
    joint = demo_files()["joint.toml"].decode().replace('name = "', 'name = "Gelenk Ä ', 1)
    names = ("Prüfstand 关节.npz", "held über #1 50%.npz")
    assert client.upload(where, quote("Gelenk ä.toml"), joint.encode())[0] == 200
    assert client.upload(where, quote(unicodedata.normalize("NFD", names[0])), train)[0] == 200
    assert client.upload(where, quote(names[1]), held)[0] == 200
    client.run(where, "fit")
    assert [f["name"] for f in client.get(where)["files"]] == list(names)
    stored = sorted(p.name.partition("-")[2] for p in (root / where[-32:] / "files").iterdir())
    assert stored == sorted(names)
    client.run(where, "report")
    headers, report = client.raw("GET", f"{where}/view/report.html")[1:]
    assert all(html.escape(n) in report.decode() for n in names)
    assert quote("Gelenk_Ä") in headers["content-disposition"]
    fitted = client.raw("GET", f"{where}/view/joint.toml")[2].decode()
    assert Path(names[0]).stem in fitted

    for name, content in zip(names, (train, held), strict=True):
        (tmp_path / name).write_bytes(content)
    printed(tmp_path, client.raw("GET", f"{where}/view/session.py")[2].decode())
    assert Path(names[0]).stem in (tmp_path / "fitted.toml").read_text(encoding="utf-8")


# --- uploads --------------------------------------------------------------------------------------


def test_an_oversized_upload_is_refused_before_it_is_read(client: Client) -> None:
    where = client.session()
    connection = http.client.HTTPConnection("127.0.0.1", client.port, timeout=10)
    connection.putrequest("PUT", f"{where}/files/big.csv")
    connection.putheader("X-IRJ", "1")
    connection.putheader("Content-Length", str(2 << 30))
    connection.endheaders()
    answer = connection.getresponse()
    assert answer.status == 413
    assert b"2,147 MB is over the limit of 8 MB" in answer.read()
    connection.close()


def test_a_stream_without_a_length_is_cut_at_the_limit(client: Client, root: Path) -> None:
    where = client.session()

    def endless() -> Iterator[bytes]:
        for _ in range(200):
            yield b"x" * 100_000

    try:
        status, _, body = client.raw("PUT", f"{where}/files/big.csv", endless())
        assert status == 413, body
    except (BrokenPipeError, ConnectionResetError):
        pass
    folder = root / where.rsplit("/", 1)[1] / "files"
    time.sleep(0.2)
    assert list(folder.iterdir()) == []


def _port_in(said: str) -> int:
    match = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/#home=[\w-]{32}", said.strip())
    assert match, said
    return int(match.group(1))


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").exists(), reason="memory is read from /proc")
def test_two_gigabytes_are_streamed_and_cut_at_the_limit(tmp_path: Path) -> None:
    """Sent without a length: the server cannot know before it has the limit; its memory stays
    flat, its disk is clean after.
    """
    code = (
        "from pathlib import Path\nfrom workbench.page.server import serve\nserve([], 0, "
        f"False, root=Path({str(tmp_path)!r}))"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    process = subprocess.Popen(
        [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        client = Client(_port_in(process.stdout.readline()))
        for _ in range(100):
            try:
                where = client.session()
                break
            except OSError:
                time.sleep(0.1)
        sent: list[int] = []

        def chunks() -> Iterator[bytes]:
            block = b"0.001,1.0,2.0\n" * 75_000
            while sum(sent) < 2 << 30:
                sent.append(len(block))
                yield block

        try:
            status, _, body = client.raw("PUT", f"{where}/files/big.csv", chunks())
            assert status == 413
            assert b"over the limit of 1,074 MB" in body
        except (BrokenPipeError, ConnectionResetError):
            pass
        assert (1 << 30) <= sum(sent) < 1.1 * (1 << 30)
        peak = int(
            next(
                line.split()[1]
                for line in Path(f"/proc/{process.pid}/status").read_text().splitlines()
                if line.startswith("VmHWM")
            )
        )
        assert peak < 300_000, f"{peak} kB"
        time.sleep(0.3)
        assert list((tmp_path / where.rsplit("/", 1)[1] / "files").iterdir()) == []
        assert client.get(where)["files"] == []
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_zip_bomb_is_not_unpacked(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    """256 MB of zeros in 0.3 MB, against a limit of 64 MB; the limit itself is 2 GB."""
    monkeypatch.setattr("workbench.page.uploads.MAX_UNPACKED", 64_000_000)
    out = io.BytesIO()
    with (
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("time_s.npy", "w", force_zip64=True) as member,
    ):
        for _ in range(16):
            member.write(bytes(1 << 24))
    where = client.session()
    status, message = client.upload(where, "bomb.npz", out.getvalue())
    assert status == 422
    assert "unpacks to more than 64 MB" in message
    assert client.get(where)["files"] == []


def test_a_mat_bomb_is_counted_not_kept(tmp_path: Path) -> None:
    import zlib

    squeezed = zlib.compress(bytes(1 << 26), 9)
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    file = tmp_path / "bomb.mat"
    file.write_bytes(
        header + (15).to_bytes(4, "little") + len(squeezed).to_bytes(4, "little") + squeezed
    )
    with pytest.raises(InputError, match="unpacks to more than"):
        check_unpacked(file, "bomb.mat", limit=1 << 25)
    check_unpacked(file, "bomb.mat", limit=1 << 27)


@pytest.mark.parametrize(
    ("name", "body", "says"),
    [
        (
            "text.mat",
            b"time_s,motor_position_rad\n0,1\n1,2\n",
            "is not a MAT file, whatever its name says",
        ),
        ("empty.csv", b"", "is empty"),
        ("broken.npz", b"PK\x03\x04 and nothing", "is not a readable NPZ archive"),
        ("noise.csv", bytes(range(256)) * 20, "noise"),
        ("one.csv", b"time_s,motor_position_rad\n0,1\n", "one"),
    ],
)
def test_a_file_that_cannot_be_used_gets_one_sentence(
    client: Client, root: Path, name: str, body: bytes, says: str
) -> None:
    where = client.session()
    status, message = client.upload(where, name, body)
    if status == 200:  # it can be read, and the check gate refuses it
        message = client.get(where)["files"][0]["message"]
    else:  # nothing of it is kept
        assert status == 422
        assert client.get(where)["files"] == []
        assert list((root / where.rpartition("/")[2] / "files").iterdir()) == []
    assert says in message
    assert "\n" not in message
    assert str(Path.home()) not in message
    assert "/tmp" not in message


def test_a_joint_file_that_is_wrong_is_refused_and_leaves_the_old_one(client: Client) -> None:
    where = client.session()
    assert client.upload(where, "joint.toml", JOINT.encode())[0] == 200
    status, text = client.upload(where, "joint.toml", b"[joint]\ngear_ratio = 0\n")
    assert status == 422
    assert "gear_ratio is 0" in text
    assert client.upload(where, "joint.toml", b"\xff\xfe\x00")[0] == 422
    assert client.get(where)["joint_text"] == JOINT


def test_a_guess_of_columns_is_shown_and_not_applied(client: Client) -> None:
    where = client.session()
    t = np.arange(400) * 0.01
    table = np.column_stack([t, np.sin(t), np.cos(t)])
    out = io.StringIO()
    np.savetxt(out, table, delimiter=",", header="t_s,q_rad,iq_A", comments="")
    client.upload(where, "bench.csv", out.getvalue().encode())
    entry = client.get(where)["files"][0]
    assert entry["status"] == "columns"
    assert {g["column"]: g["channel"] for g in entry["guess"]} == {
        "t_s": "time",
        "q_rad": "motor_position",
        "iq_A": "motor_current",
    }
    columns = {g["channel"]: {"column": g["column"], "unit": g["unit"]} for g in entry["guess"]}
    columns["motor_position"]["sign"] = -1
    assert client.post(f"{where}/file/{entry['id']}", {"columns": columns})[1]["status"] == "ready"
    series = client.get(
        f"{where}/view/series?file={entry['id']}&channels=motor_position&points=1000"
    )
    np.testing.assert_allclose(series["series"][0]["values"], -np.sin(t), atol=1e-6)


# --- the loop -------------------------------------------------------------------------------------


def test_a_click_gives_the_numbers_of_the_library(
    client: Client, fitted: str, tmp_path: Path
) -> None:
    from identification import fit, load_joint, read

    for name, content in demo_files().items():
        (tmp_path / name).write_bytes(content)
    train, held, joint = (
        [read(tmp_path / "train.npz")],
        [read(tmp_path / "held_out.npz")],
        load_joint(tmp_path / "joint.toml"),
    )
    start = fit(joint, train, held_out=held)
    better = fit(start.model.add("stribeck@motor"), train, joint=joint, held_out=held)
    state = client.get(fitted)
    assert state["diagnosis"]["claim"]["effects"] == ["stribeck"]
    state = client.run(fitted, "add", label="stribeck@motor")
    errors = [s["held_out"]["relative_error_percent"] for s in state["steps"]]
    assert start.held_out is not None
    assert better.held_out is not None
    assert errors == pytest.approx(
        [start.held_out.relative_error_percent, better.held_out.relative_error_percent], rel=2e-3
    )
    assert errors[1] < 0.5 * errors[0]
    undone = client.run(fitted, "undo")
    assert [s["label"] for s in undone["steps"]] == [None]
    redone = client.run(fitted, "redo")
    assert redone["steps"] == state["steps"]
    removed = client.run(fitted, "remove", label="stribeck@motor")
    assert removed["steps"][-1]["held_out"]["relative_error_percent"] == pytest.approx(
        errors[0], rel=5e-3
    )
    client.run(fitted, "undo")


def test_copied_code_gives_the_same_errors(client: Client, fitted: str, tmp_path: Path) -> None:
    state = client.get(fitted)
    for name, content in demo_files().items():
        (tmp_path / name).write_bytes(content)
    told = printed(tmp_path, client.get(f"{fitted}/view/code")["code"])
    said = [float(line.split()[-1]) for line in told.splitlines()]
    assert said == pytest.approx(
        [s["held_out"]["relative_error_percent"] for s in state["steps"]], rel=2e-3
    )
    assert (tmp_path / "fitted.toml").exists()


def test_the_worst_window_and_the_places_come_with_the_comparison(
    client: Client, fitted: str
) -> None:
    found = client.get(f"{fitted}/view/compare")
    shares = [max(p["share_percent"], 0.0) for p in found["places"]]
    assert shares == sorted(shares, reverse=True)
    low, high = found["worst"]["low"], found["worst"]["high"]
    assert 1.5 < high - low < 2.5
    whole = client.get(f"{fitted}/view/balance?balance=motor&points=60")
    close = client.get(f"{fitted}/view/balance?balance=motor&points=600&from={low}&to={high}")
    assert not whole["full"]
    assert close["full"]
    series = {s["name"]: np.array(s["values"], dtype=np.float64) for s in close["series"]}
    measured, model, residual = (series[k] for k in ("measured", "model", "residual"))
    upper = series["noise, upper"]
    np.testing.assert_array_equal(series["noise, lower"], -upper)
    np.testing.assert_allclose(measured - model, residual, atol=1e-3)


@pytest.mark.parametrize(
    "query",
    [
        "balance=none",
        "balance=motor&points=x",
        "balance=motor&from=2&to=1",
        "balance=motor&from=nan&to=1",
    ],
)
def test_a_wrong_question_gets_a_sentence(client: Client, fitted: str, query: str) -> None:
    status, _, body = client.raw("GET", f"{fitted}/view/balance?{query}")
    assert status == 422, body
    assert b"\n" not in body


def test_what_cannot_be_done_is_said(client: Client) -> None:
    where = client.session()
    state = client.run(where, "fit")
    assert "no record to fit" in state["error"] or "no joint yet" in state["error"]
    assert client.post(f"{where}/run", {"action": "nonsense"})[0] == 422
    assert client.post(f"{where}/run", {"action": "add"})[0] == 422
    assert client.raw("POST", f"{where}/run", b"[1]")[0] == 422
    assert client.raw("POST", f"{where}/run", b"{")[0] == 422
    assert client.raw("POST", f"{where}/joint", b"x" * (2 << 20))[0] == 413


# --- robustness -----------------------------------------------------------------------------------


def test_fifty_quick_clicks_do_the_work_once(client: Client) -> None:
    where = client.session()
    client.post(f"{where}/demo")
    client.wait(where)
    answers: list[int] = []

    def click() -> None:
        answers.append(client.post(f"{where}/run", {"action": "fit"})[0])

    threads = [threading.Thread(target=click) for _ in range(50)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    state = client.wait(where)
    assert set(answers) <= {202, 409}
    assert 202 in answers
    assert len(state["steps"]) == 1
    assert state["error"] is None


@pytest.mark.slow
def test_two_sessions_do_not_disturb_each_other(client: Client) -> None:
    first, second = client.session(), client.session()
    for where in (first, second):
        client.post(f"{where}/demo")
    for where in (first, second):
        assert client.post(f"{where}/run", {"action": "fit"})[0] == 202
    states = [client.wait(where) for where in (first, second)]
    assert states[0]["steps"][0]["held_out"] == states[1]["steps"][0]["held_out"]
    client.run(first, "add", label="cubic_viscous@motor")
    assert len(client.get(first)["steps"]) == 2
    assert len(client.get(second)["steps"]) == 1


def test_a_job_can_be_cancelled_and_changes_nothing(client: Client, fitted: str) -> None:
    before = client.get(fitted)
    # the longest there is: on a busy machine a diagnosis ended before it was cancelled
    assert client.post(f"{fitted}/run", {"action": "improve"})[0] == 202
    status, text = client.post(f"{fitted}/run", {"action": "fit"})
    assert status == 409
    assert "wait for it or cancel it" in text
    assert client.raw("DELETE", f"{fitted}/file/{before['files'][0]['id']}")[0] == 409
    time.sleep(0.1)
    client.post(f"{fitted}/cancel")
    after = client.wait(fitted)
    assert "cancelled" in after["error"]
    assert after["steps"] == before["steps"]
    again = client.run(fitted, "diagnose")
    assert again["error"] is None
    assert again["diagnosis"]["ranking"]


def test_progress_comes_as_events_and_a_closed_tab_stops_nothing(client: Client) -> None:
    where = client.session()
    client.post(f"{where}/demo")
    connection = http.client.HTTPConnection("127.0.0.1", client.port, timeout=30)
    connection.request("GET", f"{where}/events")
    stream = connection.getresponse()
    assert stream.getheader("content-type", "").startswith("text/event-stream")

    def event() -> dict[str, Any]:
        while not (line := stream.readline()).startswith(b"data: "):
            pass
        found: dict[str, Any] = json.loads(line[6:])
        return found

    first = event()
    assert first["job"] is None
    client.post(f"{where}/run", {"action": "fit"})
    assert event()["job"]["action"] == "fit"
    connection.close()
    assert len(client.wait(where)["steps"]) == 1


def test_a_changed_record_begins_a_branch_and_the_fit_is_kept(client: Client) -> None:
    where = client.session()
    client.post(f"{where}/demo")
    first = state = client.run(where, "fit")
    held = next(f for f in state["files"] if f["role"] == "held_out")
    client.post(f"{where}/file/{held['id']}", {"role": "train"})
    state = client.get(where)
    assert state["steps"] == []
    state = client.run(where, "fit")
    assert "held out" in state["note"]
    assert client.raw("DELETE", f"{where}/file/{held['id']}")[0] == 200
    assert len(client.get(where)["files"]) == 1
    branches = client.get(f"{where}/view/tree")["branches"]
    assert [len(b["steps"]) for b in branches] == [0, 1, 1]
    assert branches[0]["change"] == "held_out.npz taken out"
    assert branches[1]["change"] == "held_out.npz: held out → fit"
    back = client.run(where, "undo")
    assert len(back["files"]) == 2
    assert len(back["steps"]) == 1
    assert client.run(where, "redo")["steps"] == []
    client.run(where, "undo")
    client.post(f"{where}/file/{held['id']}", {"role": "held_out"})
    again = client.get(where)
    assert again["steps"] == first["steps"]
    assert len(client.get(f"{where}/view/compare")["records"]) == 1


@pytest.mark.slow
def test_a_restart_finds_everything(tmp_path: Path) -> None:
    with serving(tmp_path) as there:
        client = Client(there.port)
        where = client.session()
        client.post(f"{where}/demo")
        client.run(where, "fit")
        client.run(where, "diagnose")
        before = client.run(where, "add", label="stribeck@motor")
        value = client.get(f"{where}/view/parameters")["motor_stribeck_extra"]["value"]
    with serving(tmp_path) as there:
        client = Client(there.port)
        after = client.get(where)
        assert after["steps"] == before["steps"]
        found = client.get(f"{where}/view/parameters")["motor_stribeck_extra"]["value"]
        assert found == pytest.approx(value, rel=1e-3)
        assert len(client.run(where, "undo")["steps"]) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="kill -9")
def test_a_killed_server_loses_nothing(tmp_path: Path) -> None:
    code = (
        "from pathlib import Path\nfrom workbench.page.server import serve\nserve([], 0, "
        f"False, root=Path({str(tmp_path)!r}))"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}

    def started() -> tuple[subprocess.Popen[str], Client]:
        process = subprocess.Popen(
            [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        return process, Client(_port_in(process.stdout.readline()))

    def ready(client: Client) -> None:
        for _ in range(100):
            try:
                client.get("/api/config")
                return
            except OSError:
                time.sleep(0.1)

    process, client = started()
    try:
        ready(client)
        where = client.session()
        client.post(f"{where}/demo")
        before = client.run(where, "fit")
        client.post(f"{where}/run", {"action": "diagnose"})
        time.sleep(0.3)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert process.stdout is not None
        process.stdout.close()
    process, client = started()
    try:
        ready(client)
        after = client.get(where)
        assert after["job"]["action"] == "diagnose"  # taken up again
        assert after["steps"] == before["steps"]
        assert client.wait(where)["diagnosis"]["claim"]["effects"] == ["stribeck"]
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def test_files_of_the_command_line_are_in_the_session(tmp_path: Path) -> None:
    for name, content in demo_files().items():
        (tmp_path / name).write_bytes(content)
    identifier = with_files(tmp_path / "sessions", [tmp_path / name for name in demo_files()])
    state = Session(tmp_path / "sessions" / identifier).load()
    found = [(f.name, f.role, f.status) for f in state.files]
    assert found == [("train.npz", "train", "ready"), ("held_out.npz", "held_out", "ready")]
    assert state.joint_text == JOINT
    with pytest.raises(InputError, match="there is no such file"):
        with_files(tmp_path / "sessions", ["missing.csv"])
    (tmp_path / "empty.csv").touch()
    with pytest.raises(InputError, match=r"empty.csv: is empty \(0 bytes\)"):
        with_files(tmp_path / "sessions", [tmp_path / "train.npz", tmp_path / "empty.csv"])
    left = [p.name for p in (tmp_path / "sessions").iterdir()]
    assert left == [identifier], "what could not be opened leaves no session"


# --- parts ----------------------------------------------------------------------------------------


def test_a_crash_in_the_middle_of_writing_keeps_the_old_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Store(tmp_path).create()
    old = session.save(State(joint_text="old"))

    def crash(descriptor: int) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", crash)
    with pytest.raises(OSError, match="disk full"):
        session.save(State(joint_text="new"))
    assert session.load() == old
    assert [p.name for p in session.folder.iterdir() if p.is_file()] == ["state.json"]


def test_a_state_of_a_newer_version_is_read(tmp_path: Path) -> None:
    session = Store(tmp_path).create()
    data = session.load().as_json() | {
        "new_key": 1,
        "files": [{"id": "a", "name": "b", "stored": "c", "new": 2}],
    }
    write_atomic(session.folder / "state.json", json.dumps(data).encode())
    assert session.load().files[0].name == "b"
    write_atomic(session.folder / "state.json", b"{")
    with pytest.raises(InputError, match="cannot be read"):
        session.load()


def test_decimation_loses_no_spike_and_zooms_to_every_sample() -> None:
    rng = np.random.default_rng(1)
    time_ = np.arange(100_000) * 1e-3
    values = rng.normal(size=100_000)
    values[54_321], values[777] = 40.0, -50.0
    stamps, (drawn,), full = decimated(time_, [values], 500)
    assert not full
    assert len(stamps) == len(drawn) == 1000
    assert drawn.max() == 40.0
    assert drawn.min() == -50.0
    assert (np.diff(stamps) > 0).all()
    assert abs(stamps[int(np.argmax(drawn))] - 54.321) < 0.4
    stamps, (drawn,), full = decimated(time_, [values], 500, (54.2995, 54.3505))
    assert full
    assert stamps[0] == time_[54_299]
    assert stamps[-1] == time_[54_351]
    np.testing.assert_array_equal(drawn, values[54_299 : 54_299 + len(drawn)])


def test_decimation_keeps_the_order_of_a_slope() -> None:
    time_ = np.arange(10_000) * 1e-3
    for slope in (1.0, -1.0):
        drawn = decimated(time_, [slope * time_], 100)[1][0]
        assert (np.diff(slope * drawn) > 0).all()


def test_thinning_spreads_windows_over_the_record() -> None:
    from identification.data.record import Record

    t = np.arange(500_000) * 1e-3
    record = Record.from_channels(t, {"motor_position": np.sin(t)})
    thin = thinned(record, 60.0)
    assert thin.duration == pytest.approx(60.0, rel=0.02)
    assert len(thin.segments()) == 10
    assert thin.time[0] < 50 < 450 < thin.time[-1]
    assert thinned(thin, 60.0) is thin


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("test.csv", "held_out"),
        ("Validation2.mat", "held_out"),
        ("train.csv", "train"),
        ("run7.npz", "train"),
    ],
)
def test_roles_are_guessed_from_names(name: str, role: str) -> None:
    assert guessed_role(name)[0] == role


def test_the_demo_is_that_of_the_command_line() -> None:
    folder = Path(__file__).parents[3] / "workbench" / "demo"
    assert {
        name: (folder / name).read_bytes() for name in ("joint.toml", "train.npz", "held_out.npz")
    } == demo_files()


def test_an_upload_is_answered_with_state_and_first_plot(client: Client) -> None:
    """So that the page draws a long record without another question."""
    where = client.session()
    content = demo_files()["train.npz"]
    status, answer = client.upload(where, "a.npz?points=300", content)
    made = json.loads(answer)
    assert status == 200
    assert made["state"]["files"][0]["id"] == made["id"]
    assert "stored" not in made["state"]["files"][0]
    assert made["plot"] == client.get(
        f"{where}/view/series?file={made['id']}&points=300&channels="
        f"{made['plot']['series'][0]['name']}"
    )
    assert made["state"]["revision"] == client.get(where)["revision"]
    assert json.loads(client.upload(where, "b.npz", content)[1])["plot"] is None
    unknown = json.loads(client.upload(where, "c.csv?points=300", b"a,b\n1,2\n3,4\n5,6\n")[1])
    assert unknown["plot"] is None
    assert unknown["state"]["files"][-1]["status"] == "columns"


def test_a_session_that_another_server_has_open_is_refused_until_that_one_ends(
    tmp_path: Path,
) -> None:
    """Each would write its own state over the other's: a fit made on one was lost with the next on
    the other.
    """
    first, second = Server(tmp_path), Server(tmp_path)
    try:
        there, here = Client(first.port), Client(second.port)
        where = there.session()
        assert there.post(f"{where}/demo")[0] == 200
        refused = "another irj app has this session open; go on there, or stop that one first"
        assert here.post(f"{where}/demo") == (409, refused)
        key = {"X-IRJ-Home": home.key_of(Store(tmp_path))}
        listed = where.replace("session", "home")
        status, _, said = here.raw("DELETE", listed, headers=key)
        assert (status, said.decode()) == (409, refused)
        first.kill()
        assert len(here.get(where)["files"]) == 2
        assert here.raw("DELETE", listed, headers=key)[0] == 200
    finally:
        first.kill()
        second.kill()


def test_a_full_disk_lets_the_page_open_and_says_what_cannot_be(tmp_path: Path) -> None:
    """Who cannot see the sessions cannot delete one to make room."""
    server = Server(tmp_path)
    try:
        client = Client(server.port)
        where = client.session()
        before = {p.name for p in tmp_path.iterdir()}
        with server.full_disk():
            status, said = client.post("/api/session")
            assert status == 507
            assert "state.json: File too large; check the path" in said
            status, _, said = client.raw("PUT", f"{where}/files/a.csv", b"time_s,motor_current_A")
            assert status == 507
            assert b"a.csv: File too large; check the path" in said
            assert {p.name for p in tmp_path.iterdir()} == before
            key = {"X-IRJ-Home": home.key_of(Store(tmp_path))}
            assert client.raw("GET", "/api/home", headers=key)[0] == 200
        assert client.get(where)["files"] == []
    finally:
        server.kill()


def test_each_of_two_servers_offers_what_it_was_started_with(tmp_path: Path) -> None:
    """They serve the same sessions; neither takes or gets what the other one may follow."""
    mine, theirs, root = tmp_path / "mine.csv", tmp_path / "theirs.csv", tmp_path / "sessions"
    stream = "udp://127.0.0.1:9870"
    with (
        serving(root, follow=[mine, stream]) as first,
        serving(root, follow=[theirs]) as second,
        serving(root) as third,
    ):
        clients = [Client(s.port) for s in (first, second, third)]
        given = [[str(mine), stream], [str(theirs)], []]
        sessions = [client.session() for client in clients]
        for client, where, own in zip(clients, sessions, given, strict=True):
            assert client.get(f"{where}/view/replay")["sources"] == own
            for other in {str(mine), str(theirs), stream, "/etc/passwd"} - set(own):
                status, said = client.post(f"{where}/run", {"action": "follow", "source": other})
                assert (status, "was not named when the page was started" in said) == (422, True)
        status, said = clients[1].post(
            f"{sessions[1]}/run", {"action": "follow", "source": str(theirs)}
        )
        assert status == 202, said
        assert clients[1].wait(sessions[1])["error"].startswith("follow: fit first")
    assert not list(root.glob("*.json")), "what a server may follow is not kept in the folder"


def test_what_was_followed_goes_on_only_where_the_next_server_may(tmp_path: Path) -> None:
    """A server that was killed while it followed: its session is opened by one without the file."""
    from workbench.page import verbs
    from workbench.page.live import Live

    path = str(tmp_path / "live.csv")
    session = Store(tmp_path / "sessions").create()
    session.begin({"action": "follow", "source": path})
    live = Live(session)
    verbs.resume(live)
    assert live.job is None
    assert "was not named when the page was started" in str(live.snapshot()["error"])
    live.close()


def test_a_quota_that_is_no_number_is_one_sentence(
    client: Client, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IRJ_QUOTA_GB", "viel")
    key = {"X-IRJ-Home": home.key_of(Store(root))}
    status, _, said = client.raw("GET", "/api/home", headers=key)
    assert (status, said) == (422, b"IRJ_QUOTA_GB is 'viel'; give a number of gigabytes")


def test_no_connection_outlives_its_server(tmp_path: Path) -> None:
    """Nor one that came while it stopped: a browser asked on such a one and waited for ever."""
    for _ in range(6):
        held: list[socket.socket] = []

        def connect(port: int, held: list[socket.socket] = held) -> None:
            while True:
                caller = socket.socket()
                try:
                    caller.connect(("127.0.0.1", port))
                except OSError:
                    caller.close()
                    return
                held.append(caller)
                time.sleep(5e-4)

        with serving(tmp_path) as there:
            callers = [threading.Thread(target=connect, args=(there.port,)) for _ in range(2)]
            for thread in callers:
                thread.start()
            time.sleep(0.2)
        for thread in callers:
            thread.join(30)
        assert len(held) > 20
        assert all(_ended(caller) for caller in held)


def _ended(caller: socket.socket) -> bool:
    """The other side has closed the connection."""
    with caller:
        caller.settimeout(1)
        try:
            return caller.recv(1) == b""
        except TimeoutError:
            return False
        except OSError:
            return True
