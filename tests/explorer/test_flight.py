"""A flight over a map in the explorer: opening, registration in the background, and frames of unknown place."""

from __future__ import annotations

import gc
import re
import threading
import weakref
from dataclasses import replace
from datetime import date
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

import explorer.app
import lpn
from explorer import opening, session_state
from explorer.feeds import Feeds
from explorer.browse.query_list import entries
from explorer.cli import Explore
from explorer.compute import own_photos
from explorer.compute.own_photos import CameraPicture, OwnPhotoComparisons, OwnPhotoJobs, OwnPhotoProgress
from explorer.failure_lab import state as lab_state
from explorer.failure_lab import table as lab_table
from explorer.failure_lab.service import FailureLab
from explorer.failure_lab.state import LabState
from explorer.flight_window.own_picture import own_picture
from explorer.opening import open_flight_over
from explorer.panels import answer_text, first_screen, pages, place_text
from explorer.panels.navigation import Navigation
from explorer.panels.stage_controls import part_bars
from explorer.session_state import SessionState
from explorer.url_state import UrlState
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn.cli.main import main
from lpn.core.arrays import UInt8Array
from lpn.core.demo import DEMO
from lpn.core.errors import DataError, InputError, PictureError
from lpn.core.progress import report_progress
from lpn.drawing.words import speaking
from lpn.flights import Frame, write_flight
from lpn.library.analyser import OwnPicture
from lpn.locate.agreement import MapAgreement
from lpn.locate.located import LocatedFlight, StageRecord
from lpn.locate.matchers import SiftMatcher
from lpn.locate.task import TASK
from lpn.maps import Map, Window
from lpn.maps.named_window import WindowCut
from lpn.maps.tag_placed import describe_placing
from lpn.sources import ModelOptions
from tests.lpn.locate.scenery import FLOWN_PLACES, ground_to_photo, land, photo_of, small_flight, write_map

# Frames of `small_flight` whose places are unknown: one has no position, one cannot be read.
UNKNOWN = [0, 2]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A map, and a flight's folder."""
    folder = tmp_path_factory.mktemp("flown")
    town = write_map(folder / "town.tif", land()[::2, ::2])
    (folder / "monday").mkdir()
    write_flight(small_flight(folder / "monday", town), folder / "monday")
    return folder / "town.tif", folder / "monday"


@pytest.fixture(scope="module")
def workspace(files: tuple[Path, Path], model_file: Path) -> Workspace:
    return open_flight_over(*files, ModelOptions(model=model_file), query="05.png", register=False)


def _state(workspace: Workspace, query: int) -> SessionState:
    return SessionState(TASK, workspace.contract.n_parts, query=query)


def _register(located: LocatedFlight, *_: Any, **__: Any) -> LocatedFlight:
    """Refuse all frames, as the registration would enter them."""
    report_progress("Registering frames", len(located.frames), len(located.frames))
    refused = StageRecord("refused", "Only 4 matches agree.", inliers=4)
    frames = [replace(frame, stages=frame.stages | {"registration": refused}) for frame in located.frames]
    return replace(located, frames=frames)


def test_frames_are_the_queries_and_windows_of_the_map_the_gallery(workspace: Workspace) -> None:
    located, task = workspace.flight, workspace.tasks[TASK]
    assert located is not None
    assert located.stages == ["retrieval", "sequence"]
    assert workspace.registration is None
    assert task.query_names == [frame.frame.name for frame in located.frames]
    assert workspace.first_query == 5
    analysis = StateAnalyser(workspace).analyse(_state(workspace, 5), 3)
    assert analysis.matches[0].score == pytest.approx(located.frames[5].windows[0].score, abs=1e-5)
    assert workspace.thumbnail(task.queries[5]).startswith("data:image/jpeg")
    assert UrlState(workspace).read(f"query={task.query_names[5]}", _state(workspace, 0))[0].query == 5


