"""Verdicts: the claims of every headline are computed anew from descriptors, in double precision."""

from __future__ import annotations

import re
from collections import Counter

import numpy as np
import pytest

from lpn import load, open_dataset, retrieval
from lpn.core.demo import DEMO, DEMO_MODEL
from lpn.core.texts import ordinal
from lpn.datasets import Truth
from lpn.retrieval import Ranking, scoring
from lpn.retrieval.csls import CslsTerms
from lpn.tasks.opening import describe_task, offered_tasks, scored_tasks, shipped_calibration
from lpn.tasks.task import Task
from lpn.tasks.verdict import Verdict, judge

NAMES = ["1 centre", "2", "3", "4 outer"]
# Distances in d² that differ by less may be in any order: float32 scores decide.
EQUAL = 5e-5


def ranked(cosines: object, weights: object = None, true: tuple[int, ...] | None = (0,)) -> Ranking:
    """A ranking of given part cosines (G, n); the truth is not known for `true` None."""
    array = np.array(cosines, np.float32)
    labels = np.ones(len(array), np.int64)
    labels[list(true or ())] = 7
    weights = scoring.part_weights(array.shape[1], weights)
    return retrieval.rank(array, weights, labels, None if true is None else 7)


@pytest.mark.parametrize(
    ("tenths", "weights", "headline", "parts"),
    [
        ([[9, 5, 5, 5], [5] * 4], None, "Ring 1 adds most: 0.200 of the lead of 0.200", (0,)),
        ([[9, 9, 1, 5], [5, 6, 6, 5]], None, "Rings 1 and 2 decide: without either one, a wrong tile wins", (0, 1)),
        ([[5, 5, 5, 9], [4, 4, 8, 6]], None, "Ring 4 decides: without it, a wrong tile wins", (3,)),
        ([[8, 5, 5, 8], [5] * 4], None, "Rings 1 and 4 add most, alike: 0.150 and 0.150 of the lead of 0.300", (0, 3)),
        ([[5] * 4, [5] * 4], None, "Nearly a tie: the nearest wrong tile is 0.001 behind or less", ()),
        ([[9, 1, 1, 1], [4, 9, 9, 9]], (1, 0, 0, 0), "Lead over the nearest wrong tile: 1.000", ()),
    ],
)
def test_a_right_answer(tenths: list[list[int]], weights: object, headline: str, parts: tuple[int, ...]) -> None:
    verdict = judge(ranked(np.array(tenths) / 10, weights), NAMES, "ring")
    assert (verdict.sign, verdict.headline, verdict.parts) == (True, headline, parts)
    assert verdict.sentence.startswith(f"It leads the nearest wrong tile by {verdict.lead:.3f}")
    assert verdict.gains is not None
    assert sum(verdict.figures) == pytest.approx(verdict.lead)


@pytest.mark.parametrize(
    ("truth", "answer", "weights", "headline"),
    [
        ([0.5] * 4, [0.6, 0.6, 0.6, 0.8], None, "All four rings prefer the wrong tile, the outer one most"),
        ([0.5] * 4, [0.9, 0.6, 0.6, 0.8], None, "All four rings prefer the wrong tile, the centre most"),
        ([0.5] * 4, [0.6, 0.8, 0.8, 0.6], None, "All four rings prefer the wrong tile, rings 2 and 3 most"),
        ([0.5] * 4, [0.6] * 4, None, "All four rings prefer the wrong tile, all alike"),
        (
            [0.5] * 4,
            [0.6, 0.1, 0.7, 0.7],
            (1, 0, 1, 2),
            "All three rings that count prefer the wrong tile, the outer one most",
        ),
        ([0.5] * 4, [0.6, 0.1, 0.7, 0.1], (1, 0, 1, 0), "Both rings that count prefer the wrong tile, ring 3 most"),
        ([0.5] * 4, [0.6, 0.501, 0.7, 0.6], None, "Rings 1, 3, and 4 prefer the wrong tile, ring 2 hardly differs"),
        ([0.5] * 4, [0.6, 0.501, 0.5, 0.499], None, "Ring 1 prefers the wrong tile, the others hardly differ"),
        ([0.7, 0.7, 0.1, 0.5], [0.5, 0.5, 0.5, 0.9], None, "Rings 1 and 2 prefer the truth, 3 and 4 outvote them"),
        ([0.7, 0.2, 0.1, 0.5], [0.5, 0.5, 0.5, 0.5], None, "Ring 1 prefers the truth, rings 2 and 3 outvote it"),
        ([0.7, 0.5, 0.5, 0.5], [0.5, 0.5, 0.5, 0.9], None, "Ring 1 prefers the truth, ring 4 outvotes it"),
        ([0.6, 0.6, 0.5, 0.5], [0.5, 0.5, 0.5, 0.9], None, "Rings 1 and 2 prefer the truth, ring 4 outvotes them"),
        (
            [0.5] * 4,
            [0.504, 0.502, 0.502, 0.504],
            None,
            "Rings 1 and 4 prefer the wrong tile, the others hardly differ",
        ),
        ([0.5] * 4, [0.50001] * 4, None, "Nearly a tie: the nearest true tile is 0.001 behind or less"),
        ([0.3, 0.9, 0.9, 0.9], [0.5, 0.1, 0.1, 0.1], (1, 0, 0, 0), "The truth lies 0.400 farther than the answer"),
    ],
)
def test_a_wrong_answer(truth: list[float], answer: list[float], weights: object, headline: str) -> None:
    ranking = ranked([answer, truth], weights, (1,))
    verdict = judge(ranking, NAMES, "ring", error_m=120.0)
    assert (verdict.sign, verdict.headline) == (False, headline)
    assert verdict.sentence == (
        f"The nearest true tile is 2nd, {verdict.lead:.3f} behind the answer. The answer lies 120 m from the place photographed."
    )


