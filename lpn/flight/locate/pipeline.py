"""The three stages over a whole flight: retrieval, sequence, registration; resumable, and robust to unreadable frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from lpn.core.errors import DataError, InputError
from lpn.core.numbers import error_figure
from lpn.flight.files import Flight
from lpn.flight.locate.audit import audit_tags, corrected_tags
from lpn.flight.locate.corrections import Correction
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, tag_positions
from lpn.flight.locate.map_evidence import MapEvidence, judge_map
from lpn.flight.locate.options import TOP, LocateOptions
from lpn.flight.locate.ranked_stages import OVERLAP, enter_retrieval, enter_sequence, places_beyond
from lpn.flight.locate.registered_stage import register_frames
from lpn.flight.locate.registration import is_turned_over
from lpn.flight.locate.retrieval import retrieve
from lpn.flight.locate.shipped import ShippedAnswers
from lpn.flight.locate.tags import enter_corrections, tags_on_map
from lpn.flight.locate.turns import refuse_turned
from lpn.flight.maps import Map
from lpn.models.base import Model

# Seconds from one partial result of a registration to the next.
_PARTIAL_INTERVAL = 3.0
# Neighbours of a photo that can confirm it on the map, if details place them within three quarters of a window's side. A single
# photo from beyond the edge may fit an equal building.
_NEIGHBOURS = (-2, -1, 1, 2)


def locate(
    basemap: Map,
    flight: Flight,
    model: Model | None = None,
    options: LocateOptions | None = None,
    corrections: Mapping[str, Correction] | None = None,
    index: str | None = None,
    shipped: Path | None = None,
) -> LocatedFlight:
    """Locate the frames of a flight.

    Registered frames are stored in the user's cache, so a killed run resumes.

    Args:
        model: for the retrieval; without one, registration searches the whole map, or around the tags with a prior.
        corrections: of a person, by the frame's name. They change no stage's answer, but are the truth of errors and audit, and
            replace registrations in the track.
        index: an index of the map's windows by the model, see `retrieve`; without it, windows are described.
        shipped: a folder of answers that ship with the flight, used if they fit, see `lpn.flight.locate.shipped`.

    Raises:
        InputError: if no stage runs, a prior comes with a model, or the model lacks a view.
        DataError: if the flight has no frame.
    """
    options = options or LocateOptions()
    if not flight.frames:
        raise DataError(f"The flight {flight.name} has no photo; give one with photos.")
    if model is not None and options.prior is not None:
        raise InputError(
            "With a model, registration searches where the model finds it, not around the GPS tag; leave --prior or --model out."
        )
    if model is None and not options.register:
        raise InputError(
            "There is nothing to do without a model and without registration; give --model, or allow --register."
        )
    tags, notes, tags_away = tags_on_map(basemap, flight)
    frames = [
        LocatedFrame(frame, None if np.isnan(tag).any() else tag)
        for frame, tag in zip(flight.frames, tags, strict=True)
    ]
    notes += enter_corrections(basemap, frames, corrections or {})
    if options.prior is not None:
        notes.append(
            f"Registration searched around the GPS tags only (prior {options.prior:g} m), so errors against them say less than "
            "those of a search without a prior."
        )
    retrieval, answers = None, None
    if model is not None:
        if shipped is not None:
            answers = ShippedAnswers.open(shipped, model, basemap, flight)
        retrieval = retrieve(model, basemap, flight, options.sizes, options.overlap, index=index, shipped=answers)
        notes += retrieval.notes
        if retrieval.broken:
            notes.append(
                f"{len(retrieval.broken)} of {len(frames)} photos cannot be read; the retrieval's measures count them as misses, "
                "and Dis@K leaves them out."
            )
        enter_retrieval(retrieval, frames, TOP)
        if options.sequence and answers is not None and len(answers.record.sequence) == len(frames):
            for frame in frames:
                frame.stages["sequence"] = answers.record.sequence[frame.frame.name]
        elif options.sequence:
            enter_sequence(retrieval, flight, frames, places_beyond(basemap, retrieval.gallery))
    registrations = {} if answers is None else answers.record.registration
    located = LocatedFlight(
        flight, basemap, frames, None, notes, retrieval, registrations, tags_away=tags_away, prior=options.prior
    )
    return registered(located, model, options) if options.register else located


def registered(
    located: LocatedFlight,
    model: Model | None,
    options: LocateOptions | None = None,
    on_partial: Callable[[LocatedFlight], None] | None = None,
) -> LocatedFlight:
    """Register the frames of a flight whose other stages are done, and audit its tags; `located` is not changed.

    Args:
        model, options: the same as in `locate`, so that the cache has its answers.
        on_partial: called every few seconds with the flight registered so far, whose tags are not yet audited.
    """
    options = replace(options or LocateOptions(), register=True)
    map_error = located.basemap.total_error(options.map_error)
    place_error = located.basemap.place_error(options.map_error)
    frames = [replace(frame, stages=dict(frame.stages)) for frame in located.frames]
    published = time.monotonic()

    def publish(done: int, total: int) -> None:
        nonlocal published
        if on_partial is not None and done < total and time.monotonic() - published >= _PARTIAL_INTERVAL:
            copies = [replace(frame, stages=dict(frame.stages)) for frame in frames]
            refuse_turned(copies[:done])
            on_partial(replace(located, frames=copies))
            published = time.monotonic()

    notes = register_frames(
        located.basemap, located.flight, frames, options, model, located.retrieval, publish, located.shipped
    )
    side = None if located.retrieval is None else located.retrieval.gallery.side
    if not located.shipped:  # a shipped sequence has used these frames
        _know_frames_on_map(located, frames)
    notes += judge_map(frames, MapEvidence(located.basemap.bounds, options.prior, side))
    answers = [frame.by_hand or frame.stages["registration"] for frame in frames]
    places = np.array(
        [(a.x, a.y) if a.accepted and a.x is not None else (np.nan, np.nan) for a in answers], np.float64
    ).reshape(-1, 2)
    tags = tag_positions(frames)
    audit = audit_tags(located.flight.times, tags, places, any(a.accepted and not a.camera for a in answers))
    if any(answer.accepted and answer.radius is not None for answer in answers):
        source = f", {place_error:.1f} m by the GPS tags that place it" if place_error else ""
        if place_error == located.basemap.surveyed_error:
            source = ", as it was surveyed"
        notes.append(
            f"Radii of registrations include {error_figure(map_error)} m for the error of the map itself{source}."
        )
    moved = corrected_tags(located.flight.times, tags, audit.lag) if audit.has_lag else None
    return replace(
        located,
        frames=frames,
        audit=audit,
        notes=[*located.notes, *notes, *_turn_notes(frames)],
        tags_without_lag=moved,
        map_error=map_error,
        place_error=place_error,
    )


def _know_frames_on_map(located: LocatedFlight, frames: list[LocatedFrame]) -> None:
    """Repeat the sequence if it refuses frames, with frames that details or a person place on the map."""
    if located.retrieval is None:
        return
    near = OVERLAP * located.retrieval.gallery.side
    refused = any("sequence" in one.stages and not one.stages["sequence"].accepted for one in frames)
    answers = [one.stages["registration"] for one in frames]
    placed = {i: np.array([one.x, one.y]) for i, one in enumerate(answers) if one.accepted and one.x is not None}
    on_map = {i for i, one in enumerate(frames) if one.by_hand is not None}
    on_map |= {i for i in placed for j in _NEIGHBOURS if i + j in placed and answers[i].distance(placed[i + j]) <= near}
    if refused and on_map:
        beyond = places_beyond(located.basemap, located.retrieval.gallery)
        enter_sequence(located.retrieval, located.flight, frames, beyond, on_map)


def _turn_notes(frames: list[LocatedFrame]) -> Iterator[str]:
    """Yield a sentence about pictures that are turned against their heading."""
    turned = [
        located.frame.name
        for located in frames
        if (answer := located.stages["registration"]).accepted and is_turned_over(answer.turn)
    ]
    if turned:
        one = len(turned) == 1
        yield (
            f"{len(turned)} photo{' is' if one else 's are'} turned by about 180 degrees against "
            f"{'its' if one else 'their'} heading: {', '.join(turned)}."
        )