def test_a_window_that_cannot_be_read_is_grey_in_the_answers_that_rank_it(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(*_: Any) -> None:
        raise DataError("The sheet is damaged.")

    monkeypatch.setattr(Map, "read", damaged)
    task = workspace.tasks[TASK]
    card = workspace.card(task, 3)
    assert (card.shape[1::-1], card.min(), card.max()) == (workspace.layout.card_pixels, 60, 60)
    assert workspace.thumbnail(task.gallery[3]).startswith("data:image/jpeg")


def test_the_picture_of_all_tiles_is_the_map(workspace: Workspace) -> None:
    located, task = workspace.flight, workspace.tasks[TASK]
    assert located is not None
    assert located.retrieval is not None
    assert task.geometry is not None
    picture, (west, south, east, north) = workspace.mosaic(task), task.geometry.bounds()
    x, y = located.retrieval.places[7]
    origin = located.retrieval.places[7] - task.geometry.ground[7]
    column = (x - origin[0] - west) / (east - west) * picture.shape[1]
    row = (north - (y - origin[1])) / (north - south) * picture.shape[0]
    shown = picture[int(row) - 20 : int(row) + 20, int(column) - 20 : int(column) + 20]
    metres = 40 * (east - west) / picture.shape[1]
    expected, _ = located.basemap.read(Window(x, y, metres), 40)
    assert np.abs(shown.astype(float) - expected).mean() < 12


def test_registration_replaces_the_flight_when_it_is_done(
    files: tuple[Path, Path], model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_end = threading.Event()

    def register(*arguments: Any, **options: Any) -> LocatedFlight:
        assert may_end.wait(60)
        assert arguments[2].map_error == 7.0
        return _register(*arguments, **options)

    monkeypatch.setattr(opening, "registered", register)
    monkeypatch.setattr(opening, "REGISTRATION_WAIT", 0.0)
    workspace = open_flight_over(*files, ModelOptions(model=model_file), map_error=7.0)
    before, job = workspace.flight, workspace.registration
    assert before is not None
    assert job is not None
    laboratory = FailureLab(workspace)
    assert laboratory.build(TASK, None).wait(60)
    findings = laboratory.findings(TASK)
    assert findings is not None
    assert "registration" not in findings.table.columns
    assert set(findings.table.columns["verdict"].values) <= {"by its neighbours", "not verified", "not located"}
    assert not job.wait(0)
    may_end.set()
    assert job.wait(60)
    assert (job.done, job.total) == (len(FLOWN_PLACES) + 1,) * 2
    assert workspace.flight is not before
    newest = laboratory.findings(TASK)
    assert newest is not None
    assert set(newest.table.columns["registration"].values) == {"refused"}
    assert newest.table.columns["reason"].values[5] == "Only 4 matches agree."
    assert newest.table.columns["sequence off tag"].about.startswith("Distance from the photo's GPS tag")
    assert "reason" not in [column.name for column in lab_state.charted_columns(newest)]
    # Figures of the look alone say so, and rows that are fetched later use the table's words.
    lab, rows, feeds = LabState(task=TASK), newest.table.rows(), Feeds(workspace)
    with speaking(workspace.vocabulary(True)):
        table = lab_table.table(newest, lab, len(rows), 1, 300)
        assert " wrong (" in (summary := lab_table.summary(newest, lab, rows))
        feed = lab_table.publish(feeds, "me", newest, lab, rows)
    assert "distance by its look" in table
    assert "verdict of all methods" in table
    assert ") by their look" in summary
    fetched = feeds.find(f"{feeds.address.partition('/')[2]}{feed}0")
    assert fetched is not None
    assert b"only guessed" in fetched().data


def test_frames_of_unknown_place_are_neither_found_nor_failed(workspace: Workspace) -> None:
    task, known = workspace.tasks[TASK], len(FLOWN_PLACES) + 1 - len(UNKNOWN)
    assert f"{known} queries are graded" in " ".join(pages.header(workspace, task).split())
    analysis = StateAnalyser(workspace).analyse(_state(workspace, 0), 3)
    assert answer_text.verdict(analysis, workspace)[:2] == (None, "Best match")
    assert [
        right is None
        for _, _, right in entries(workspace.rankings[TASK], [0, 2, 5], workspace.graded(workspace.rankings[TASK]))
    ].count(False) == 1
    assert all(workspace.thumbnail_file(task.queries[query])[:2] == b"\xff\xd8" for query in (0, 2, 5))
    with pytest.raises(PictureError, match="is not a picture"):
        StateAnalyser(workspace).analyse(_state(workspace, 2), 3)
    laboratory = FailureLab(workspace)
    assert laboratory.build(TASK, None).wait(60)
    findings = laboratory.findings(TASK)
    assert findings is not None
    rows = {
        outcome: set(lab_state.selected_rows(findings, LabState(task=TASK, outcome=outcome)))  # type: ignore[arg-type]
        for outcome in ("all", "failed", "found")
    }
    assert set(UNKNOWN) == rows["all"] - rows["failed"] - rows["found"]
    bar = lab_table.bar(findings, LabState(task=TASK), 3)
    assert all(str(len(rows[outcome])) in bar for outcome in rows)
    rates = lab_state.failure_rates(findings, LabState(task=TASK), findings.table.columns["heading from"])
    assert sum(rate.queries for rate in rates) == known
    places = laboratory.points("ground", TASK, None)
    assert places.wait(60)
    assert places.value is not None
    assert np.flatnonzero(np.isnan(places.value.queries[:, 0])).tolist() == [0]


def test_a_flight_whose_tags_lie_far_off_the_map_is_told_so_first(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert workspace.flight is not None
    analysis = StateAnalyser(workspace).analyse(_state(workspace, 0), 3)
    analysis = replace(analysis, ranking=replace(analysis.ranking, relevant=None))
    monkeypatch.setattr(workspace, "flight", replace(workspace.flight, tags_away=1.929e6))
    with speaking(workspace.vocabulary(True)):
        look = answer_text.plain_verdict(analysis, workspace)
        assert look[2].endswith("The GPS tags are left out, so it is not graded.")
        _, concluded = answer_text.flight_verdict(analysis, workspace, look)
    assert concluded is not None
    assert concluded[:2] == (None, "Probably not on this map")
    assert concluded[2].startswith(
        "The flight's GPS tags lie 1,929 km from this map, so the map is probably of another place."
    )
    assert answer_text.verdict(analysis, workspace)[2] == f"{look[2]} {analysis.verdict.sentence}"


def test_without_positions_nothing_is_graded(files: tuple[Path, Path], workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    assert task.truth is not None
    unknown = replace(task, truth=[replace(one, good=one.good[:0], known=False) for one in task.truth])
    shown: list[str] = []
    blind = Workspace(
        "m", "d", [opening._begin_ranking(unknown)], workspace.contract, workspace.map_sizes, None, None, files[1]
    )
    assert "nothing is graded" in pages.header(blind, unknown)
    navigation = Navigation(blind, lambda title, _: shown.append(title))
    assert navigation.failure(_state(workspace, 3)) is None
    assert shown == ["Nothing is known"]
    assert session_state.random_failure(_state(workspace, 3), blind.rankings[TASK].failed, Random(0)) is None


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            ["--map", "a.tif", "--model", "m.onnx"],
            "--map is of a source, and none is given; name it: lpn explore SOURCE.",
        ),
        ([str(DEMO), "--no-register"], "demo is a data set, and --no-register fits a flight; leave it out."),
        (
            ["monday", "--map", "a.tif", "--model", "m.onnx", "--beside-kind", "dac"],
            "--beside-kind needs --beside",
        ),
        (
            ["monday", "--map", "a.tif", "--model", "m.onnx", "--port", "0"],
            "There is no file a.tif",
        ),
        (
            ["monday", "--map", "a.tif", "--model", "m.onnx", "--map-error", "-1"],
            "The map's error is -1 m; expected 0 or more metres.",
        ),
    ],
)
def test_options_that_do_not_fit_are_refused(
    options: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["explore", *options]) != 0
    assert sentence in " ".join(capsys.readouterr().err.split())


def test_a_frame_that_the_flight_lacks_is_refused_after_what_was_noticed(
    files: tuple[Path, Path], model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match="has no query 99"):
        open_flight_over(*files, ModelOptions(model=model_file), query="99.png", register=False)
    told = capsys.readouterr().err
    assert "1 of 21 photos has no GPS tag" in told
    assert "1 of 21 photos cannot be read" in told


def test_the_kind_of_a_bare_checkpoint_is_named_for_a_flight_and_for_an_index(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = []

    def load(*_: object, kind: str | None = None, **__: object) -> None:
        kinds.append(kind)
        raise InputError("It is not opened.")

    monkeypatch.setattr(lpn, "load", load)
    monkeypatch.setattr(explorer.app, "serve", lambda opened, *_: opened())
    bare: dict[str, Any] = {"model": tmp_path / "bare.pth", "kind": "dac"}
    (tmp_path / "index").mkdir()
    (tmp_path / "index" / "index.json").touch()
    for command in (
        Explore(source=str(files[1]), map=files[0], **bare),
        Explore(source=str(tmp_path / "index"), data=tmp_path, **bare),
    ):
        with pytest.raises(InputError, match="It is not opened"):
            command.run()
    assert kinds == ["dac", "dac"]


def test_an_own_picture_is_compared_with_the_map_by_its_details(
    workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path))
    monkeypatch.setattr(own_photos, "open_matchers", lambda: [SiftMatcher()])
    jobs = OwnPhotoJobs(workspace.own_photos.basemap)  # type: ignore[union-attr]
    changed = threading.Event()
    progress = OwnPhotoProgress(jobs, changed.set)
    width, size = 70.0, (240, 240)
    frame = Frame("mine.jpg", Path("mine.jpg"), *size, height_above_ground=width / 2, fov=90.0)

    def shown(picture: OwnPicture) -> tuple[StateAnalysis, str]:
        state = replace(_state(workspace, 5), upload=picture, first_screen=True)
        analysis = StateAnalyser(workspace).analyse(state, 3)
        job = progress.follow(picture, answer_text.own_windows(analysis))
        assert job is not None
        waiting = replace(analysis, own_photo=job)
        said = answer_text.plain_verdict(waiting, workspace)
        assert job.value is not None or said == (None, "Being compared with the map", "")
        assert job.wait(60)
        assert changed.wait(60)
        return waiting, first_screen.page(waiting, workspace)

    def taken(of: int) -> OwnPicture:
        photo = photo_of(land(of), ground_to_photo((10.0, -20.0), 200.0, width, size), size)
        return CameraPicture("mine.jpg", photo, frame=frame)

    mine, other = taken(0), taken(1)
    analysis, html = shown(mine)
    assert answer_text.plain_verdict(analysis, workspace)[:2] == (True, "On this map")
    assert "By its details, your picture fits the map to <span" in html
    assert "is 1 sigma along each axis" in html
    assert "On the map" in html
    assert html.count("data:image/jpeg") == 3
    assert "How far to trust it" not in html
    explained = StateAnalyser(workspace).analyse(replace(analysis.state, why=True), 3)
    explained = replace(explained, own_photo=analysis.own_photo)
    for off, errs in ((-5.0, False), (5.0, True)):
        with monkeypatch.context() as patch:
            for module in (answer_text, first_screen):
                patch.setattr(module, "off_window", lambda *_, off=off: off)
            reasons = first_screen.page(explained, workspace)
            look = answer_text.plain_verdict(analysis, workspace)[2]
        assert ("The piece that looks most like it lies there, too." in look) != errs
        assert (
            bool(
                re.search(r"Its look alone errs: the middle of the most similar piece lies \d+ m from that place", look)
            )
            == errs
        )
        assert re.search(r"\d+ matches agree with the registration: the median", reasons)
        assert reasons.count('<i class="pin') == 2 * reasons.count("<tr data-pin=") > 0
        assert ("<h2>By its look, which errs</h2>" in reasons) == errs
        assert ("<h2>By its look</h2>" in reasons) != errs
        assert re.search(r"speak for the most similar piece,\s+<span", reasons), "the answer has one name"
        assert "for this answer" not in reasons
    refused = shown(other)[0]
    with monkeypatch.context() as patch:
        patch.setattr(place_text, "share_off_map", lambda _: 0.25)
        for before in (analysis, refused):
            after = StateAnalyser(workspace).analyse(replace(before.state, why=True), 3)
            reasons = first_screen.page(replace(after, own_photo=before.own_photo), workspace).replace(
                "\N{NO-BREAK SPACE}", " "
            )
            assert "25 % of the most similar piece is off the map" in reasons
            assert "this answer" not in re.sub('="[^"]*"', "", reasons), "the answer has one name"
    assert "Nothing shows that the most similar piece is of the same place." in reasons
    for selected in (None, int(analysis.matches[2].index)):
        looked_at = replace(analysis.state, first_screen=False, selected=selected)
        lead = part_bars(StateAnalyser(workspace).analyse(looked_at, 3), workspace.part_names)[1]
        assert lead is not None
        assert "the most similar piece" in (lead.leader, lead.follower)
    assert workspace.flight is not None
    assert analysis.registered is not None
    stages = analysis.registered.located.stages
    before = stages["registration"]
    for places, doubted, beside in (
        (1, False, "Away from its middle, only 1 place of the photo could be found on the map"),
        (3, True, "Away from its middle, the photo lies 50.0 m off the map"),
    ):
        rows = [(0.1, 0.1, 0.0, 50.0)] * places
        stages["registration"] = msgspec.structs.replace(before, agreement=MapAgreement(rows, 60.0))
        sign, _, said = answer_text.plain_verdict(analysis, workspace)
        assert (sign is None) == doubted
        assert beside in said
        assert answer_text.next_step(analysis, workspace).startswith("Compare its edges") == doubted
        bent = own_picture(analysis, workspace, workspace.flight)
        assert bent["own"]["doubted"] == doubted
        assert ("Red diamond with its circle" in bent["card"]) == doubted
        assert bent["card"].count("could be found on the map") == (not doubted)
    stages["registration"] = before
    on_map = own_picture(analysis, workspace, workspace.flight)
    assert not on_map["own"]["doubted"]
    assert on_map["own"]["photo"].startswith("data:image/jpeg")
    assert np.hypot(*np.subtract(on_map["own"]["place"], (10.0, -20.0))) < 5
    assert len(on_map["homography"]) == 9
    assert on_map["own"]["tag"] is None
    assert "Your picture has no GPS tag." in on_map["card"]
    latitude, longitude = workspace.flight.basemap.frame.degrees([(30.0, 0.0)])[0].tolist()
    tagged_there = replace(other, place=(latitude, longitude))
    nowhere = own_picture(
        replace(refused, state=replace(refused.state, upload=tagged_there)), workspace, workspace.flight
    )
    assert (nowhere["own"]["outline"], nowhere["own"]["place"], nowhere["homography"]) == (None, None, None)
    assert nowhere["own"]["tag"] == pytest.approx([30.0, 0.0], abs=0.1)
    assert "White dot: its GPS tag." in nowhere["card"]
    for shown_before, north, sign, headline, reason, following in (
        (analysis, 0.0, True, "On this map", "its GPS tag lies ", ""),
        (
            analysis,
            2e6,
            None,
            "On this map by its details, elsewhere by its GPS tag",
            "km from that place, where 25.1 m are allowed, so one of the two is off",
            "Compare the GPS tags of other photos of its flight: tags can be late or off.",
        ),
        (
            refused,
            0.0,
            None,
            "only its GPS tag says that your picture is of this place",
            "merely the most similar",
            "or for a photo of the same place that looks straight down",
        ),
        (
            refused,
            2e6,
            False,
            "Not on this map",
            "and its GPS tag lies 2,000 km from the map",
            "To check the place of its GPS tag",
        ),
        (refused, 300.0, None, "Probably not on this map", "off the map's border", "Ask for the original file"),
    ):
        assert shown_before.registered is not None
        tag = np.array([10.0, -20.0 + north])
        located = replace(shown_before.registered.located, tag=tag)
        tagged = replace(
            shown_before,
            errors_m=np.full(shown_before.task.tiles, max(north, 5.0)),
            own_photo=SimpleNamespace(value=replace(shown_before.registered, located=located), error=None),  # type: ignore[arg-type]
        )
        said = answer_text.plain_verdict(tagged, workspace)
        assert said[0] is sign
        assert said[1].endswith(headline)
        assert reason in said[2]
        next_step = answer_text.next_step(tagged, workspace)
        assert next_step.startswith(following) or following in next_step
        assert bool(next_step) == bool(following)
    assert "whose GPS tag tells where to look" in answer_text.next_step(refused, workspace)
    day = date(2014, 10, 19)
    of_day = replace(analysis, state=replace(analysis.state, upload=replace(mine, day=day)))
    of_another = replace(analysis, state=replace(analysis.state, upload=replace(mine, day=date(2015, 10, 19))))
    basemap = workspace.basemap
    assert basemap is not None
    for notes, known in (((), False), (("Made of photos. " + describe_placing(13.2, 44.4),), True)):
        by_tags = SimpleNamespace(
            place=SimpleNamespace(day=day), notes=notes, trials=None, metres_off=basemap.metres_off
        )
        monkeypatch.setattr(workspace, "basemap", by_tags)
        assert ("If the map was made of it, too" in answer_text.trust(of_day, workspace)) == known
        assert "If the map was made of it, too" not in answer_text.trust(of_another, workspace)
        assert ("Your picture does not tell when it was taken. If" in answer_text.trust(analysis, workspace)) == known
    monkeypatch.setattr(workspace, "basemap", basemap)
    again = CameraPicture(mine.name, mine.picture.copy(), frame=frame)
    job = progress.follow(again)
    assert job is not None
    assert job.wait(0), "the page holds its answer"
    html = first_screen.page(refused, workspace)
    assert "Its details fit nowhere on this map, so nothing says that your picture is of this place." in html
    assert "right answers" not in html
    assert html.count("data:image/jpeg") == 2
    progress.close()
    assert progress.follow(mine) is None
    assert analysis.registered is not None
    answer = weakref.ref(analysis.registered)
    del analysis, job, of_day, of_another, explained
    gc.collect()
    assert answer() is None, "nothing of the pictures is left when the page has closed"


def test_an_own_picture_whose_tag_lies_beyond_the_answer_is_elsewhere(workspace: Workspace) -> None:
    assert workspace.flight is not None
    untagged = replace(_state(workspace, 5), upload=OwnPicture("mine.jpg", land()[:240, :240]))
    analysis = StateAnalyser(workspace).analyse(untagged, 3)
    cut = analysis.task.gallery[analysis.matches[0].index].cut
    assert isinstance(cut, WindowCut)
    for north, elsewhere in ((1.0, False), (400.0, True)):
        place = (cut.window.x, cut.window.y + north)
        latitude, longitude = workspace.flight.basemap.frame.degrees([place])[0].tolist()
        picture = OwnPicture("mine.jpg", land()[:240, :240], (latitude, longitude))
        analysis = StateAnalyser(workspace).analyse(replace(_state(workspace, 5), upload=picture), 3)
        _, headline, sentence = answer_text.plain_verdict(analysis, workspace)
        off = float(analysis.errors_m[analysis.matches[0].index])  # type: ignore[index]
        assert f"Its GPS tag lies {off:.0f} m from the middle of this one" in sentence
        assert (headline == "Elsewhere by its GPS tag") == elsewhere
        assert ("the size of the piece and the errors of tags allow " in sentence) == elsewhere
        assert (answer_text.verdict(analysis, workspace)[1] == "Elsewhere by its GPS tag") == elsewhere


def test_a_comparison_goes_on_behind_other_pictures_until_the_browser_leaves(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed: list[tuple[int, int]] = []
    steps, tried = threading.Semaphore(0), threading.Semaphore(0)

    def register(*arguments: Any) -> str:
        photo: UInt8Array = arguments[2]
        for done in range(3):
            computed.append((len(photo), done))
            tried.release()
            while not steps.acquire(timeout=0.02):
                arguments[5](done, 3)
            arguments[5](done + 1, 3)
        return "placed"

    def go_on(tries: int) -> None:
        for _ in range(tries):
            assert tried.acquire(timeout=60)
            steps.release()

    monkeypatch.setattr(own_photos, "register_own_photo", register)
    jobs = OwnPhotoJobs(workspace.own_photos.basemap)  # type: ignore[union-attr]
    progress, of_page = OwnPhotoProgress(jobs, lambda: None), OwnPhotoComparisons()
    other = of_page.of(jobs, lambda: None)
    assert of_page.of(jobs, lambda: None) is other, "a page that comes back to a place has its comparisons again"
    assert of_page.of(None, lambda: None) is not other
    first, second = (OwnPicture("mine.jpg", land()[:side], key=f"{side}") for side in (10, 20))
    of_first = progress.follow(first)
    go_on(1)
    of_second = progress.follow(second)
    while not jobs._turns._waiting:
        threading.Event().wait(0.01)
    go_on(4)  # the picture that is shown comes first, as soon as a try has ended
    assert of_first is not None
    assert of_second is not None
    assert of_second.wait(60)
    assert [done for side, done in computed if side == 20] == [0, 1, 2]
    assert progress.follow(replace(first, picture=land()[1:11])) is of_first, "its key tells that it is the same"
    assert of_first.done >= 1
    go_on(1)
    assert of_first.wait(60)
    assert computed.count((10, 0)) == 1
    assert computed.index((20, 2)) < computed.index((10, 2))
    left = other.follow(OwnPicture("other.jpg", land()[:30]))
    assert left is not None
    assert tried.acquire(timeout=60)
    assert other.follow(None) is None
    of_page.forget()
    assert left.wait(60)
    assert left.cancelled
    assert answer_text.comparing(left) == ""


def test_an_error_of_the_comparison_is_a_sentence(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise DataError("The sheet is damaged.")

    monkeypatch.setattr(own_photos, "register_own_photo", fail)
    progress = OwnPhotoProgress(OwnPhotoJobs(workspace.own_photos.basemap), lambda: None)  # type: ignore[union-attr]
    job = progress.follow(OwnPicture("mine.jpg", land()))
    assert job is not None
    assert job.wait(60)
    assert answer_text.comparing(job) == "Its details could not be compared with the map: The sheet is damaged."
