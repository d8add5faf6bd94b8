from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from random import Random
from urllib.parse import parse_qs

import numpy as np
import pytest

from explorer import session_state, url_state
from explorer.compute.ranking_job import RankingJob
from explorer.lab_choices import LabChoices, Selection
from explorer.opening import open_model
from explorer.session_state import POSITIVE, SessionState
from explorer.url_state import UrlState
from explorer.workspace import Workspace
from lpn.descriptors.weather import WEATHERS
from lpn.library.analyser import OwnPicture


@pytest.fixture(scope="module")
def workspace(data: Path, model_file: Path) -> Workspace:
    return open_model(data, model_file)


@pytest.fixture(scope="module")
def links(workspace: Workspace) -> UrlState:
    return UrlState(workspace)


def any_state(workspace: Workspace, rng: Random) -> SessionState:
    task = workspace.tasks[rng.choice(list(workspace.tasks))]
    rows, columns = workspace.map_sizes[task.query_view]
    count = rows * columns
    chance = [True, False]
    lab = rng.choice(chance)
    return SessionState(
        task.name,
        4,
        query=rng.randrange(len(task.queries)),
        angle=rng.choice([0.0, float(rng.randint(-180, 180))]),
        weather=rng.choice(WEATHERS),
        weather_strength=rng.choice([1.0, 0.35]),
        weights=tuple(rng.choice([1.0, round(0.05 * rng.randrange(41), 2)]) for _ in range(4)),
        enabled=tuple(rng.choice(chance) for _ in range(4)),
        selected=rng.choice([None, "truth", rng.randrange(len(task.gallery))]),  # type: ignore[arg-type]
        shift=rng.randint(-32, 32),
        down=rng.randint(-32, 32),
        zoom=round(rng.uniform(0.25, 4), 2),
        region=tuple(sorted(rng.sample(range(count), rng.randrange(count)))),
        why=(why := rng.choice(chance)),
        why_tab=rng.choice(["evidence", "comparison", "sweep"]) if why else "evidence",
        lab=lab,
        laboratory=any_choices(rng, len(task.queries)) if lab else LabChoices(),
        heat=rng.choice(chance),
        heat_kind=rng.choice(["activation", "evidence"]),
        heat_part=rng.choice([None, 0, 3]),
        same_scale=rng.choice(chance),
        heat_over=rng.choice(chance),
        opacity=round(rng.random(), 2),
        rings=rng.choice(chance),
        exploded=rng.choice(chance),
        map=rng.choice(chance),
        city=rng.choice(chance),
        dark=rng.choice(chance),
        first_screen=(first := rng.choice(chance)),
        start_plain=not first,  # as the first screen speaks
        fails=first and rng.choice(chance),
    )


def any_choices(rng: Random, queries: int) -> LabChoices:
    chosen = [tuple(sorted(rng.sample(range(queries), rng.randrange(queries)))) for _ in range(rng.randrange(3))]
    return LabChoices(
        tab=rng.choice(["table", "breakdown", "maps"]),
        outcome=rng.choice(["all", "failed", "found", "only A", "only B"]),
        filter=rng.choice(["", 'rank > 1 and weather = "a & b = c"']),
        name_search=rng.choice(["", "0,0~1%20"]),
        selections=tuple(Selection(f"kind {i}", "ring; 1-2, ≤ 3 m", rows) for i, rows in enumerate(chosen)),
        sort_column=rng.choice(["margin", "-odd name"]),
        descending=rng.choice([True, False]),
        columns=rng.choice([None, (), ("district", "a b")]),
        full_height=rng.choice([None, True, False]),
        both_maps=rng.choice([True, False]),
        map=rng.choice(["pca", "umap", "ground"]),
        colour=rng.choice(["", "distance"]),
    )


def start(workspace: Workspace) -> SessionState:
    return SessionState(next(iter(workspace.tasks)), 4)


def test_what_is_written_is_read_back(workspace: Workspace, links: UrlState) -> None:
    rng = Random(0)
    for _ in range(300):
        state = any_state(workspace, rng)
        written = links.write(state)
        assert links.read("?" + written, start(workspace)) == (state, [])
        assert set(parse_qs(written)) <= set(links.keys)


def test_pictures_are_called_by_name_and_what_is_usual_is_not_said(workspace: Workspace, links: UrlState) -> None:
    state = SessionState("drone-to-satellite", 4, query=3, selected=2)
    names = [entry.name for entry in workspace.tasks["drone-to-satellite"].queries]
    tile = workspace.tasks["drone-to-satellite"].gallery[2].name
    assert links.write(state) == f"task=drone-to-satellite&query={names[3]}&with={tile}"
    assert links.write(replace(state, selected=POSITIVE)).endswith("with=truth")


