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
from typing import Any

import numpy as np
import pytest

from explorer.app import App
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.workspace import StateAnalyser, StateAnalysis
from lpn import descriptors
from lpn.core.errors import LPNError
from lpn.models.base import normalise
from tools.soak import hand, reading
from tools.soak import server as server_module
from tools.soak.asked import Asked, fits, strange
from tools.soak.figures import CALLBACKS, ENOUGH, GROWTH, LEFT_HANDLES, LEFT_THREADS, Figures, Memory
from tools.soak.hand import FaultError, Socket, StoppedError
from tools.soak.reading import Row, Shown
from tools.soak.record import OWN_ERROR, Fault, Record, Time
from tools.soak.record import Answer as Answered
from tools.soak.reference import EQUAL, SIGNS, Reference
from tools.soak.run import Soak
from tools.soak.script import Client
from tools.soak.server import Held, Server


@pytest.fixture(scope="module")
def reference(data: Path, model_file: Path) -> Reference:
    return Reference(data, model_file)


@contextmanager
def running(data: Path, model_file: Path) -> Iterator[App]:
    """The app in this process."""
    served = App(open_model(data, model_file), "127.0.0.1", 0)
    try:
        yield served
    finally:
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
        (1, f'data-index="{row.index}"', f'data-index="{right.rows[3].index}"'),
        (1, f"<span>{row.distance:.3f}</span>", f"<span>{row.distance + 0.004:.3f}</span>"),
        (1, f': {row.shares[1]:.4f}"', f': {row.shares[1] + 0.004:.4f}"'),
        (1, "<b>3</b>", "<b>7</b>"),
        (2, f">{line[2]}<", ">+0.001<"),
        (0, 'data-top="', 'data-top="1'),
        (1, '<div class="row', '<div class="column'),
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
    assert not fits(reference, asked, f"{link}&opacity=0.1", said), "which no client asks for"
    assert not fits(reference, asked, link, {**said, "name": "another's"})
    assert not fits(reference, asked, None, said)


def test_an_address_is_strange_that_says_what_none_of_a_clients_acts_asked_for(reference: Reference) -> None:
    before = replace(reference.first(), query=3)
    path = [replace(before, angle=angle, zoom=zoom) for angle, zoom in ((10.0, 1.0), (10.0, 2.0), (20.0, 2.0))]
    link = f"task={before.task}&query={reference.label(before)}"
    assert strange(reference, [*path, before], [link]) == []
    assert strange(reference, [*path, before], [link, f"{link}&angle=20&zoom=2"]) == []
    assert strange(reference, [*path, before], [f"{link}&angle=20"]) == []
    assert strange(reference, path, [link]) == ["no angle"]
    assert strange(reference, path, [f"{link}&angle=21&zoom=2&lab=1", link]) == ["angle=21", "lab=1", "no angle"]


def printed(reference: Reference, asked: Asked, order: list[int]) -> Shown:
    """A page that shows tiles in an order, and of each what is right of it, the gap to the next in that order."""
    ranking, side, rows = reference.ranking(asked), reference.sides[asked.task], []
    for at, index in enumerate(order[:10]):
        match = ranking.find(index)
        gap = 2 * (ranking.scores[index] - ranking.scores[order[at + 1]])
        texts = [str(at + 1), SIGNS[match.true], side.gallery[index].name, f"{match.distance2:.3f}", f"+{gap:.3f}"]
        rows.append(Row(index, at == 0, False, texts, [float(share) for share in match.shares]))
    chosen, truth = ranking.find(order[0]), ranking.truth()
    assert truth is not None
    if truth.rank > 10:
        texts = [str(truth.rank), SIGNS[True], side.gallery[truth.index].name, f"{truth.distance2:.3f}"]
        texts += [] if truth.gap is None else [f"+{truth.gap:.3f}"]
        rows.append(Row(truth.index, False, True, texts, [float(share) for share in truth.shares]))
    parts = [
        [name, f"{100 * weight:.0f} %", f"{cosine:+.3f}", f"{share:.3f}"]
        for name, weight, cosine, share in zip(
            reference.names, ranking.weights, chosen.cosines, chosen.shares, strict=True
        )
    ]
    table = [["part"], *parts, ["sum", "100 %", "", f"{chosen.distance2:.3f}"]]
    return Shown({"top": str(order[0]), "chosen": str(order[0])}, rows, table)