def test_an_answer_without_a_truth_or_a_rival() -> None:
    two = [[0.9, 0.8], [0.5, 0.6]]
    verdict = judge(ranked(two, true=None), NAMES[:2])
    assert (verdict.sign, verdict.headline) == (None, "No truth is known")
    assert verdict.sentence == "It leads the next tile by 0.600."
    np.testing.assert_allclose(verdict.gains, [0.4, 0.2], atol=1e-6)
    alone = judge(ranked(two[:1], true=None), NAMES[:2])
    assert (alone.rival, alone.lead, alone.figures, alone.sentence) == (None, 0.0, [], "There is no other tile.")
    assert judge(ranked(two, true=()), NAMES[:2]).headline == "No true tile"
    assert judge(ranked(two, true=(0, 1)), NAMES[:2]).headline == "Found: there is no wrong tile"


def test_parts_of_any_number_and_name() -> None:
    eight = judge(ranked([[0.6] * 7 + [0.8], [0.5] * 8], true=(1,)), [str(i) for i in range(1, 9)])
    assert eight.headline == "All eight parts prefer the wrong tile, part 8 most"
    strips = judge(ranked([[0.6, 0.5, 0.6], [0.5, 0.7, 0.1]], true=(1,)), ["sky", "middle", "road"])
    assert strips.headline == "Part middle prefers the truth, parts sky and road outvote it"
    whole = judge(ranked([[0.9], [0.6]]), ["1 whole"])
    assert (whole.headline, whole.parts) == ("Lead over the nearest wrong tile: 0.600", ())


def test_junk_is_no_rival() -> None:
    cosines = np.array([[0.9, 0.9], [0.8, 0.8], [0.5, 0.6]], np.float32)
    ranking = retrieval.rank(cosines, scoring.part_weights(2), truth=Truth(np.array([0]), np.array([1])))
    rival = judge(ranking, ["1", "2"]).rival
    assert rival.index == 2


def test_under_csls_the_gains_are_of_the_distances_that_are_ranked() -> None:
    rng = np.random.default_rng(3)
    cosines = rng.uniform(0, 1, (20, 3)).astype(np.float32)
    terms = CslsTerms(rng.uniform(0, 1, 3).astype(np.float32), rng.uniform(0, 1, (20, 3)).astype(np.float32))
    weights = scoring.part_weights(3, [1, 2, 0.5])
    verdict = judge(retrieval.rank(cosines, weights, np.arange(20), 4, csls=terms), ["top", "middle", "bottom"])
    assert verdict.gains.sum() == pytest.approx(verdict.rival.distance2 - verdict.answer.distance2, abs=1e-5)
    np.testing.assert_allclose(verdict.gains, verdict.rival.contributions - verdict.answer.contributions, atol=1e-5)


@pytest.fixture(scope="module")
def tasks() -> list[Task]:
    """Both directions of the demo, plain, calibrated, and by CSLS."""
    model, dataset = load(DEMO_MODEL, "cpu"), open_dataset(DEMO)
    calibration = shipped_calibration(model, dataset)
    names = offered_tasks(model, dataset)
    plain = [describe_task(model, DEMO_MODEL.name, dataset, name) for name in names]
    return [*plain, *scored_tasks(model, DEMO_MODEL.name, dataset, calibration, names)]


def test_no_headline_of_the_demo_is_false(tasks: list[Task]) -> None:
    kinds: Counter[str] = Counter()
    assert {(task.name, task.scoring) for task in tasks} == {
        (name, scoring)
        for name in ("drone-to-satellite", "satellite-to-drone")
        for scoring in ("plain", "calibrated", "csls")
    }
    for task in tasks:
        gallery = task.gallery_descriptors.astype(float)
        for query in range(len(task.queries)):
            verdict = judge(task.search(query), task.part_names, "ring")
            # d² part by part, from the descriptors; under CSLS less the tiles' terms, as those of the query alter no difference.
            shares = -2 * np.einsum("nd,gnd->gn", task.query_descriptors[query].astype(float), gallery)
            if task.csls_tiles is not None:
                shares += task.csls_tiles / 2
            true = task.gallery_labels == task.query_labels[query]
            kinds[check(verdict, shares, true)] += 1
    assert min(kinds[kind] for kind in ("decide", "most", "all", "some", "outvote")) > 20, kinds