def test_names_that_are_shared_or_mean_something_else_are_called_by_position(workspace: Workspace) -> None:
    task = workspace.tasks["drone-to-satellite"]
    names = ["own", "twin", "twin", "~2", "a&b=c#d%20e", "häuser", "bad\udcff"]
    queries = [replace(task.queries[0], name=name) for name in names]
    ranking = RankingJob(replace(task, queries=queries))
    fake = Workspace("m", "d", [ranking], workspace.contract, workspace.map_sizes, None, None, workspace.root)
    own = UrlState(fake)
    state = SessionState(task.name, 4)
    for query in range(len(names)):
        written = own.write(replace(state, query=query))
        assert own.read(written, state)[0].query == query
    assert own.read("query=twin", state)[0].query == 1
    assert "query=~2" in own.write(replace(state, query=2))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("task=nonsense", "offers drone-to-satellite"),
        ("query=../../etc/passwd", "no such query"),
        ("query=~99999", "no such query"),
        ("with=<script>", "no such tile"),
        ("angle=nan", "-180 to 180"),
        ("angle=1e9", "-180 to 180"),
        ("angle=", "-180 to 180"),
        ("weather=hail", "expected normal or fog or"),
        ("weather_strength=2", "0 to 1"),
        ("shift=-33", "-32 to 32"),
        ("zoom=0", "0.25 to 4"),
        ("weights=1,1,1", "expected 4 weights"),
        ("weights=1,1,1,9", "0 to 2"),
        ("off=0", "1 to 4"),
        ("off=5", "1 to 4"),
        ("region=9-2", "cells 0 to"),
        ("region=0-9999999", "cells 0 to"),
        ("region=-1", "cells 0 to"),
        ("map=yes", "0 or 1"),
        ("flight=yes", "0, 1, or map"),
        ("flight=1", "this place has no flight; choose a place that has one"),
        ("flight=map", "this place has no flight; choose a place that has one"),
        ("shows=anything", "activation or evidence"),
        ("part=5", "1 to 4"),
        ("opacity=2", "0 to 1"),
        ("theme=pink", "light or dark"),
        ("tab=everything", "table or breakdown or maps"),
        ("only=some", "all or failed or found or A or B"),
        ("where=" + "x" * 1001, "1,000 letters at most"),
        ("sort=%00", "can be printed"),
        ("columns=" + "x" * 1001, "1,000 letters at most"),
        ("chosen=9-2", "chosen in the table of this data set"),
        ("chosen=a%09b%090-99999", "chosen in the table of this data set"),
        ("chosen=" + "%0A".join(["a%09b%090-1"] * 21), "chosen in the table of this data set"),
        ("chosen=a%09b%09" + "1," * 1500 + "1", "chosen in the table of this data set"),
        ("chosen=a%00%09b%090-1", "labels of 200 letters at most"),
    ],
)
def test_a_wrong_value_is_dropped_alone_and_said(workspace: Workspace, links: UrlState, wrong: str, says: str) -> None:
    read, said = links.read(f"angle=30&{wrong}&rings=0", start(workspace))
    assert len(said) == 1
    assert says in said[0]
    assert wrong.split("=")[0] in said[0]
    expected = replace(start(workspace), angle=30.0, rings=False)
    # A turn of one picture suits no other one.
    assert read == (replace(expected, angle=0.0) if wrong.startswith(("angle", "query=own")) else expected)


def test_a_closed_laboratory_is_not_in_the_link_and_an_open_one_is_shown_as_it_is_at_first(
    workspace: Workspace, links: UrlState
) -> None:
    shown = replace(start(workspace), laboratory=LabChoices("maps", filter="rank > 1"))
    closed = links.write(shown)
    assert "rank" not in closed
    assert links.read(closed, shown)[0] == shown
    opened, _ = links.read("lab=1&only=failed", shown)
    assert opened == replace(shown, lab=True, laboratory=LabChoices(outcome="failed"))


def test_a_link_is_bounded_whatever_is_chosen_in_the_laboratory(workspace: Workspace, links: UrlState) -> None:
    every_other = Selection("in pca", "lasso", tuple(range(0, 100_000, 2)))
    columns = ("x" * 900, "y" * 900)
    choices = LabChoices("maps", selections=(every_other,), filter="ä" * 1001, columns=columns, colour="z" * 300)
    state = replace(start(workspace), lab=True, laboratory=choices)
    assert links.write(state).endswith("lab=1&tab=maps")
    assert len(links.write(replace(state, laboratory=replace(choices, filter="ä" * 1000)))) < 8000


def test_foreign_keys_and_rubbish_are_passed_over(workspace: Workspace, links: UrlState) -> None:
    for text in ("", "?", "websocket=ws://x&utm=1", "&&==&%", "%ff%00=%zz"):
        assert links.read(text, start(workspace)) == (start(workspace), [])
    state, said = links.read("&".join(["a=1"] * 1000), start(workspace))
    assert (state, len(said)) == (start(workspace), 1)


def test_another_task_starts_with_its_own_first_query(workspace: Workspace, links: UrlState) -> None:
    shown = replace(start(workspace), query=5)
    assert links.read("task=satellite-to-drone", shown)[0].query == 0
    assert links.read("angle=9", shown)[0].query == 5