def test_tiles_of_equal_scores_may_stand_in_either_order(data: Path, model_file: Path) -> None:
    reference = Reference(data, model_file)
    asked = replace(reference.first(), query=3)
    side = reference.sides[asked.task]
    drawn = normalise(np.random.default_rng(0).normal(size=side.descriptors.shape).astype(np.float32))
    drawn[4] = drawn[3]
    reference.sides[asked.task] = replace(side, descriptors=drawn)
    order = reference.ranking(asked).order.tolist()
    scores = reference.ranking(asked).scores[order]
    at = order.index(3)
    assert order[at + 1] == 4
    assert scores[at - 1] - scores[at] > 10 * EQUAL < scores[at + 1] - scores[at + 2]
    assert reference.flaws(asked, printed(reference, asked, order)) == []
    order[at : at + 2] = 4, 3
    assert reference.flaws(asked, printed(reference, asked, order)) == []
    order[at : at + 2] = order[at + 2], 4
    assert reference.flaws(asked, printed(reference, asked, order))


def test_two_queries_of_one_picture_are_described_each_within_its_box(data: Path, model_file: Path) -> None:
    reference = Reference(data, model_file)
    asked = reference.first()
    side = reference.sides[asked.task]
    boxes = [(0.0, 0.0, 40.0, 40.0), (40.0, 40.0, 96.0, 96.0)]
    reference.sides[asked.task] = replace(side, queries=[replace(side.queries[0], box=box) for box in boxes])
    one, other = (reference.ranking(replace(asked, query=query)).scores for query in (0, 1))
    assert not np.array_equal(one, other)


