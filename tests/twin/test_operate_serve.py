"""The page of an instrument in operation: who may read, who may acknowledge, what is answered, and the page itself."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

pytest.importorskip("uvicorn", reason="the extra `live` is not installed")
pytest.importorskip("websockets", reason="the extra `live` is not installed")

from tests.twin.commands import invoke
from tests.twin.live_page import CHROMIUM, FLAGS, Page
from tests.twin.operate_bench import COUNT, DAY, EVIL, HOUR, StandIn, filled, lived, monitor_entry
from tests.twin.record_bench import START, given, made
from twin.operate import past_view
from twin.operate.__main__ import app
from twin.operate.desk import Desk, plain, unix_micros
from twin.operate.estimate.operation import Operation
from twin.operate.estimate.plans import kept_plan
from twin.operate.overview import Overview
from twin.operate.record.entries import Alarm, Given, digest_of_data, micros
from twin.operate.record.history import History
from twin.operate.record.place import RecordFailed
from twin.operate.serve import OperateServer
from twin.serving.guard import Guard
from twin.serving.server import listen

READ, WRITE = "a-secret-of-enough-letters", "another-secret-of-enough-letters"
NEWEST = START + 3 * HOUR * (COUNT - 1)


@contextmanager
def serving(desk: Desk, write: str = WRITE, look: float = 0.05):
    """A server on a free port of its own: the port."""
    listening = listen("127.0.0.1", 0)
    port = listening.getsockname()[1]
    server = OperateServer(desk, Guard.of(READ, "127.0.0.1", port, write), look)
    thread = threading.Thread(target=server.run, args=(listening,), daemon=True)
    thread.start()
    end = time.monotonic() + 10
    while not server.started and time.monotonic() < end:
        time.sleep(0.02)
    try:
        yield port
    finally:
        server.stop()
        thread.join(10)
        assert not thread.is_alive()


def ask(
    port: int,
    path: str = "/",
    token: str | None = READ,
    write: str | None = None,
    method: str = "GET",
    body: Any = None,
    **headers: str,
) -> tuple[int, dict[str, str], bytes]:
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    own = {"Host": f"127.0.0.1:{port}", **headers}
    cookies = {"": token, "_write": write}
    told = "; ".join(f"space_camera_twin_{port}{name}={value}" for name, value in cookies.items() if value is not None)
    if told:
        own["Cookie"] = told
    line.request(method, path, body, headers={name: value for name, value in own.items() if value})
    answer = line.getresponse()
    out = answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    line.close()
    return out


def post(port: int, told: Any, write: str | None = WRITE, **headers: str) -> tuple[int, bytes]:
    own = {"Content-Type": "application/json", "Origin": f"http://127.0.0.1:{port}", **headers}
    body = told if isinstance(told, bytes) else json.dumps(told).encode()
    status, _, content = ask(port, "/acknowledge", write=write, method="POST", body=body, **own)
    return status, content


def data(port: int, path: str) -> Any:
    status, headers, body = ask(port, path)
    assert status == 200, body
    assert headers["content-type"] == "application/json"
    return json.loads(body)


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory):
    with filled(tmp_path_factory.mktemp("record") / "record") as history:
        yield history


@pytest.fixture(scope="module")
def port(record):
    with serving(Desk(record, lambda: StandIn(record))) as port:
        yield port


@pytest.fixture
def fresh(tmp_path: Path):
    """A record of its own with a desk."""
    with filled(tmp_path / "record", 20) as history:
        yield history, Desk(history, Estimates(history))


class Estimates:
    """Makes estimates, and counts them."""

    def __init__(self, history: History) -> None:
        self.history, self.made = history, 0

    def __call__(self) -> StandIn:
        self.made += 1
        return StandIn(self.history)


# --- who may read -----------------------------------------------------------------------------------------------------
ASKED = ("trend?from=0&to=1", "reading?time=0", "frame?number=1", "motions?time=0")
WAYS = ["/", "/state", "/news", "/scene.glb", *(f"/{one}" for one in ASKED)]


@pytest.mark.parametrize("path", [*WAYS, "/operate.js", "/?token=wrong", f"/?write={WRITE}", "/nothing"])
def test_without_the_token_nothing_is_told(port, path):
    for token in (None, "", "wrong", READ[:-1], WRITE):
        status, headers, body = ask(port, path, token, write=WRITE)
        assert status == 403
        assert "set-cookie" not in headers
        assert READ.encode() not in body


def test_tokens_become_cookies_and_leave_the_address(port):
    status, headers, _ = ask(port, f"/?token={READ}&write=wrong", None)
    assert (status, headers["location"]) == (303, "/")
    assert WRITE not in headers["set-cookie"]
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    line.request("GET", f"/?token={READ}&write={WRITE}", headers={"Host": f"127.0.0.1:{port}"})
    answer = line.getresponse()
    cookies = answer.headers.get_all("set-cookie")
    line.close()
    assert len(cookies) == 2
    assert all("HttpOnly" in one and "SameSite=Strict" in one for one in cookies)


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example"])
def test_another_host_is_refused(port, host):
    for path in WAYS:
        assert ask(port, path, Host=host)[0] == 403
    assert post(port, {"alarm": 1, "by": "A"}, Host=host)[0] == 403


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1", "http://127.0.0.1:1"])
def test_another_origin_is_refused(port, origin):
    assert ask(port, "/state", Origin=origin)[0] == 403
    assert post(port, {"alarm": 1, "by": "A"}, Origin=origin)[0] == 403
    assert ask(port, "/state", **{"Sec-Fetch-Site": "cross-site"})[0] == 403


@pytest.mark.parametrize("path", ["/../../etc/passwd", "/%2e%2e/desk.py", "/page/operate.js", "/desk.py", "/live.js"])
def test_no_path_leads_to_a_file(port, path):
    status, _, body = ask(port, path)
    assert status == 404
    assert b"import" not in body


# --- who may acknowledge ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH"])
def test_all_else_only_shows(port, method):
    for path in ("/", "/state", "/scene.glb", "/nothing"):
        assert ask(port, path, write=WRITE, method=method, Origin=f"http://127.0.0.1:{port}")[0] == 405
    assert ask(port, "/acknowledge", write=WRITE)[0] == 404


def test_without_the_second_token_nothing_is_written(fresh):
    history, desk = fresh
    with serving(desk) as port:
        for write in (None, "", "wrong", READ, WRITE[:-1]):
            assert post(port, {"alarm": 1, "by": "A"}, write)[0] == 403
        assert post(port, {"alarm": 1, "by": "A"}, None, Authorization=f"Bearer {READ}")[0] == 403
        # what a form of another page could send, and a request that does not say whose page it is of
        assert post(port, {"alarm": 1, "by": "A"}, **{"Content-Type": "text/plain"})[0] == 403
        assert post(port, {"alarm": 1, "by": "A"}, Origin="")[0] == 403
        assert data(port, "/news")["may_write"] is False
        assert history.alarms()[0]["acknowledged"] is None


def test_a_server_without_a_second_token_takes_no_empty_one(fresh):
    history, desk = fresh
    with serving(desk, write="") as port:
        for write in (None, "", READ):
            assert post(port, {"alarm": 1, "by": "A"}, write)[0] == 403
        assert post(port, {"alarm": 1, "by": "A"}, None, Authorization="Bearer ")[0] == 403
        assert data(port, "/news")["writable"] is False
    assert history.alarms()[0]["acknowledged"] is None


@pytest.mark.parametrize("way", ["cookie", "header"])
def test_an_alarm_is_acknowledged_once(fresh, way):
    history, desk = fresh
    told = {"alarm": 1, "by": f" A. Nurse{' ' * 4000}", "note": "looked at the images"}
    told["by"] = told["by"][: 4096 - len(json.dumps(told | {"by": ""}))]  # a post has 4096 bytes at most
    bearer = {"Authorization": f"Bearer {WRITE}", "Origin": ""} if way == "header" else {}
    with serving(desk) as port:
        before = data(port, "/news")["version"]
        status, body = post(port, told, WRITE if way == "cookie" else None, **bearer)
        assert status == 200
        assert json.loads(body)["version"] > before
        status, body = post(port, told)
        assert status == 409
        assert b"A. Nurse" in body
        own = next(one for one in data(port, "/state")["alarms"] if one["id"] == 1)
    assert own["acknowledged"]["by"] == "A. Nurse"
    assert history.alarms()[0]["acknowledged"]["note"] == "looked at the images"


@pytest.mark.parametrize(
    ("told", "status"),
    [
        (b"no json", 400),
        (b"[" * 2000, 400),
        (b"[1]", 400),
        ({}, 400),
        ({"alarm": "1", "by": "A"}, 400),
        ({"alarm": True, "by": "A"}, 400),
        ({"alarm": 1, "by": "  "}, 400),
        ({"alarm": 1, "by": "A" * 81}, 400),
        ({"alarm": 1, "by": "A\n"}, 400),
        ({"alarm": 1, "by": "A", "note": "x" * 501}, 400),
        ({"alarm": 1, "by": "A", "note": ["x"]}, 400),
        (b" " * 4097, 400),
        ({"alarm": 99, "by": 80 * "A", "note": 500 * "x"}, 409),
        ({"alarm": 10**30, "by": "A"}, 409),
    ],
)
def test_what_is_no_acknowledgement_is_refused(port, record, told, status):
    assert post(port, told)[0] == status
    assert record.alarms()[0]["acknowledged"] is None


def test_who_posts_and_does_not_go_on_is_sent_away(port, monkeypatch):
    """A body of which a part comes and then nothing: an answer, and not a task that waits for ever."""
    monkeypatch.setattr("twin.operate.serve.SLOWEST_POST", 0.3)
    head = f"POST /acknowledge HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\n"
    head += f"Cookie: space_camera_twin_{port}={READ}; space_camera_twin_{port}_write={WRITE}\r\n"
    head += "Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{"
    with socket.create_connection(("127.0.0.1", port), timeout=20.0) as line:
        line.sendall(head.encode())
        assert line.recv(4096).startswith(b"HTTP/1.1 400")


# --- what is answered -------------------------------------------------------------------------------------------------
def test_the_state_is_that_of_the_estimate(port):
    told = data(port, "/state")
    assert told["readings"] == COUNT
    assert told["utc"] == "2026-01-20T21:00:00Z"
    assert not told["holds"]
    first = told["quantities"][0]
    assert (first["name"], first["unit"]) == ("Δα of forward", "arcsec")
    assert first["value"] == pytest.approx(0.05 * (19.875 + 0.4))
    assert (first["sigma"], first["required"]["limit"]) == (pytest.approx(0.05), 0.4)
    assert told["quantities"][8]["required"]["breaks"].startswith("2026-01-29")
    assert [one["id"] for one in told["alarms"]] == [1, 2]
    assert told["alarms"][0]["text"].endswith(EVIL)
    assert told["jumps"][0]["part"]["size"] == 1.234
    assert told["sensors"][1]["state"] == "stuck"
    assert told["coverage"][0]["share"] == pytest.approx(800 / (8 * COUNT))
    assert told["tai_minus_unix_us"] == NEWEST - unix_micros(NEWEST)
    assert unix_micros(micros("2026-01-01T00:00:00Z")) == 1_767_225_600_000_000


def test_a_trend_is_cut_where_record_and_forecast_end(port):
    told = data(port, f"/trend?from={START - 99 * DAY}&to={START + 999 * DAY}")
    assert told["from_us"] == START
    assert told["to_us"] == NEWEST + 30 * DAY
    past, future = told["past"], told["future"]
    assert (past["times"][0], past["times"][-1], future["times"][0]) == (START, NEWEST, NEWEST)
    assert len(past["values"]) == len(told["points"]["values"]) == 12
    assert len(past["values"][0]) == len(past["times"])
    assert set(told["points"]["sigmas"][0]) == {0.3}
    assert told["points"]["values"][11][0] is None  # of the ground a single reading says nothing
    late = data(port, f"/trend?from={NEWEST + DAY}&to={NEWEST + 2 * DAY}")
    assert late["past"]["times"][-1] == NEWEST


@pytest.mark.parametrize("words", ["", "from=1", "from=x&to=2", "from=2&to=1", "from=1&to=1e9", f"from=1&to={10**19}"])
def test_a_span_that_is_none_is_refused(port, words):
    assert ask(port, f"/trend?{words}")[0] == 400


def test_a_reading_has_its_spots_and_its_neighbours(port):
    told = data(port, f"/reading?time={START + 3 * HOUR * 10 + HOUR}")
    assert told["time_us"] == START + 30 * HOUR
    assert (told["before_us"], told["after_us"]) == (START + 27 * HOUR, START + 33 * HOUR)
    assert len(told["spots"]) == 4
    spot = next(one for one in told["spots"] if (one["camera"], one["channel"]) == ("forward", "left"))
    assert spot["after"]["column"] - spot["before"]["column"] == pytest.approx(0.04)
    assert told["frames"] == []
    assert data(port, "/reading?time=0")["before_us"] is None
    assert data(port, f"/reading?time={NEWEST + 99 * DAY}")["after_us"] is None


def test_motions_are_the_mean_of_the_estimate(port):
    told = data(port, f"/motions?time={NEWEST}")
    ratios = [abs(one["mean"]) / one["sigma"] for one in told["largest"]]
    assert (ratios, len(ratios)) == (sorted(ratios, reverse=True), 12)
    assert told["largest"][0]["mean"] / told["largest"][0]["sigma"] == pytest.approx(1.9875 / np.sqrt(0.3))
    moved = told["moved"]["base/forward"]
    assert moved["sure"]
    assert np.linalg.norm(moved["rotate"]) > 0.0
    early = data(port, f"/motions?time={START}")
    assert early["moved"] == {}
    assert ask(port, "/scene.glb")[2][:4] == b"glTF"


def test_frames_are_shown_only_while_they_are_what_the_reading_was_found_from(tmp_path, fresh):
    history, desk = fresh
    import hashlib

    frame = np.zeros((3, 40, 50), np.uint16)
    frame[:, 20, 30] = 4000
    paths = [tmp_path / f"forward_left_{when}.tiff" for when in ("before", "after")]
    paths.append(tmp_path / "not_an_image.tiff")
    for path in paths[:2]:
        tifffile.imwrite(path, frame, photometric="minisblack")
    paths[2].write_bytes(b"text")
    digests = {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    entry = monitor_entry(50)
    history.take(Given(str(tmp_path / "recovered.json"), digest_of_data("one"), "", [entry], digests))
    with serving(desk) as port:
        told = data(port, f"/reading?time={entry.time}")["frames"]
        assert [one["state"] for one in told] == ["there"] * 3
        status, headers, png = ask(port, f"/frame?number={told[0]['number']}")
        assert (status, headers["content-type"]) == (200, "image/png")
        assert png[:4] == b"\x89PNG"
        assert ask(port, f"/frame?number={told[2]['number']}")[0] == 404
        paths[0].write_bytes(b"another")
        paths[1].unlink()
        told = data(port, f"/reading?time={entry.time}")["frames"]
        assert [one["state"] for one in told[:2]] == ["changed", "gone"]
        for one in told[:2]:
            assert ask(port, f"/frame?number={one['number']}")[0] == 404
    for number in ("0", "-1", "99999", "x", ""):
        with serving(desk) as port:
            assert ask(port, f"/frame?number={number}")[0] in (400, 404)


def test_new_readings_are_followed_and_nothing_else_is_worked_out_twice(fresh):
    history, desk = fresh
    with serving(desk) as port:
        first = data(port, "/news")["version"]
        time.sleep(0.3)
        assert data(port, "/news")["version"] == first
        assert desk._estimate.made == 1
        history.take(given("more.csv", [monitor_entry(k) for k in range(20, 25)]))
        end = time.monotonic() + 5
        while data(port, "/news")["version"] == first and time.monotonic() < end:
            time.sleep(0.02)
        assert data(port, "/state")["readings"] == 25
        history.raise_alarm(Alarm("jump", "x", START, "one more"))
        end = time.monotonic() + 5
        while len(data(port, "/state")["alarms"]) == 2 and time.monotonic() < end:
            time.sleep(0.02)
        assert len(data(port, "/state")["alarms"]) == 3


def test_a_record_that_cannot_be_read_is_told_and_read_again(fresh, monkeypatch):
    _, desk = fresh
    with serving(desk) as port:
        with monkeypatch.context() as patched:

            def gone() -> None:
                raise RecordFailed("disk I/O error")

            patched.setattr(desk, "look", gone)
            end = time.monotonic() + 5
            while not data(port, "/news")["trouble"] and time.monotonic() < end:
                time.sleep(0.02)
            assert data(port, "/news")["trouble"] == "disk I/O error"
        end = time.monotonic() + 5
        while data(port, "/news")["trouble"] and time.monotonic() < end:
            time.sleep(0.02)
        assert data(port, "/news")["trouble"] == ""


def test_what_is_no_number_is_null_in_json():
    value = {"a": np.array([1.0, np.nan]), "b": (np.int64(3), float("inf")), "c": np.bool_(True)}
    assert plain(value) == {"a": [1.0, None], "b": [3, None], "c": True}


# --- on the estimate itself -------------------------------------------------------------------------------------------
@pytest.mark.second
def test_what_is_drawn_is_what_the_estimate_says(tmp_path):
    place, _ = lived(tmp_path)
    with History(str(place)) as history:
        operation = Operation(history, kept_plan(history))
        following = operation.follow()
        desk = Desk(history, lambda: operation)
        state = json.loads(desk.state)
        assert [one["value"] for one in state["quantities"]] == pytest.approx(following.now.values[0].tolist())
        assert [one["body"] for one in state["jumps"]] == [one.body for one in following.jumps] == ["base/backward/M2"]
        end = following.time + 30 * DAY
        told = json.loads(desk.trend(0, end))
        past, future = told["past"], told["future"]
        chosen = [0, len(past["times"]) // 2, -2]  # the last one is now, as the state has it
        course = operation.smoothed([past["times"][k] for k in chosen])
        for q in range(len(desk.overview.quantities)):
            assert [past["values"][q][k] for k in chosen] == pytest.approx(course.values[:, q].tolist(), abs=1e-9)
            assert [past["sigmas"][q][k] for k in chosen] == pytest.approx(course.sigmas[:, q].tolist(), abs=1e-9)
        last = operation.forecast([future["times"][-1]])
        assert [one[-1] for one in future["values"]] == pytest.approx(last.values[0].tolist(), abs=1e-9)
        when = following.jumps[0].until_us + 8 * DAY
        moved = json.loads(desk.motions(when))
        exact = operation.motions(moved["time_us"])
        for one in moved["largest"]:  # of all causes together
            own = np.array([label == one["label"] for label in exact.labels], np.float64)
            assert one["mean"] == pytest.approx(own @ exact.mean, rel=1e-6)
            assert one["sigma"] == pytest.approx(np.sqrt(own @ exact.covariance @ own), rel=1e-6)
        assert len({one["label"] for one in moved["largest"]}) == len(moved["largest"])
        assert abs(moved["time_us"] - when) < DAY


def test_of_a_long_record_the_last_weeks_are_worked_out_by_themselves(record, monkeypatch):
    overview = Overview.of(record, StandIn(record))
    monkeypatch.setattr(past_view, "WEEKS", 5 * DAY)
    views = past_view.Views()
    assert views.over(record, overview, NEWEST).times[0] == START  # a short record is worked out whole
    monkeypatch.setattr(past_view, "MANY", 100)
    views = past_view.Views()
    recent = views.over(record, overview, NEWEST - DAY)
    assert recent.times[0] == NEWEST - 5 * DAY
    assert views.over(record, overview, NEWEST - DAY) is recent
    life = views.over(record, overview, START)
    assert life.times[0] == START
    later = replace(overview, following=replace(overview.following, time=NEWEST + DAY // 2))
    assert views.over(record, later, START) is life  # half a day old
    assert views.over(record, later, NEWEST).now == NEWEST + DAY // 2
    later = replace(overview, following=replace(overview.following, time=NEWEST + 2 * DAY))
    assert views.over(record, later, START).now == NEWEST + 2 * DAY


@pytest.mark.second
def test_the_command_serves_until_it_is_told_to_end(tmp_path):
    place, _ = lived(tmp_path)
    tokens = {"TWIN_OPERATE_TOKEN": READ, "TWIN_OPERATE_WRITE_TOKEN": WRITE}
    words = [sys.executable, "-m", "twin.operate", "serve", str(place), "--port", "0", "--write-token"]
    env = {**os.environ, **tokens, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=env, cwd=Path(__file__).parents[2])
    try:
        assert process.stdout is not None
        line = next(one for one in process.stdout if one.startswith("open http://"))
        port = int(line.split("/")[2].rpartition(":")[2])
        assert line.strip().endswith(f"/?token={READ}")
        assert process.stdout.readline().strip().endswith(f"/?token={READ}&write={WRITE}")
        number = data(port, "/state")["alarms"][0]["id"]
        assert post(port, {"alarm": number, "by": "A"}, None)[0] == 403
        assert post(port, {"alarm": number, "by": "A"})[0] == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
    finally:
        process.kill()
        process.wait(20)


def test_what_cannot_be_served_is_told(tmp_path, record, monkeypatch):
    folder = Path(record.url.removeprefix("sqlite:///")).parent
    told = invoke(app, "serve", folder)
    assert told.exit_code == 2
    assert "keeps no plan" in told.stderr
    monkeypatch.setenv("TWIN_OPERATE_TOKEN", "short")
    told = invoke(app, "serve", folder)
    assert told.exit_code == 2
    assert "TWIN_OPERATE_TOKEN needs" in told.stderr
    made(tmp_path / "empty").close()
    told = invoke(app, "serve", tmp_path / "empty")
    assert told.exit_code == 2
    assert "no reading of the monitor" in told.stderr


# --- the page ---------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra `test`)")
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    with playwright.sync_playwright() as made:
        browser = made.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


def opened(browser, port: int, words: str = "", width: int = 1300) -> Page:
    page = Page(browser, f"http://127.0.0.1:{port}/?token={READ}{words}", width)
    page.until("document.body.dataset.chosen !== undefined", 60.0)
    return page


@pytest.mark.second
def test_an_alarm_is_acknowledged_in_the_page_and_new_readings_appear(browser, fresh):
    history, desk = fresh
    with serving(desk) as port:
        page = opened(browser, port, f"&write={WRITE}")
        assert "token" not in page.page.url
        page.page.click('.alarm[data-alarm="1"] button')
        page.page.fill("#by", "A. Nurse")
        page.page.fill("#note", f"seen {EVIL}")
        page.page.click('#acknowledge [type="submit"]')
        page.until("document.querySelector('.alarm[data-alarm=\"1\"]').classList.contains('known')")
        assert "acknowledged by A. Nurse" in page.page.inner_text("#alarm-list")
        assert history.alarms()[0]["acknowledged"]["note"] == f"seen {EVIL}"
        assert page.page.locator("#alarm-list button").count() == 0
        history.take(given("more.csv", [monitor_entry(k) for k in range(20, 25)]))
        page.until("document.getElementById('newest').textContent.startsWith('25 readings')")
        page.until("document.getElementById('reading-time').textContent.startsWith('2026-01-04 00:00')")
        page.close()
        assert page.wrong == []