def check(verdict: Verdict, shares: np.ndarray, true: np.ndarray) -> str:
    """Check each claim of a verdict against the shares of d² (G, 4) of all tiles; return the kind of its headline."""
    d2 = shares.sum(axis=1)
    answer, rival = verdict.answer.index, verdict.rival
    assert d2[answer] <= d2.min() + EQUAL
    assert verdict.sign == true[answer]
    others = np.flatnonzero(~true if verdict.sign else true)
    assert d2[rival.index] <= d2[others].min() + EQUAL
    gains = shares[rival.index] - shares[answer]
    lead = gains.sum()
    np.testing.assert_allclose(verdict.gains, gains, atol=EQUAL)
    assert verdict.lead == pytest.approx(lead, abs=1.1e-3)
    said = re.search(r"by (\d\.\d{3})" if verdict.sign else r"(\d\.\d{3}) behind", verdict.sentence)
    assert float(said[1]) == verdict.lead
    if not verdict.sign:
        before = int((d2 < d2[true].min() - EQUAL).sum())
        within = int((d2 < d2[true].min() + EQUAL).sum())
        assert re.search(
            rf"is ({'|'.join(ordinal(rank) for rank in range(before + 1, within + 1))}), ", verdict.sentence
        )
    without = [np.delete(shares, part, axis=1).sum(axis=1) for part in range(4)]
    headline = verdict.headline
    if found := re.fullmatch(
        r"Rings? ([\d, and]+) decides?: without (it|either one|any one of them), a wrong tile wins", headline
    ):
        parts = numbers(found[1])
        assert {1: "it", 2: "either one"}.get(len(parts), "any one of them") == found[2]
        assert list(verdict.parts) == parts
        falls = re.findall(r"(\d+)\w\w without ring (\d)", verdict.sentence)
        assert [int(part) - 1 for _, part in falls] == parts
        for rank, part in zip((int(rank) for rank, _ in falls), parts, strict=True):
            nearest = without[part][true].min()
            assert without[part][~true].min() < nearest
            ahead = [int((without[part][~true] < nearest + shift).sum()) for shift in (-EQUAL, 0)]
            assert ahead[0] <= rank - 1 <= ahead[1]
        for part in set(range(4)) - set(parts):
            assert without[part][true].min() <= without[part][~true].min() + EQUAL, "it would decide, too"
        return "decide"
    if found := re.fullmatch(
        r"Rings? ([\d, and]+) adds? most(, alike)?: (.*) (of|to) the lead of (\d\.\d{3})", headline
    ):
        parts, figures = numbers(found[1]), [float(figure) for figure in re.findall(r"\d\.\d{3}", found[3])]
        assert (len(parts) > 1) == bool(found[2])
        assert float(found[5]) == verdict.lead
        np.testing.assert_allclose(figures, gains[parts], atol=1.1e-3)
        rest = sorted(set(range(4)) - set(parts))
        assert gains[parts].min() >= gains[rest].max(initial=-9) if rest else True
        assert (found[4] == "of") == (round(sum(figures), 3) <= verdict.lead)
        assert np.ptp(gains[parts]) <= 6e-4
        return "most"
    if headline.startswith("Nearly a tie"):
        assert -EQUAL <= lead < 1e-3 + EQUAL
        return "tie"
    if found := re.fullmatch(r"All four rings prefer the wrong tile, (.*)", headline):
        assert (gains > 0).all()
        most = {"the outer one most": [3], "the centre most": [0], "all alike": [0, 1, 2, 3]}.get(found[1])
        most = numbers(found[1].removesuffix(" most")) if most is None else most
        rest = sorted(set(range(4)) - set(most))
        assert np.ptp(gains[most]) <= 6e-4
        assert gains[most].min() >= gains[rest].max(initial=-9)
        return "all"
    if found := re.fullmatch(
        r"Rings? ([\d, and]+) prefers? the wrong tile, (ring \d hardly differs|the others hardly differ)", headline
    ):
        parts = numbers(found[1])
        rest = sorted(set(range(4)) - set(parts))
        assert (gains[parts] > 0).all()
        assert (abs(gains[rest]) < 0.005 + EQUAL).all()
        assert list(verdict.parts) == parts
        assert gains[parts].min() > abs(gains[rest]).max() - EQUAL
        return "some"
    found = re.fullmatch(
        r"Rings? ([\d, and]+) prefers? the truth, (?:rings? )?([\d, and]+) outvotes? (?:it|them)", headline
    )
    assert found, headline
    for_truth, against = numbers(found[1]), numbers(found[2])
    assert list(verdict.parts) == against
    assert (gains[for_truth] < 0).all()
    assert (gains[against] > 0).all()
    assert gains[against].sum() > -gains[for_truth].sum()
    return "outvote"


def numbers(text: str) -> list[int]:
    """Return the positions of the rings that a text names by their numbers."""
    return [int(number) - 1 for number in re.findall(r"\d+", text)]