def test_descriptors_that_are_not_of_their_pictures_are_no_reference(
    data: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = descriptors.stored_side

    def wrong(*asked: Any) -> Any:
        found = right(*asked)
        return replace(found, descriptors=found.descriptors[::-1])

    monkeypatch.setattr(descriptors, "stored_side", wrong)
    with pytest.raises(LPNError, match="is not that of its picture"):
        Reference(data, model_file)


def test_an_answer_computed_for_another_angle_is_noticed(
    client: Socket, reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = entered(client, reference)
    client.settle(asked)
    right = StateAnalyser.analyse

    def wrong(self: StateAnalyser, state: SessionState, k: int) -> StateAnalysis:
        return replace(right(self, replace(state, angle=state.angle + 5), k), state=state)

    monkeypatch.setattr(StateAnalyser, "analyse", wrong)
    client.drag("Rotate", [50.0])
    asked = replace(asked, angle=50.0)
    assert reference.flaws(asked, client.settle(asked).shown)


@pytest.mark.parametrize("others", [{"query": 7}, {"weights": (0.5, 1.0, 1.0, 1.0)}, {"zoom": 2.0}, {"opacity": 0.1}])
def test_anothers_state_is_noticed_even_when_the_right_one_follows(
    app: App, client: Socket, reference: Reference, monkeypatch: pytest.MonkeyPatch, others: dict[str, Any]
) -> None:
    monkeypatch.setattr(hand, "BOUND", 20.0)
    asked = entered(client, reference)
    client.settle(asked)
    visitor = app._visitors[max(app._visitors)]
    right, seen = StateAnalyser.analyse, []

    def another(self: StateAnalyser, state: SessionState, k: int) -> StateAnalysis:
        seen.append(state)
        if len(seen) == 1:
            visitor._worker.wake()
            return right(self, replace(state, **others), k)
        time.sleep(0.5)  # viser leaves out what is replaced before it is sent
        return right(self, state, k)

    monkeypatch.setattr(StateAnalyser, "analyse", another)
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


def test_what_is_waited_for_at_the_end_of_a_soak_is_waited_for(
    app: App, reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = threading.Event()
    client = Socket(url(app), reference, stop)
    asked = entered(client, reference)
    client.settle(asked)
    client.set("Rotate", 50.0)
    stop.set()
    client.settle(replace(asked, angle=50.0))
    monkeypatch.setattr(hand, "BOUND", 1.0)
    with pytest.raises(FaultError, match="no answer"):
        client.settle(replace(asked, angle=21.0))
    record = Record(reference)
    with pytest.raises(StoppedError):
        Client("client 1", 0, client, reference, record, stop, stays=False)._act()
    record.close()
    client.leave("close")


def test_the_same_name_can_be_typed_again_and_again(
    client: Socket, reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hand, "BOUND", 20.0)
    record = Record(reference)
    script = Client("client 1", 0, client, reference, record, threading.Event(), stays=False)
    script._enter()
    side = reference.sides[script._asked.task]
    monkeypatch.setitem(side.__dict__, "unique", side.unique[:1])
    for _ in range(8):
        script._find()
        script._dragged("Rotate", script._path("Rotate", 1))
    record.close()
    assert record.faults == []


def test_a_page_is_greeted_until_it_listens(app: App, reference: Reference, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hand, "BOUND", 20.0)
    heard: list[str] = []
    right = hand.Talker.tell

    def tell(self: hand.Talker, kind: str, value: object) -> None:
        heard.append(kind)
        if len(heard) > 1:
            right(self, kind, value)

    monkeypatch.setattr(hand.Talker, "tell", tell)
    client = Socket(url(app), reference, threading.Event())
    client.settle(entered(client, reference))
    assert len(heard) > 1
    client.leave("close")


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


def test_a_check_that_fails_is_an_error_and_the_next_answer_is_checked(
    reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flaws(_: Reference, asked: Asked, __: Shown) -> list[str]:
        if asked.angle:
            raise LPNError("cannot be checked")
        return []

    monkeypatch.setattr(Reference, "flaws", flaws)
    record, shown = Record(reference), Shown({}, [], [])
    for angle in (5.0, 0.0):
        asked = replace(reference.first(), angle=angle)
        record.answer(Answered("drag", "client 1", 1, "dragged", asked, shown, 0.1))
    record.close()
    assert (record.checked, record.waiting) == (1, 1)
    assert [fault.kind for fault in record.faults] == [OWN_ERROR]
    assert "cannot be checked" in record.faults[0].said


class Idle(Server):
    """A server that is not there, for clients that never ask it."""

    alive = True  # type: ignore[assignment]

    def held(self, *_: object) -> None:
        return None


def test_a_client_that_cannot_begin_or_does_not_end_is_an_error(
    reference: Reference, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tools.soak.run.ENDING", 0.2)
    let = threading.Event()

    def cannot(*_: object) -> None:
        raise RuntimeError("there is no browser")

    record = Record(reference)
    soak = Soak(tmp_path, tmp_path, [], 1, 2, 0, 0.0, 0.0)
    starts = {"page 1": cannot, "page 2": lambda *_: bool(let.wait(30))}
    soak._phase(Idle([]), record, reference, 0.5, starts)  # type: ignore[arg-type]
    let.set()
    record.close()
    assert [(fault.kind, fault.who) for fault in record.faults] == [(OWN_ERROR, "page 1"), (OWN_ERROR, "page 2")]
    assert "there is no browser" in record.faults[0].said


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
    assert memory.minute.at == 76
    assert memory.flaws() == []
    for left in (
        held(memory.minute.megabytes + GROWTH + 1),
        held(300, threads=4 + CALLBACKS + LEFT_THREADS + 1),
        held(300, handles=6 + LEFT_HANDLES),
    ):
        assert len(Memory.of(empty, before, during, left).flaws()) == 1, left
    grows = [held(300 + at / 5, at=at) for at in range(0, 600, 2)]
    assert len(Memory.of(empty, before, grows, held(300)).flaws()) == 1
    waves = [held(300 + (20 if at % 4 else -20), at=at) for at in range(0, 602, 2)]
    waves[30], waves[-1] = held(100, at=60), held(500, at=600)
    assert Memory.of(empty, before, waves, held(300)).flaws() == [], "one moment says nothing"
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
    assert replace(found, unchecked=2).flaws() == ["2 answers were not checked."]
    waits = [*times, *[Time("together", "client 4", "drag", 1.0)] * 2 * ENOUGH]
    waits += [Time("together", "client 3", "drag", 3.1)] * (ENOUGH - 1)
    assert replace(found, times=waits).flaws() == [], "of so few answers, it may be chance"
    waits.append(Time("together", "client 3", "drag", 3.1))
    assert replace(found, times=waits).flaws() == [
        "The slowest client's median is 3.10 times that of all; expected 3 or less."
    ]
    failed = replace(found, faults=[Fault("wrong answer", "client 2", 4, "dragged")], tracebacks=["Traceback"])
    assert failed.flaws() == ["1 x wrong answer.", "1 tracebacks in the server's log."]
    assert capsys.readouterr().out == ""


def test_a_server_that_does_not_start_says_why(tmp_path: Path) -> None:
    nowhere = Server(["--data", str(tmp_path), "--model", str(tmp_path / "none.onnx")])
    with pytest.raises(LPNError, match=r"did not start. It said: .*none\.onnx"), nowhere:
        pass


def test_a_server_that_does_not_end_is_killed_and_what_it_said_is_kept(
    data: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Server(["--data", str(data), "--model", str(model_file)]) as server:
        assert server.alive
        monkeypatch.setattr(server_module, "END", 0.0)
    assert server.killed
    assert not server.alive
    assert "ready: http://" in server.said()
