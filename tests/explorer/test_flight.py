"""A flight over a map in the explorer: opening, registration in the background, and frames of unknown place."""

from __future__ import annotations

import gc
import threading
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from explorer import opening
from explorer.compute import own_photos
from explorer.compute.own_photos import CameraPicture, OwnPhotoJobs
from explorer.opening import open_flight_over
from explorer.workspace import Workspace
from lpn.core.arrays import UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.progress import report_progress
from lpn.flight.files import Frame, write_flight
from lpn.flight.locate.located import LocatedFlight, StageRecord
from lpn.flight.locate.matchers import SiftMatcher
from lpn.flight.locate.task import TASK
from lpn.flight.maps import Map
from lpn.flight.maps.named_window import WindowCut
from lpn.library.analyser import OwnPicture
from lpn.sources import ModelOptions
from tests.explorer.conftest import RefusedError, answered
from tests.lpn.flight.locate.scenery import FLOWN_PLACES, ground_to_photo, land, photo_of, small_flight, write_map
from tools.fixtures.photos import exif, photo_bytes
from tools.fixtures.waiting import TIMEOUT, wait_until

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


def _register(located: LocatedFlight, *_: Any, **__: Any) -> LocatedFlight:
    """Refuse all frames, as the registration would enter them."""
    report_progress("Registering frames", len(located.frames), len(located.frames))
    refused = StageRecord("refused", "Only 4 matches agree.", inliers=4)
    frames = [replace(frame, stages=frame.stages | {"registration": refused}) for frame in located.frames]
    return replace(located, frames=frames)


def test_frames_are_the_queries_and_windows_of_the_map_the_gallery(workspace: Workspace) -> None:
    located, task = workspace.flight, workspace.tasks[TASK]
    assert located.stages == ["retrieval", "sequence"]
    assert workspace.registration is None
    assert task.query_names == [frame.frame.name for frame in located.frames]
    assert workspace.first_query == 5
    result = answered(workspace, f"?query={task.query_names[5]}")
    assert result.state.query == 5
    assert result.first.score == pytest.approx(located.frames[5].windows[0].score, abs=1e-5)
    assert workspace.thumbnail_file(task.queries[5]).startswith(b"\xff\xd8")


def test_a_window_that_cannot_be_read_has_a_grey_thumbnail(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(*_: Any) -> None:
        raise DataError("The sheet is damaged.")

    monkeypatch.setattr(Map, "read", damaged)
    task = workspace.tasks[TASK]
    shown = cv2.imdecode(np.frombuffer(workspace.thumbnail_file(task.gallery[3]), np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(shown.astype(int) - 60).max() < 3


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
    assert not job.wait(0)
    may_end.set()
    assert job.wait(60)
    assert (job.done, job.total) == (len(FLOWN_PLACES) + 1,) * 2
    assert workspace.flight is not before
    assert {one.stages["registration"].state for one in workspace.flight.frames} == {"refused"}


def test_frames_of_unknown_place_are_neither_found_nor_failed(workspace: Workspace) -> None:
    task, known = workspace.tasks[TASK], len(FLOWN_PLACES) + 1 - len(UNKNOWN)
    assert workspace.counts(workspace.rankings[TASK])[1] == known
    assert answered(workspace, query=0).message()["headline"]["found"] is None
    assert workspace.graded(workspace.rankings[TASK])[[0, 2, 5]].tolist() == [False, False, True]
    assert all(workspace.thumbnail_file(task.queries[query])[:2] == b"\xff\xd8" for query in (0, 2, 5))
    with pytest.raises(RefusedError, match="is not a picture"):
        answered(workspace, query=2)


def test_a_frame_that_the_flight_lacks_is_refused_after_what_was_noticed(
    files: tuple[Path, Path], model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match="has no query 99"):
        open_flight_over(*files, ModelOptions(model=model_file), query="99.png", register=False)
    told = capsys.readouterr().err
    assert "1 of 21 photos has no GPS tag" in told
    assert "1 of 21 photos cannot be read" in told


def test_an_own_picture_is_compared_with_the_map_once_for_a_page(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_photos, "open_matchers", lambda: [SiftMatcher()])
    jobs, client = OwnPhotoJobs(workspace.own_photos.basemap), object()
    width, size = 70.0, (240, 240)
    frame = Frame("mine.jpg", Path("mine.jpg"), *size, height_above_ground=width / 2, fov=90.0)
    photo = photo_of(land(0), ground_to_photo((10.0, -20.0), 200.0, width, size), size)
    job = jobs.join(CameraPicture("mine.jpg", photo, frame=frame), (), client)
    assert job.wait(TIMEOUT)
    answer = job.value
    assert answer.located.stages["registration"].state == "accepted"
    job = jobs.join(CameraPicture("mine.jpg", photo.copy(), frame=frame), (), client)
    assert job.wait(0), "the page holds its answer"
    jobs.leave(client)
    held = weakref.ref(answer)
    del answer, job
    gc.collect()
    assert held() is None, "nothing of the pictures is left when the page has closed"


def test_the_tag_of_an_own_picture_tells_how_far_off_each_tile_is(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    cut = task.gallery[7].cut
    assert isinstance(cut, WindowCut)
    for north in (0.0, 400.0):
        latitude, longitude = workspace.flight.basemap.frame.degrees([(cut.window.x, cut.window.y + north)])[0].tolist()
        photo = photo_bytes(exif(latitude, longitude))
        error = answered(workspace, own=photo).analysis.errors_m
        assert error[7] == pytest.approx(north, abs=1)


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

    # A job of an earlier test that has not ended yet would take a step.
    wait_until(lambda: not any(one.name == "explorer-job" for one in threading.enumerate()))
    monkeypatch.setattr(own_photos, "register_own_photo", register)
    jobs = OwnPhotoJobs(workspace.own_photos.basemap)
    client, other = object(), object()
    first, second = (OwnPicture("mine.jpg", land()[:side], key=f"{side}") for side in (10, 20))
    of_first = jobs.join(first, (), client)
    go_on(1)
    of_second = jobs.join(second, (), client)
    wait_until(lambda: jobs._turns._waiting)
    go_on(4)  # the picture that is shown comes first, as soon as a try has ended
    assert of_second.wait(TIMEOUT)
    assert [done for side, done in computed if side == 20] == [0, 1, 2]
    assert jobs.join(replace(first, picture=land()[1:11]), (), client) is of_first, "its key tells that it is the same"
    assert of_first.done >= 1
    go_on(1)
    assert of_first.wait(TIMEOUT)
    assert computed.count((10, 0)) == 1
    assert computed.index((20, 2)) < computed.index((10, 2))
    left = jobs.join(OwnPicture("other.jpg", land()[:30]), (), other)
    assert tried.acquire(timeout=60)
    jobs.show_none(other)
    jobs.leave(other)
    assert left.wait(TIMEOUT)
    assert left.cancelled
