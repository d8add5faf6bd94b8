"""Plain, calibrated, and CSLS: what the explorer ranks, explains, and links to under each, and what `lpn evaluate` says."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest

import lpn
from explorer import reports
from explorer.compute import scorings
from explorer.compute.ranking_job import RankingJob
from explorer.compute.ranking_progress import RankingProgress
from explorer.explain_window import evidence
from explorer.failure_lab import table
from explorer.failure_lab.service import FailureLab
from explorer.failure_lab.state import LabState
from explorer.opening import open_model
from explorer.panels import answer_text, pages, shortcuts
from explorer.panels.stage_controls import part_bars
from explorer.session_state import SessionState
from explorer.url_state import UrlState
from explorer.workspace import LazyWorkspace, StateAnalyser, Workspace
from lpn.core import images
from lpn.core.demo import DEMO, DEMO_MODEL
from lpn.core.progress import listening, report_progress
from lpn.datasets import Picture, labels_of, open_dataset
from lpn.drawing import verdicts
from lpn.library.analyser import OwnPicture
from lpn.retrieval.csls import NEIGHBOURS
from lpn.tasks import opening
from lpn.tasks.opening import new_calibration
from lpn.tasks.task import SCORINGS, Scoring
from tests.conftest import MakeOnce
from tools.fixtures import small_worlds
from tools.fixtures.waiting import wait_until

TASK = "drone-to-satellite"
PATIENCE = 120.0


@pytest.fixture(scope="module")
def wide(make_once: MakeOnce) -> Path:
    """Places whose drone pictures show more ground than their tiles."""

    return make_once("scored-places", lambda folder: write_places(folder / "places", 22)) / "places"


def write_places(root: Path, count: int) -> None:
    """Write a test split whose queries and gallery hold different pictures of the same places."""
    for i in range(count):
        ground = images.resize(small_worlds.place(300 + i), 192, 192)
        pictures = {
            "query_drone": images.zoom(ground, 1.3 if i % 3 else 1.1),
            "gallery_satellite": images.zoom(ground, 2),
        }
        for folder, picture in pictures.items():
            small_worlds.write(root / "test" / folder / f"{i:04d}/{i:04d}.png", images.resize(picture, 96, 96))


@pytest.fixture(scope="module")
def workspace(wide: Path, model_file: Path) -> Workspace:
    return open_model(wide, model_file, calibrate=True)


def state_of(workspace: Workspace, scoring: Scoring, **fields: object) -> SessionState:
    return replace(SessionState(TASK, workspace.contract.n_parts, scoring=scoring), **fields)


@pytest.mark.parametrize("scoring", SCORINGS)
def test_figures_are_those_of_evaluate(workspace: Workspace, wide: Path, model_file: Path, scoring: Scoring) -> None:
    csls = NEIGHBOURS if scoring == "csls" else 0
    measured = lpn.evaluate(model_file, wide, TASK, calibrate=scoring != "plain", csls=csls)
    ranking = workspace.rankings[state_of(workspace, scoring).ranking_key]
    assert ranking.result is not None
    assert {f"recall@{k}": value for k, value in measured.recall.items()}.items() <= ranking.results.items()
    assert ranking.results["ap"] == pytest.approx(measured.ap)
    assert ranking.task.evaluate().recall == measured.recall


@pytest.mark.parametrize("scoring", SCORINGS)
@pytest.mark.parametrize("weights", [(1.0, 1.0, 1.0, 1.0), (0.5, 2.0, 0.0, 1.0)])
def test_contributions_and_evidence_add_up_to_what_is_ranked(
    workspace: Workspace, scoring: Scoring, weights: tuple[float, ...]
) -> None:
    for query in range(5):
        state = state_of(workspace, scoring, query=query, why=True, weights=weights)
        analysis = StateAnalyser(workspace).analyse(state, 6)
        assert analysis.pair_evidence is not None
        evidence, chosen = analysis.pair_evidence.evidence, analysis.chosen
        for match in analysis.matches:
            assert match.contributions.sum() == pytest.approx(match.distance2, abs=1e-5)
            own = float(match.cosines @ analysis.ranking.weights)
            assert own - sum(match.constants or ()) == pytest.approx(match.score, abs=1e-5)
        assert [match.score for match in analysis.matches] == sorted(
            (float(score) for score in analysis.ranking.scores), reverse=True
        )[:6]
        assert evidence.score == pytest.approx(chosen.score, abs=1e-5)
        assert evidence.contributions == pytest.approx(chosen.contributions, abs=1e-5)
        shares = evidence.query.score_map(evidence.weights).sum() + evidence.query.constants @ evidence.weights
        assert shares + sum(evidence.csls_shares) == pytest.approx(chosen.score, abs=1e-5)
        assert (chosen.constants is not None) == (scoring == "csls")


@pytest.mark.parametrize("scoring", SCORINGS)
def test_a_search_the_whole_ranking_the_laboratory_and_the_report_agree(workspace: Workspace, scoring: Scoring) -> None:
    key = state_of(workspace, scoring).ranking_key
    job = workspace.rankings[key]
    lab = FailureLab(workspace)
    assert lab.build(key, lab).wait(PATIENCE)
    findings = lab.findings(key)
    assert findings is not None
    for query in range(len(job.task.queries)):
        analysis = StateAnalyser(workspace).analyse(state_of(workspace, scoring, query=query), 3)
        assert analysis.positive is not None
        assert analysis.positive.rank == findings.table.columns["rank"].values[query]
        negative = analysis.ranking.hardest_negative()
        assert negative is not None
        margin = float(findings.outcomes.margin[query])
        assert negative.distance2 - analysis.positive.distance2 == pytest.approx(margin, abs=1e-5)
    _, page = reports.of_selection(workspace, job.task, [0], "one query")
    assert f"{job.results['recall@1']:.1f}" in page.decode()
    assert ("(CSLS)" in page.decode()) == (scoring == "csls")


def test_figures_of_evidence_and_of_a_lead_add_up_as_they_are_shown(workspace: Workspace) -> None:
    analyser, number = StateAnalyser(workspace), r"[+−]?\d\.\d{3}"

    def figures(text: str) -> list[float]:
        return [float(found.replace("−", "-")) for found in re.findall(number, text)]

    for query in range(22):
        analysis = analyser.analyse(state_of(workspace, "csls", query=query, why=True), 5)
        html = evidence.page(analysis, workspace)
        pair = analysis.pair_evidence
        assert pair is not None
        *_, total, taken = figures(
            verdicts.describe_evidence(pair.evidence, workspace.part_names, "drone", "satellite")
        )
        table = [
            figures(row)[-1] for row in re.findall("<tr.*?</tr>", html.partition('class="num sums"')[2], re.DOTALL)[1:8]
        ]
        shares, csls, score = table[:4], table[4:6], table[6]
        assert round(sum(shares), 3) == total
        assert round(-sum(csls), 3) == taken
        assert round(total - taken, 3) == score
        bars, lead, _ = part_bars(analysis, workspace.part_names)
        assert lead is not None
        first, other = (
            next(match for match in analyser.analyse(analysis.state, 22).matches if match.index == index)
            for index in (analysis.matches[0].index, lead.index)
        )
        shown = round(round(other.distance2, 3) - round(first.distance2, 3), 3)
        assert lead.shown == (shown if lead.of_answer else -shown)
        assert round(sum(figures(" ".join(bar.lead[0] for bar in bars if bar.lead))), 3) == lead.shown
        _, _, sentence = answer_text.verdict(analysis, workspace)
        assert figures(sentence)[0] == abs(lead.shown)


def test_csls_alters_ranks_and_keeps_the_query_term_out_of_them(workspace: Workspace) -> None:
    analyses = [
        StateAnalyser(workspace).analyse(state_of(workspace, one, query=1), 3) for one in ("calibrated", "csls")
    ]
    calibrated, csls = analyses
    assert np.array_equal(calibrated.ranking.cosines, csls.ranking.cosines)
    terms = csls.ranking.csls
    assert terms is not None
    order = np.argsort(-((csls.ranking.cosines - terms.tiles) @ csls.ranking.weights), kind="stable")
    assert np.array_equal(order, csls.ranking.order)
    assert not np.array_equal(calibrated.ranking.scores, csls.ranking.scores)


def test_a_region_is_searched_without_constants(workspace: Workspace) -> None:
    some = state_of(workspace, "csls", region=tuple(range(8)))
    by_csls, calibrated = (
        StateAnalyser(workspace).analyse(replace(some, scoring=one), 3) for one in ("csls", "calibrated")
    )
    assert by_csls.ranking.csls is None
    assert np.array_equal(by_csls.ranking.scores, calibrated.ranking.scores)


def test_an_own_picture_is_described_as_the_task_is_calibrated(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    own = OwnPicture("mine", task.queries[3].load())
    for scoring in SCORINGS:
        listed = StateAnalyser(workspace).analyse(state_of(workspace, scoring, query=3), 3)
        mine = StateAnalyser(workspace).analyse(state_of(workspace, scoring, upload=own), 3)
        assert mine.zoom == pytest.approx(listed.zoom)
        assert mine.ranking.scores == pytest.approx(listed.ranking.scores, abs=1e-5)


def test_links_bring_the_scoring_back_and_one_without_it_is_plain(workspace: Workspace) -> None:
    links, start = UrlState(workspace), state_of(workspace, "plain")
    for scoring in SCORINGS:
        state = state_of(workspace, scoring, query=2)
        address = links.write(state)
        assert ("scoring" in address) == (scoring != "plain")
        assert links.read(address, start) == (state, [])
    kept, problems = links.read("scoring=best", start)
    assert kept == start
    assert problems == ["scoring=best: it is ranked plain or calibrated or csls here."]


def is_query(pictures: Sequence[Picture]) -> bool:
    return pictures[0].path.parents[1].name.startswith("query")


@pytest.mark.parametrize(
    ("calibrate", "csls", "expected"),
    [(None, 0, "plain"), (False, 0, "plain"), (True, 0, "calibrated"), (True, 5, "csls"), (None, 5, "csls")],
)
def test_labels_never_choose_the_scoring_that_opens(
    calibrate: bool | None, csls: int, expected: str, wide: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recalls = []
    for order in (slice(None), slice(None, None, -1), np.random.default_rng(3).permutation(22)):
        # The labels of the queries alone are in another order, so that other scorings are the best by them.
        with monkeypatch.context() as patch:
            patch.setattr(
                opening, "labels_of", lambda of, order=order: labels_of(of)[order if is_query(of) else slice(None)]
            )
            opened = open_model(wide, model_file, calibrate=calibrate, csls=csls)
        assert opened.default_scoring(TASK) == expected
        shown = opened.rankings[state_of(opened, opened.default_scoring(TASK)).ranking_key]
        assert (shown.task.neighbours, shown.task.calibration is not None) == (csls, calibrate is True)
        recalls.append(shown.results["recall@1"])
    assert len(set(recalls)) > 1, "other labels, other figures"


@pytest.mark.parametrize(("calibrate", "expected"), [(None, "calibrated"), (False, "plain")])
def test_the_demo_opens_by_the_calibration_that_ships_whatever_the_labels(
    calibrate: bool | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = open_model(DEMO, DEMO_MODEL, calibrate=calibrate)
    assert opened.default_scoring(TASK) == expected
    recalls = {one.scoring: round(one.recall or 0, 1) for one in scorings.choices(opened.rankings, TASK)}
    assert recalls == {"plain": 70.1, "calibrated": 84.7, "csls": 87.0}
    monkeypatch.setattr(opening, "labels_of", lambda of: labels_of(of)[:: -1 if is_query(of) else 1])
    reversed_labels = open_model(DEMO, DEMO_MODEL, calibrate=calibrate)
    assert reversed_labels.default_scoring(TASK) == expected
    assert [one.ready for one in scorings.choices(reversed_labels.rankings, TASK)] == [True] * 3


def test_the_switch_names_what_each_scoring_brings(workspace: Workspace) -> None:
    offered = scorings.choices(workspace.rankings, TASK)
    assert [(one.scoring, one.ready) for one in offered] == [(one, True) for one in SCORINGS]
    recalls = {one.scoring: one.recall or 0 for one in offered}
    for scoring in SCORINGS:
        header = pages.header(workspace, workspace.rankings[state_of(workspace, scoring).ranking_key].task)
        assert all(f"{recall:.1f} %" in header for recall in recalls.values())
        assert header.count('<a class="chosen" ') >= 1
        _, folded = header.split("<details", 1)
        in_sight = folded.split("</details>")[1]
        assert all(f"{recall:.1f} %" in in_sight for recall in recalls.values()), "before anything is pressed"


def test_the_switch_waits_for_the_scorings_that_are_not_shown(workspace: Workspace) -> None:
    shown = workspace.rankings[state_of(workspace, "calibrated").ranking_key]
    rankings = workspace.scored_rankings(shown.task)
    assert rankings[0] is shown
    assert {one.task.scoring for one in rankings} == set(SCORINGS)
    main, *others = jobs = [RankingJob(one.task) for one in rankings]  # none of them is ranked yet
    told, drawn = list[tuple[RankingJob, int]](), list[str]()

    def tell(ranking: RankingJob) -> None:
        told.append((ranking, sum(job.result is not None for job in jobs)))

    progress = RankingProgress(tell, lambda: drawn.append("the page is shown anew"))
    progress.follow(main, figures=others)
    wait_until(lambda: (main, 3) in told)
    assert {ranking for ranking, _ in told} == {main}, "the results are those that are shown"
    progress.follow(main, figures=others)
    assert len(drawn) == 1, "the figures of the others stand in its results alone"


def test_the_palette_has_the_scorings_of_a_workspace_that_offers_them(workspace: Workspace) -> None:
    gui, panels, shown = Mock(), MagicMock(), list[Scoring]()

    def labels() -> dict[str, Mock]:
        commands: dict[str, Mock] = {}
        gui.add_command.side_effect = lambda label, **_: commands.setdefault(label, Mock())
        shortcuts.add(gui, workspace, panels, Mock(), Mock(), [], shown.append)
        return {label: one for label, one in commands.items() if label.startswith("Ranking: ")}

    found = labels()
    assert list(found) == ["Ranking: plain", "Ranking: calibrated", "Ranking: by CSLS"]
    for command in found.values():
        command.on_trigger.call_args.args[0](None)
    assert shown == list(SCORINGS)
    offered, workspace.scorings = workspace.scorings, scorings.Scorings("It is ranked as it is.")
    try:
        assert labels() == {}
    finally:
        workspace.scorings = offered


def test_a_second_model_is_calibrated_like_the_first_when_that_is_asked_for(
    workspace: Workspace, wide: Path, one_part_model_file: Path
) -> None:
    second = LazyWorkspace("the other", lambda: open_model(wide, one_part_model_file))
    workspace.beside = [second]
    try:
        assert second.open().wait(PATIENCE)
        lab, key = FailureLab(workspace), state_of(workspace, "calibrated").ranking_key
        assert lab.build(key, lab).wait(PATIENCE)
        wait_until(lambda: lab.join_second(key, lab).text == "")
        plain = lab.findings(key)
        assert plain is not None
        assert plain.second is not None
        assert (plain.second.scorings, plain.second.preparable) == (("calibrated", "plain"), True)
        for preparing in (False, True):  # what was pressed is not offered again
            shown = table.summary(plain, LabState(task=key), plain.table.rows(), preparing=preparing)
            assert ("lab-second-scoring" in shown) != preparing
        # A failure is told, and the other ranks stay.
        assert second.workspace is not None
        failed = Mock(error="The disk is full.", cancelled=False, wait=lambda _: True)
        lab._scoring[0] = failed
        told = lab.join_second(key, lab)
        assert (told.text, told.pending) == (
            f"rank B: {second.workspace.model_name} is not calibrated. The disk is full.",
            False,
        )
        assert not lab.scores_second()
        assert lab.findings(key) is not None
        lab.score_second(lab)
        wait_until(lambda: lab.join_second(key, lab).text == "" and not lab.scores_second())
        both = lab.findings(key)
        assert both is not None
        assert both.second is not None
        assert both.second.scorings == ("calibrated", "calibrated")
        assert both.second.alike
        assert "lab-second-scoring" not in table.summary(both, LabState(task=key), both.table.rows())
        assert second.workspace is not None
        ranked = second.workspace.rankings[key].result
        assert ranked is not None
        assert both.table.columns["rank B"].values.tolist() == (ranked.ranking.first + 1).tolist()
    finally:
        workspace.beside = []


def test_a_preparation_counts_its_pictures_and_ends_when_nobody_waits(
    tmp_path: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_places(tmp_path / "places", 22)
    counts: list[tuple[int, int]] = []
    with listening(lambda _, *count: counts.append(count)):
        new_calibration(lpn.load(model_file), open_dataset(tmp_path / "places"))
    assert counts[-1] == (22, 22)

    def endless(*_: object) -> None:
        while True:
            report_progress("Describing", 3, 22)

    monkeypatch.setattr("explorer.opening.new_calibration", endless)
    opened, client = open_model(tmp_path / "places", model_file), object()
    job = opened.scorings.prepare(client)
    assert job is not None
    while not job.total:
        job.wait(0.01)
    page = pages.header(opened, opened.tasks[TASK], job)
    assert "3 of 22<progress " in page
    assert 'value="3" max="22"' in page
    assert "scoring-stop" in page
    job.leave(client)
    assert job.wait(PATIENCE)
    assert job.cancelled
    assert "scoring-stop" not in pages.header(opened, opened.tasks[TASK])


def test_two_constants_are_named_beside_the_parts(workspace: Workspace) -> None:
    analysis = StateAnalyser(workspace).analyse(state_of(workspace, "csls", why=True), 3)
    table = pages.parts_table(analysis, workspace)
    assert "half the query&#39;s mean" in table or "half the query's mean" in table
    plain = StateAnalyser(workspace).analyse(state_of(workspace, "calibrated", why=True), 3)
    assert "CSLS" not in pages.parts_table(plain, workspace)


def test_few_pictures_are_ranked_plainly_and_the_page_says_why(tmp_path: Path, model_file: Path) -> None:
    write_places(tmp_path / "few", 5)
    opened = open_model(tmp_path / "few", model_file)
    assert opened.default_scoring(TASK) == "plain"
    assert opened.scorings.why_not.startswith(
        "A calibration takes 20 pictures of each view or more, and there are 5 drone"
    )
    assert opened.scorings.prepare(opened) is None
    page = pages.header(opened, opened.tasks[TASK])
    assert opened.scorings.why_not in page
    assert "lpn-scorings" not in page.replace("lpn-no-scorings", "")
    state = opened.supported_state(SessionState(TASK, 4, scoring="csls"))
    assert state.scoring == "plain"