def test_ones_own_picture_is_not_in_the_link(workspace: Workspace, links: UrlState) -> None:
    own = replace(start(workspace), upload=OwnPicture("secret.jpg", np.zeros((2, 2, 3), np.uint8)), angle=5)
    written = links.write(own)
    assert "query=own" in written
    assert "secret" not in written
    assert "own=" not in written.replace("query=own", "")


def test_the_page_that_holds_ones_own_picture_finds_it_by_its_address(workspace: Workspace, links: UrlState) -> None:
    plain = replace(start(workspace), query=3)
    held = OwnPicture("mine.jpg", np.zeros((2, 2, 3), np.uint8), key="1f2e")
    written = links.write(replace(plain, upload=held, angle=5, why=True))
    assert links.read(written, plain, {"1f2e": held}.get) == (replace(plain, upload=held, angle=5, why=True), [])
    lost, problems = links.read(written, plain, {"0000": held}.get)
    assert (lost.upload, lost.query, lost.angle) == (None, 3, 0)
    assert problems == [
        "An own picture is held only by the page that opened it, until that is loaded again or the picture is forgotten. "
        "Open the file again. Here is another picture."
    ]


def test_every_choice_is_in_the_address_or_known_not_to_be(links: UrlState) -> None:
    state = SessionState("drone-to-satellite", 4)
    left_out = {
        "n_parts",
        "upload",
        "find",
        "page",
        "under_flight",
        "from_first_screen",
        "came_from",
        "start_plain",
        "map_alone",
    }
    named = {"query": "query", "selected": "with", "enabled": "off", "exploded": "apart", "heat_kind": "shows"}
    named |= {
        "heat_part": "part",
        "dark": "theme",
        "same_scale": "scale",
        "heat_over": "over",
        "first_screen": "screen",
    }
    named |= {"plain": "words"}
    named |= {"outcome": "only", "filter": "where", "name_search": "find", "sort_column": "sort", "descending": "order"}
    named |= {
        "full_height": "tall",
        "both_maps": "both",
        "map": "map",
        "colour": "by",
        "why_tab": "reason",
        "selections": "chosen",
    }
    fields = (set(vars(state)) | set(vars(LabChoices()))) - left_out - {"laboratory"}
    assert {named.get(field, field) for field in fields} | {"show", "on", "own"} == set(links.keys)


def test_an_address_names_its_workspace_where_there_are_several(data: Path, model_file: Path) -> None:
    workspace = open_model(data, model_file)
    state = SessionState(next(iter(workspace.tasks)), 4)
    for key, shown in (("alone", ""), ("data", ""), ("flight", "flight")):
        workspace.key, workspace.choices = key, {} if key == "alone" else {"flight": "a flight", "data": "pairs"}
        links = UrlState(workspace)
        assert parse_qs(links.write(state)).get("show", [""]) == [shown]
        assert links.read(links.write(state), state) == (state, [])
        others = set(workspace.choices) - {key}
        for name in ("data", "flight", "", "rubbish"):
            assert links.other_workspace(f"?show={name}") == (name if name in others else None)
        for bare in ("", "?", "?theme=dark&words=plain", "?screen=first", "?screen=all"):
            assert links.other_workspace(bare) is None
        assert links.other_workspace("?query=0001") == ("data" if "data" in others else None)
        assert links.workspace_key("?query=0001") == ("data" if workspace.choices else "alone")
        assert links.other_workspace("?" + "&".join("show=flight" for _ in range(300))) is None
        assert links.read("angle=7&find=" + "x" * 20_000, state) == (
            state, ["It has more than 200 parameters or 20,000 characters."],
        )  # fmt: skip
    assert "nothing else to show than flight, data" in links.read("show=rubbish", state)[1][0]
    assert links.names_only_a_workspace("?show=flight&theme=dark")
    assert links.names_only_a_workspace("?show=data&screen=first")
    for text in ("", "theme=dark", "show=flight&query=0001", "&".join("show=flight" for _ in range(300))):
        assert not links.names_only_a_workspace(text)


def test_ranges_are_short_and_exact() -> None:
    assert url_state.ranges([3, 4, 5, 8]) == "3-5,8"
    assert url_state.cells("3-5,8", 9) == (3, 4, 5, 8)
    assert url_state.ranges(range(256)) == "0-255"
    assert session_state.SessionState("t", 1).region == ()


def test_the_tab_of_the_explanation_is_in_the_address(links: UrlState) -> None:
    state = SessionState("drone-to-satellite", 4, why=True, why_tab="comparison")
    assert "reason=comparison" in links.write(state)
    assert links.read(links.write(state), SessionState("drone-to-satellite", 4)) == (state, [])
    for tab, why in (("evidence", True), ("best", True), ("comparison", False)):
        assert "reason" not in links.write(replace(state, why=why, why_tab=tab))
    for wrong in ("best", "", "x"):
        assert len(links.read(f"why=1&reason={wrong}", state)[1]) == 1
