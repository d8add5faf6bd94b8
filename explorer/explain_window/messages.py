"""The messages of the explain window's html; none of them is trusted."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from explorer.explain_window.whole_task import TurnChoice
from explorer.session_state import HeatKind
from explorer.web.messages import Message
from lpn.descriptors.weather import WeatherName
from lpn.explain.sweeps import SweptProperty

_Index = Annotated[int, Meta(ge=0)]
_Finite = Annotated[float, Meta(ge=-1e6, le=1e6)]


class ExplainMessage(Message):
    """A message of the explain window's HTML."""


class CloseWhy(ExplainMessage, tag="close"): ...


class FollowTab(ExplainMessage, tag="tab"):
    """Follow a person who opened a tab; its name may be that of a tab of another window."""

    name: str


class ShowPart(ExplainMessage, tag="part"):
    """Show the heatmap of a part, or of all parts."""

    part: _Index | None


class LayOver(ExplainMessage, tag="heat-over"):
    """Lay the heatmaps of the parts over their pictures, or show them by themselves."""

    laid: bool


class ShareScale(ExplainMessage, tag="scale"):
    """Give query and tile one colour scale for each part, or each its own."""

    same: bool


class CompareModels(ExplainMessage, tag="second"):
    """Open the compared model, again if that failed."""


class ChooseModel(ExplainMessage, tag="beside"):
    """Compare with another one of the models beside the workspace's own."""

    model: _Index


class ShowMaps(ExplainMessage, tag="maps"):
    """Show activation or evidence."""

    kind: HeatKind


class CompareTile(ExplainMessage, tag="compare"):
    tile: _Index


class ChooseQuery(ExplainMessage, tag="query"):
    query: _Index


class UseWeights(ExplainMessage, tag="weigh"):
    """Weigh the parts so that the true tile comes first."""


class RequestEffect(ExplainMessage, tag="effect"):
    """Test these weights on all queries."""


class SaveAnalysis(ExplainMessage, tag="report"): ...


class RequestSweep(ExplainMessage, tag="sweep"):
    over: SweptProperty


class TryAllTurns(ExplainMessage, tag="turns"):
    """Open the tab of sweeps with a sweep over all turns."""


class CancelSweep(ExplainMessage, tag="cancel"): ...


class MeasureTurns(ExplainMessage, tag="turned"):
    """Measure the whole task with its queries turned: as this query, as in Table IV, or by 30 degrees around."""

    turns: TurnChoice


class StopTurns(ExplainMessage, tag="turned-stop"): ...


class TakePoint(ExplainMessage, tag="take"):
    """Transform the query as a point of a sweep says: degrees, pixels to the right and down, a factor, and a weather."""

    angle: _Finite
    right: _Finite
    down: _Finite
    zoom: _Finite
    weather: WeatherName = "normal"


class SearchRegion(ExplainMessage, tag="region"):
    """Search by cells of the query's feature map; by the whole query without any."""

    cells: list[_Index]
