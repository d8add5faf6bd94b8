"""How galleries of a workspace can be ranked: plain, calibrated, and by CSLS; the last two are prepared once for all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from threading import Lock

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress
from explorer.compute.ranking_job import RankingJob
from lpn.tasks.task import SCORINGS, Scoring, scored_key

# The glossary's terms, whose words `lpn.drawing.words` has.
TERMS: Mapping[Scoring, str] = {"plain": "plain", "calibrated": "calibration", "csls": "CSLS"}


@dataclass(frozen=True)
class Choice:
    """One scoring of a task, as the page offers it.

    Attributes:
        term: of the glossary.
        recall: Recall@1 of the whole task in percent; None while it is not known.
        ready: its ranking can be shown; otherwise choosing it prepares it, if `Scorings.why_not` is empty.
    """

    scoring: Scoring
    term: str
    recall: float | None
    ready: bool


class Scorings:
    """Prepares the further scorings of a workspace.

    Args:
        why_not: one sentence that says why there are no further ones; empty if there are, or can be.
        prepare: ranks all tasks under the further scorings, and puts them into the workspace.
    """

    def __init__(self, why_not: str = "", prepare: Callable[[ReportProgress], None] | None = None) -> None:
        self.why_not, self._prepare = why_not, prepare
        self._jobs, self._lock = BackgroundJobs(), Lock()

    def prepare(self, client: object) -> BackgroundJob[None] | None:
        """Start or join the preparation, which may describe all pictures; None where there is nothing to prepare.

        Args:
            client: waits for it; the last one that leaves the job cancels it.
        """
        if self._prepare is None:
            return None
        with self._lock:
            self._jobs.forget_failed("prepare")
            return self._jobs.join("prepare", client, self._prepare)


def choices(rankings: Mapping[str, RankingJob], name: str) -> list[Choice]:
    """Return the scorings of a task with what they bring."""
    offered = []
    for scoring in SCORINGS:
        ranking = rankings.get(scored_key(name, scoring))
        graded = ranking is not None and ranking.result is not None and ranking.results["queries"]
        recall = ranking.results["recall@1"] if ranking is not None and graded else None
        offered.append(Choice(scoring, TERMS[scoring], recall, ranking is not None))
    return offered
