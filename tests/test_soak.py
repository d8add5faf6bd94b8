"""The soak itself: it must notice what is wrong, for a soak that notices nothing always passes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from explorer.app import App
from explorer.exhibit import Analyst, Answer
from explorer.opening import open_model
from explorer.session import State
from lpn.errors import LPNError
from soak import hand, reading
from soak.asked import Asked, fits
from soak.figures import CALLBACKS, GROWTH, LEFT_HANDLES, LEFT_THREADS, Figures, Memory
from soak.hand import FaultError, Socket
from soak.record import Fault, Record, Time
from soak.reference import Reference
from soak.script import Client
from soak.server import Held, Server


@pytest.fixture(scope="module")
def reference(data: Path, model_file: Path) -> Reference:
    return Reference(data, model_file)


@contextmanager
def running(data: Path, model_file: Path) -> Iterator[App]:
    """The app in this process."""
    served = App(open_model(data, model_file), "127.0.0.1", 0)
    yield served
    served.close()


@pytest.fixture(scope="module")
def app(data: Path, model_file: Path) -> Iterator[App]:
    with running(data, model_file) as served:
        yield served


@pytest.fixture
def client(app: App, reference: Reference) -> Iterator[Socket]:
    at = Socket(url(app), reference, threading.Event())
    yield at
    at.leave("vanish")


def url(app: App) -> str:
    return f"http://127.0.0.1:{app.server.get_port()}"


def entered(client: Socket, reference: Reference) -> Asked:
    """A page opened on a turned query, and what it must show."""
    asked = replace(reference.first(), query=3, angle=20.0)
    client.enter(f"task={asked.task}&query=~3&angle=20")
    return asked


def test_what_a_page_shows_is_what_is_computed_from_the_files(client: Socket, reference: Reference) -> None:
    asked = entered(client, reference)
    assert reference.flaws(asked, client.settle(asked).shown) == []
    left = client.drag("Rotate", [30.0, 31.0, 47.0])
    path = [replace(asked, angle=angle) for angle in (30.0, 31.0)]
    asked = replace(asked, angle=left)
    assert reference.flaws(asked, client.settle(asked, path).shown) == []
    own = reference.own(Random(0), "mine")
    client.send(own)
    asked = asked.sent(own)
    assert reference.flaws(asked, client.settle(asked).shown) == []
    client.tell("compare", 5)
    asked = replace(asked, tile=5)
    assert reference.flaws(asked, client.settle(asked).shown) == []


def test_an_answer_to_another_question_is_a_wrong_one(client: Socket, reference: Reference) -> None:
    asked = entered(client, reference)
    shown = client.settle(asked).shown
    for other in (
        replace(asked, angle=25.0),
        replace(asked, right=4),
        asked.weighed(1, 0.5),
        asked.switched(2),
        replace(asked, query=4),
        replace(asked, tile=shown.rows[3].index),
        asked.sent(reference.own(Random(0), "mine")),
    ):
        assert reference.flaws(other, shown), other


def test_every_number_that_is_shown_counts(client: Socket, reference: Reference) -> None:
    asked = entered(client, reference)
    client.settle(asked)
    elements = dict(client.talker.elements)
    pieces = [elements[name] for name in ("lpn-status", "lpn-matches", "lpn-parts")]
    assert reference.flaws(asked, reading.shown(*pieces)) == []
    right = reading.shown(*pieces)
    row, line = right.rows[2], right.parts[1]
    for piece, there, other in (
        (1, f"data-index='{row.index}'", f"data-index='{right.rows[3].index}'"),
        (1, f"<span>{row.distance:.3f}</span>", f"<span>{row.distance + 0.004:.3f}</span>"),
        (1, f": {row.shares[1]:.4f}'", f": {row.shares[1] + 0.004:.4f}'"),
        (1, "<b>3</b>", "<b>7</b>"),
        (2, f">{line[2]}<", ">+0.001<"),
        (0, "data-top='", "data-top='1"),
        (1, "<div class='row", "<div class='column"),
    ):
        assert there in pieces[piece]
        changed = list(pieces)
        changed[piece] = changed[piece].replace(there, other)
        assert reference.flaws(asked, reading.shown(*changed)), there


def test_an_address_that_says_less_or_more_does_not_fit(reference: Reference) -> None:
    asked = replace(reference.first(), query=3, angle=20.0).weighed(0, 0.5)
    name = reference.label(asked)
    said = {"query": "3", "name": name, "angle": "20"}
    link = f"task={asked.task}&query={name}&angle=20&weights=0.5,1,1,1"
    assert fits(reference, asked, link, said)
    assert fits(reference, asked, f"?{link}&websocket=x", said)
    assert not fits(reference, asked, link.replace("0.5", "0.6"), said)
    assert not fits(reference, asked, f"{link}&off=2", said)
    assert not fits(reference, asked, link, {**said, "name": "another's"})
    assert not fits(reference, asked, None, said)


def test_an_answer_computed_for_another_angle_is_noticed(
    client: Socket, reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = entered(client, reference)
    client.settle(asked)
    right = Analyst.answer

    def wrong(self: Analyst, state: State, k: int) -> Answer:
        return replace(right(self, replace(state, angle=state.angle + 5), k), state=state)

    monkeypatch.setattr(Analyst, "answer", wrong)
    client.drag("Rotate", [50.0])
    asked = replace(asked, angle=50.0)
    assert reference.flaws(asked, client.settle(asked).shown)


def test_anothers_state_is_noticed_even_when_the_right_one_follows(
    app: App, client: Socket, reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hand, "BOUND", 20.0)
    asked = entered(client, reference)
    client.settle(asked)
    visitor = app._visitors[max(app._visitors)]
    right, seen = Analyst.answer, []

    def another(self: Analyst, state: State, k: int) -> Answer:
        seen.append(state)
        if len(seen) == 1:
            visitor._worker.wake()
            return right(self, replace(state, query=7), k)
        time.sleep(0.5)  # viser leaves out what is replaced before it is sent
        return right(self, state, k)

    monkeypatch.setattr(Analyst, "answer", another)
    client.drag("Rotate", [50.0])
    with pytest.raises(FaultError, match="foreign state"):
        client.settle(replace(asked, angle=50.0))


def test_an_answer_that_never_comes_and_a_server_that_hangs_up_are_faults(
    data: Path, model_file: Path, reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(data, model_file) as served:
        client = Socket(url(served), reference, threading.Event())
        asked = entered(client, reference)
        client.settle(asked)
        monkeypatch.setattr(hand, "BOUND", 1.0)
        with pytest.raises(FaultError, match=r"no answer.*angle.*21"):
            client.settle(replace(asked, angle=21.0))
    with pytest.raises(FaultError, match="disconnected"):
        client.settle(replace(asked, angle=21.0))


def test_a_client_does_the_same_again_with_the_same_seed(app: App, reference: Reference) -> None:
    did = []
    for seed in (1, 1, 2):
        stop, record = threading.Event(), Record(reference)
        client = Client("client 1", seed, Socket(url(app), reference, stop), reference, record, stop, stays=False)
        with record.connected():
            client._enter()
            acts = []
            for _ in range(4):
                client._act()
                acts.append((client._step, client._did, client._asked.address()))
        client._hand.leave("close")
        record.close()
        assert record.faults == []
        assert record.checked >= 4
        did.append(acts)
    assert did[0] == did[1]
    assert did[0] != did[2]


def held(megabytes: float, threads: int = 10, handles: int = 5, at: float = 0.0) -> Held:
    return Held(at, megabytes, threads, handles, 0)


def figures(memory: Memory, faults: list[Fault], times: list[Time]) -> Figures:
    return Figures(0, 2, 0, 60.0, 2, 5, 0, 0, faults, [], times, memory)


def test_what_is_left_behind_is_a_flaw() -> None:
    during = [held(300 + at / 10, at=at) for at in range(0, 600, 2)]
    empty, before = held(200, threads=4), held(250, threads=30)
    memory = Memory.of(empty, before, during, held(310, threads=4 + CALLBACKS + LEFT_THREADS))
    assert memory.growth == pytest.approx(360)
    assert memory.minute is not None
    assert memory.minute.at == 60
    assert memory.flaws() == []
    for left in (
        held(306 + GROWTH + 1),
        held(300, threads=4 + CALLBACKS + LEFT_THREADS + 1),
        held(300, handles=6 + LEFT_HANDLES),
    ):
        assert len(Memory.of(empty, before, during, left).flaws()) == 1, left
    assert Memory.of(None, None, [], None).flaws() == []
    assert Memory.of(empty, before, during[:10], before).growth is None


def test_fairness_is_the_slowest_clients_median_over_that_of_all(capsys: pytest.CaptureFixture[str]) -> None:
    times = [Time("together", "client 1", "drag", 1.0)] * 9 + [Time("together", "client 2", "drag", 3.0)] * 3
    times += [Time("together", "page 1", "drag", 50.0), Time("together", "client 1", "upload", 70.0)]
    found = figures(Memory.of(None, None, [], None), [], times)
    assert found.fairness() == (3.0, 3.0)
    assert found.flaws() == []
    said = json.loads(found.json())
    assert said["by client"]["client 2"]["median"] == 3.0
    assert said["alone"]["median"] is None
    failed = replace(found, faults=[Fault("wrong answer", "client 2", 4, "dragged")], tracebacks=["Traceback"])
    assert failed.flaws() == ["1 x wrong answer.", "1 tracebacks in the server's log."]
    assert capsys.readouterr().out == ""


def test_a_server_that_does_not_start_says_why(tmp_path: Path) -> None:
    nowhere = Server(["--data", str(tmp_path), "--model", str(tmp_path / "none.onnx")])
    with pytest.raises(LPNError, match=r"did not start. It said: .*none\.onnx"), nowhere:
        pass
