"""The verdict on an analysis in words."""

from __future__ import annotations

import math
from dataclasses import dataclass

from explorer import judge
from explorer.compute.background_jobs import BackgroundJob
from explorer.panels import place_text
from explorer.web.render import progress_bar
from explorer.workspace import StateAnalysis, Workspace
from lpn.analysis import answer_context
from lpn.core.arrays import FloatingArray
from lpn.core.numbers import distance, rounded_to_sum, upper_bound
from lpn.core.texts import ordinal
from lpn.datasets.rendered import shows_rendered
from lpn.drawing import verdicts, words
from lpn.drawing.verdicts import pictures_of
from lpn.locate.belief import PLACED, SIGMAS, TAG_RADIUS, belief, disagreements, on_what, tag_allowance, tag_figures
from lpn.locate.grades import off_window, window_of
from lpn.locate.located import LocatedFrame
from lpn.locate.matchers import open_matchers
from lpn.locate.options import TOP
from lpn.locate.own_photo import OwnPhoto
from lpn.locate.summary import doubted_clause, is_unchecked, other_map, unchecked_frames
from lpn.maps import Window
from lpn.maps.tag_placed import placing_sentence
from lpn.tasks.task import Task

# A GPS tag at least this far from the nearest tile is in another region.
_ELSEWHERE_M = 10_000.0
# The shapes of an own picture and of the network's input differ visibly from here on.
_PRESSED = 1.05
# The page puts the name of the computer that answers it in place of the braces, as only the page knows its address.
OWN_KEPT = (
    "Your picture stays in the memory of the computer that runs this page ({computer}) until you close this page, and goes "
    "no further."
)
NO_LINK = "A link cannot carry your own picture."
# Headlines of an own picture that shows none of the places here.
ELSEWHERE = ("Not one of these", "Probably none of these")
# The headline of a picture that probably lies beyond the map.
_OTHER_MAP = "Probably not on this map"
_UNPROVEN = "It may show the same place; pictures of other places can look as close."
# The photos in doubt, by what contradicts their details.
_DOUBTED = {
    "tag": "whose GPS tag lies elsewhere",
    "map": "that does not fit the map away from its middle",
    "sequence": "without a GPS tag whose neighbours lie elsewhere",
}
_ANY = "Every picture gets an answer, and nothing measured here tells if yours shows one of these places."


@dataclass(frozen=True, eq=False)
class Lead:
    """The lead of one tile over another, part by part: of the answer, or of the right picture over a wrong answer.

    Attributes:
        terms: each part's term of the lead in d², (n,); positive where the part speaks for the leader.
        shown: the lead in d² as it is shown, see `shown_difference`.
        other: the tile that the answer is compared with, in words.
        index: that tile's position in the gallery.
        answer: the answer, in words.
        of_answer: the leader is the answer; otherwise it is the other tile.
        sure: one of the two is known to be the right picture, and is the leader.
    """

    terms: FloatingArray
    shown: float
    other: str
    index: int
    answer: str
    of_answer: bool = True
    sure: bool = True

    @property
    def figures(self) -> list[float]:
        """The terms as they are shown: rounded, they add up to the lead that is shown."""
        return rounded_to_sum(self.terms.tolist(), total=self.shown)

    @property
    def decisive(self) -> list[int]:
        """The parts that do most to put the answer before the other tile, see `verdicts.leading_parts`."""
        return verdicts.leading_parts(self.terms if self.of_answer else -self.terms)

    @property
    def leader(self) -> str:
        """The tile that positive terms speak for, in words."""
        return self.answer if self.of_answer else self.other

    @property
    def follower(self) -> str:
        """The tile that negative terms speak for, in words."""
        return self.other if self.of_answer else self.answer


def verdict(analysis: StateAnalysis, workspace: Workspace) -> tuple[bool | None, str, str]:
    """Return whether the top match is right (None: unknown), a headline, and the reason; see `lpn.drawing.verdicts`."""
    if analysis.ranking.relevant is None:
        right, headline, sentence = plain_verdict(analysis, workspace)
        waits = _compared(analysis) and analysis.registered is None
        return right, headline, sentence if waits else f"{sentence} {analysis.verdict.sentence}"
    if not judge.is_sure(analysis, workspace):
        _, headline, sentence = flight_verdict(analysis, workspace, plain_verdict(analysis, workspace))[0]
        return None, headline, sentence
    said = analysis.verdict
    return said.sign, said.headline, said.sentence


def plain_verdict(analysis: StateAnalysis, workspace: Workspace) -> tuple[bool | None, str, str]:
    """Return whether the top match is right (None: unknown), one word for it, and one sentence without a technical term."""
    first, positive, error_m = analysis.matches[0], analysis.positive, analysis.error_m(analysis.matches[0])
    pictures = f"{analysis.task.tiles:,} {pictures_of(analysis.task)}"
    if analysis.ranking.relevant is None:
        if (of_map := _on_map(analysis, workspace)) is not None:
            return of_map
        elsewhere, text = _elsewhere(analysis, workspace), f"This is the most similar of {pictures}."
        if elsewhere:
            return (
                None,
                ELSEWHERE[0],
                f"{elsewhere}, so no answer can be right. The one beside it is merely the most similar.",
            )
        far = _far(analysis, workspace)
        place = _beside_tag(analysis, workspace)
        if not place and not analysis.state.upload and workspace.flight is not None and workspace.flight.elsewhere:
            place = "The GPS tags are left out, so it is not graded"
        place = place or "The true place is not known here, so it is not graded"
        text = f"{text} {place}."
        if _off_tag(analysis, workspace):
            return None, "Elsewhere by its GPS tag", text
        if far is None:
            unknown = f" {_ANY}" if analysis.state.upload else ""
            return None, "Best match", f"{text}{unknown}"
        if far[0]:
            return None, ELSEWHERE[1], f"{text} {far[1]}"
        return None, "Best match", f"{text} {_UNPROVEN} {far[1]}"
    if none := _no_right_answer(analysis, workspace):
        return False, "Wrong", none
    judged = judge.judged_piece(analysis, workspace)
    if first.true:
        details = workspace.flight is not None and workspace.flight.judge_of(analysis.state.query) == "its details"
        place = "there" if judged else "where details place the photo" if details else "the place photographed"
        window = _window(analysis)
        off = "" if error_m is None else f", whose middle lies {distance(error_m)} from {place}"
        if error_m is not None and window is not None:  # a large piece shows places far from its middle
            shown = "that place" if judged else "the place by its details" if details else place
            off = f": it is {window.size:.0f} m wide, and {shown} lies on it"
            if not words.plain():  # plain words have the figures folded, see `limit`
                off += _from_middle(error_m, window)
        return (
            True,
            "Right",
            f"The model compared {pictures} and found {judged or 'the right one'}{off}.",
        )
    away = "another place" if error_m is None else f"a place {distance(error_m)} away"
    rank = "is not near the top" if positive is None else f"came {ordinal(positive.rank)}"
    return (
        False,
        "Wrong",
        f"The model compared {pictures} and chose {away}; {judged or 'the right one'} {rank}.",
    )


def limit(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say by what a piece of a map is right or wrong, as pieces differ in width; "" for other answers, and ungraded ones."""
    first, window = analysis.matches[0], _window(analysis)
    if window is None or first.true is None or analysis.positive is None:
        return ""
    by = "its GPS tag" if workspace.flight is None else workspace.flight.judge_of(analysis.state.query)
    lies, error_m = "on it" if first.true else "beyond its edge", analysis.error_m(analysis.matches[0])
    if first.true and error_m is not None:
        lies += _from_middle(error_m, window)
    return f"The chosen piece is {window.size:.0f} m wide; by {by}, the photo's middle lies {lies}."


def _from_middle(metres: float, window: Window) -> str:
    """Say how far from the middle of a piece that is right the place lies, and how far it may."""
    # In a corner of the piece it is more than half of its width, and allowed.
    limit = f", where {window.size / 2:.0f} m each way are allowed" if metres <= window.size / 2 else ""
    return f", {distance(metres)} from its middle{limit}"


def tag_limit(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say how far the GPS tag of a placed photo may lie from its place by its details, and why; "" without one of them."""
    located, answer = workspace.located(analysis), workspace.details(analysis)
    if located is None or located.tag is None or answer is None or not answer.accepted:
        return ""
    allowed = upper_bound(tag_allowance(located), 0)
    tilt = "" if answer.camera else ", and as far as a tilted camera may look aside"
    return f"A GPS tag may lie {allowed} m from the place by its details: three times the error of both{tilt}."


def flight_verdict(
    analysis: StateAnalysis, workspace: Workspace, look: tuple[bool | None, str, str]
) -> tuple[tuple[bool | None, str, str], tuple[bool | None, str, str] | None]:
    """Return two verdicts on a photo of a flight: on its look, and by all methods, see `lpn.locate.belief`.

    Each begins with its method, as both stand on one screen, where there is a grade and a registration. The second is what the
    program concludes. It is None for a photo of no flight, and before the photo is registered.
    """
    right, _, sentence = look
    if workspace.flight is None or analysis.state.upload is not None:
        return look, None
    by = workspace.flight.judge_of(analysis.state.query)
    if _no_right_answer(analysis, workspace):
        look = None, "Not graded", sentence
    elif right is not None:
        look = right, f"{by_look(right)}, judged by {by}", sentence
    located, elsewhere = workspace.flight.frames[analysis.state.query], other_map(workspace.flight)
    registration = located.stages.get("registration")
    registered = registration is not None
    if not registered and not elsewhere:
        return look, None
    verdict = belief(located)
    told = verdict.summary if words.plain() else verdict.headline
    if registration is not None and verdict.stage == "registration":
        if look[0] is not None and verdict.sign is None and by == "its details":
            look = None, f"{by_look(right is True)}, if its details are right", sentence
        beside = _beside_look(analysis, look[0])
        return look, (
            verdict.sign,
            checked(by_details(told), located, verdict.sign),
            " ".join(filter(None, (elsewhere, beside))),
        )
    nowhere = "Its details fit nowhere well enough." if registered else ""
    headline = _OTHER_MAP if elsewhere else told
    return look, (verdict.sign, headline, " ".join(filter(None, (elsewhere, nowhere))))


def by_look(right: bool) -> str:
    """Return the verdict on a photo's look, which begins with the method."""
    return f"By its look: {'right' if right else 'wrong'}"


def by_details(headline: str) -> str:
    """Return the headline of a registration, see `lpn.locate.belief.Belief`, so that it begins with the method."""
    return headline.replace(PLACED, "By its details: placed", 1)


def _beside_look(analysis: StateAnalysis, right: bool | None) -> str:
    """Say that the model's own answer disagrees with the place of a photo that is known by other means; "" if it does not."""
    if right is not False:
        return ""
    off = analysis.error_m(analysis.matches[0])
    away = "" if off is None else f", {distance(off)} away"
    return f"The model's own guess, by its look alone, was wrong{away}."


def checked(headline: str, located: LocatedFrame, sign: bool | None) -> str:
    """Return the headline of an undoubted registration; it claims the middle alone if too few other places could be checked."""
    return f"{headline}, at least its middle" if sign and is_unchecked(located) else headline


def _no_right_answer(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say why no tile can be the right answer; "" if one is.

    A photo of a flight is graded by a place, which its registration may contradict.
    """
    if analysis.positive is not None:
        return ""
    pictures = f"{analysis.task.tiles:,} {pictures_of(analysis.task)}"
    if workspace.flight is None:
        return f"None of the {pictures} shows this place, so no answer can be right."
    by = "Its GPS tag" if workspace.flight.late_tags is None else "The place that the photo is graded by"
    return f"{by} lies on none of the {pictures}, so no answer counts as right."


def _compared(analysis: StateAnalysis) -> bool:
    """Return True if the own picture's details are being compared with the map, which says more than its look."""
    return analysis.own_photo is not None and analysis.own_photo.error is None


def _on_map(analysis: StateAnalysis, workspace: Workspace) -> tuple[bool | None, str, str] | None:
    """Return the verdict on an own picture whose details are, or were, compared with the map; None for every other picture.

    Until the comparison ends, the most similar piece is not told of: a piece of a foreign picture would be read as its place.
    """
    if analysis.registered is not None:
        return _registered(analysis, workspace, analysis.registered)
    if not _compared(analysis):
        return None
    elsewhere, nearest = "", _far_tag(analysis)
    if nearest is not None and shows_rendered(workspace.root):
        elsewhere = f"{_elsewhere(analysis, workspace)}."
    elif nearest is not None:
        elsewhere = f"Your picture's GPS tag lies {distance(nearest)} from this map."
    return None, "Being compared with the map", elsewhere


def _registered(analysis: StateAnalysis, workspace: Workspace, own: OwnPhoto) -> tuple[bool | None, str, str]:
    """Return the verdict on an own picture whose details were compared with the map: a sign, a headline, and sentences."""
    answer, pictures = own.answer, f"{analysis.task.tiles:,} {pictures_of(analysis.task)}"
    details = "" if words.plain() else f" {answer.sentence}"
    if not answer.accepted:
        where = "nowhere on this map" if own.whole_map else "none of the places that look most like it"
        large = "" if own.whole_map else " The map is too large to be searched as a whole."
        merely = f"The piece that looks most like it is merely the most similar of {pictures}.{large}{details}"
        basemap, tag = workspace.basemap, own.located.tag
        if basemap is None or tag is None:
            return None, f"Its details fit {where}, so nothing says that your picture is of this place", merely
        if (off := basemap.metres_off(tag)) > _tag_error(workspace):
            # A camera beside the map may look at it.
            far, kilometres = off > max(basemap.sides), _far_tag(analysis)
            where_tag = f"{distance(off)} off the map's border"
            if kilometres is not None:
                where_tag = f"{distance(kilometres)} from the map"
            sentence = f"Its details fit {where}, and its GPS tag lies {where_tag}. {merely}"
            if own.whole_map and far:
                return False, "Not on this map", sentence
            return None, _OTHER_MAP, sentence
        return None, f"Its details fit {where}, so only its GPS tag says that your picture is of this place", merely
    contradictions = disagreements([own.located])
    concluded, against_tag = belief(own.located, contradictions), any(one.other == "tag" for one in contradictions)
    only_middle = any(one.other == "map" for one in contradictions)
    fits = f"By its details, {'the middle of ' if only_middle else ''}your picture fits the map"
    if not words.plain():
        fits += f" to ± {answer.radius or 0:.1f} m {on_what(answer)}"
    if own.located.tag is not None:
        metres, allowed = tag_figures(own.located, contradictions)
        if (from_nearest := _far_tag(analysis)) is not None:  # far off, the plane of the map is no measure
            metres = distance(from_nearest)
        fits += f"; its GPS tag lies {metres} from that place{_usual(workspace)}, where {allowed} are allowed"
    else:
        fits += "; it has no GPS tag that would say so, too"
    against, headline = "", checked("On this map", own.located, concluded.sign)
    unchecked = "" if answer.agreement is None else answer.agreement.unchecked
    doubts = [unchecked, *(one.told(concluded) for one in contradictions if one.other == "map")]
    if against_tag:
        against = ", so one of the two is off"
        headline = "On this map by its details, elsewhere by its GPS tag"
    elif not concluded.sign:
        headline = "Its middle fits this map, places away from it do not"
    window = _window(analysis)
    off_answer = off_window(own.located, window)
    look = " The piece that looks most like it lies there, too."
    if off_answer is None or answer.x is None or answer.y is None or window is None:
        look = ""
    elif off_answer > 0:
        metres = distance(math.hypot(answer.x - window.x, answer.y - window.y))
        look = f" Its look alone errs: the middle of the most similar piece lies {metres} from that place."
    beside = "".join(f" {text}" for text in doubts if text)
    return concluded.sign, headline, f"{fits}{against}.{beside}{look}{details}"


def _usual(workspace: Workspace) -> str:
    """Return beside the distance of a GPS tag how far those of the flight's photos lie off; "" where that is not known."""
    audit = None if workspace.flight is None else workspace.flight.audit
    if audit is None or not audit.frames:
        return ""
    return f" (those of the flight's photos {distance(audit.median)} in the median)"


def _window(analysis: StateAnalysis) -> Window | None:
    """Return where the answer lies on the map; None where it is no piece of one."""
    return window_of(analysis.task, analysis.matches[0].index)


def comparing(job: BackgroundJob[OwnPhoto]) -> str:
    """Say how far the comparison of an own picture's details with the map is; why there is none; "" when it has ended well."""
    if job.error is not None:
        return "" if job.cancelled else f"Its details could not be compared with the map: {job.error}"
    if job.value is not None:
        return ""
    tries = f": {job.done} of {job.total} tries" if job.total else ""
    text = (
        f"Its details are compared with the map, which can take a minute and goes on whatever this page shows …{tries}"
    )
    return progress_bar(job.done, job.total, text, "tries")


def next_step(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say what a person can do about an own picture whose details leave a doubt; "" about any other picture."""
    own, basemap = analysis.registered, workspace.basemap
    if own is None or basemap is None:
        return ""
    tag = own.located.tag
    if own.answer.accepted:
        against = {one.other for one in disagreements([own.located])}
        if "tag" not in against:
            return "Compare its edges with the map by eye: see it on the map, with Swipe." if "map" in against else ""
        return (
            "Compare the GPS tags of other photos of its flight: tags can be late or off. Ask for the original file, as both a "
            "GPS tag and a picture can be altered, too."
        )
    if tag is None:
        return "Ask for the original file, whose GPS tag tells where to look, or for a photo that looks straight down."
    if basemap.metres_off(tag) > max(basemap.sides):
        return (
            "To check the place of its GPS tag, a map of that place is needed. If the picture is said to be of this place, "
            "ask for the original file."
        )
    return "Ask for the original file, or for a photo of the same place that looks straight down and shows more of the ground."


def own_windows(analysis: StateAnalysis) -> list[Window]:
    """Return the most similar pieces of the map, about which an own picture is searched on a large one."""
    windows = (window_of(analysis.task, index) for index in analysis.ranking.order[:TOP].tolist())
    return [window for window in windows if window is not None]


def _far(analysis: StateAnalysis, workspace: Workspace) -> tuple[bool, str] | None:
    """Say if the user's own picture probably shows none of the places here, see `answer_context.describe_distance`.

    None where that is not measured: under other part weights or for a region no right answer was measured so.
    """
    state, ranking = analysis.state, analysis.ranking
    if not state.upload or state.region or state.altered_weights:
        return None
    measured = workspace.answer_distances(analysis.task)
    if measured is None:
        return None
    distance2 = 2.0 - 2.0 * float(ranking.cosines[analysis.matches[0].index] @ ranking.weights)
    return answer_context.describe_distance(measured, distance2)


def own_hint(workspace: Workspace, rendered: bool) -> str:
    """Say which own pictures are taken, and what is done with them, before one is chosen.

    Args:
        rendered: the workspace shows a rendered city.
    """
    task = next(iter(workspace.tasks.values()))
    above = "" if task.query_view == "street" else ", best of the ground seen from above"
    if workspace.own_photos is not None:
        above += ", with a camera that looks nearly straight down"
    city = ""
    if rendered:
        city = " They show a computer-generated city: a photo of a real place has no right answer among them."
    compared = (
        "" if workspace.own_photos is None else ", then compares its details with the map, which can take a minute"
    )
    chosen = f" They are tiles {task.of_index}." if task.of_index else ""
    return (
        f"Choose pictures on this device (JPEG, PNG, or WebP){above}. The model finds the most similar of the {task.tiles:,} "
        f"{pictures_of(task)} here{compared}.{chosen}{city} {OWN_KEPT}"
    )


def own_shape(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say that an own picture is pressed into the shape of the network's input; empty if it has that shape."""
    picture = analysis.state.upload
    if picture is None:
        return ""
    (height, width), (rows, columns) = picture.picture.shape[:2], workspace.contract.input_size
    stretched = (width / height) / (columns / rows)
    if 1 / _PRESSED < stretched < _PRESSED:
        return ""
    shape = "a square" if rows == columns else f"{columns} × {rows} pixels"
    return f"Your picture is {width} × {height} pixels; the model sees it pressed into {shape}."


def _beside_tag(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say how far the answer lies from the picture's GPS tag; "" without a tag."""
    if (error := analysis.error_m(analysis.matches[0])) is None:
        return ""
    sentence = f"Its GPS tag lies {distance(error)} from the middle of this one"
    if (reach := _off_tag(analysis, workspace)) is None:
        return sentence
    return f"{sentence}; the size of the piece and the errors of tags allow {distance(reach)}"


def _off_tag(analysis: StateAnalysis, workspace: Workspace) -> float | None:
    """Return the metres within which a GPS tag may lie from the middle of the answer, if the own picture's lies beyond.

    The limit is half of the piece's diagonal plus the error of a tag, see `_tag_error`.
    """
    error, window = analysis.error_m(analysis.matches[0]), _window(analysis)
    if analysis.state.upload is None or error is None or window is None:
        return None
    reach = window.size / math.sqrt(2) + _tag_error(workspace)
    return reach if error > reach else None


def _tag_error(workspace: Workspace) -> float:
    """Return the metres by which a GPS tag may be off: three times the error of a tag, or the most of this flight's."""
    audit = None if workspace.flight is None else workspace.flight.late_tags
    return max(SIGMAS * TAG_RADIUS, 0.0 if audit is None else audit.largest)


def _elsewhere(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say that no tile is near the GPS tag of the user's own picture; "" if one is, or without a tag."""
    nearest = _far_tag(analysis)
    if nearest is not None and shows_rendered(workspace.root):
        return f"These are of a {words.say('rendered')} place, and your picture's GPS tag is of a real one"
    return "" if nearest is None else f"Your picture's GPS tag lies {distance(nearest)} from the nearest of them"


def _far_tag(analysis: StateAnalysis) -> float | None:
    """Return the metres from the GPS tag of the user's own picture to the nearest tile if it is in another region."""
    if analysis.state.upload is None or analysis.errors_m is None:
        return None
    nearest = float(analysis.errors_m.min())  # NaN if a tile has no position, which may then show the place
    return nearest if nearest >= _ELSEWHERE_M else None


def lead(analysis: StateAnalysis, judged: str = "") -> Lead | None:
    """Return the lead between the top match and the tile that it is best compared with; None where there is none.

    For a right answer, that is the hardest negative; for a wrong one, the nearest positive; without a truth, the next tile.

    Args:
        judged: what the right piece is called where its judge is doubtful, see `explorer.judge.judged_piece`.
    """
    said, answer = analysis.verdict, answer_name(analysis)
    if said.rival is None or said.gains is None:
        return None
    if said.rival.true and not said.sign:
        other = judged or "the right picture"
        return Lead(-said.gains, -said.lead, other, said.rival.index, answer, of_answer=False)
    other = "the next best picture"
    if said.sign:
        other = "the best piece of another place" if judged else "the best wrong picture"
    return Lead(said.gains, said.lead, other, said.rival.index, answer, sure=bool(said.sign))


def answer_name(analysis: StateAnalysis) -> str:
    """Return what the model's answer is called; an own picture on a map has another one by its details."""
    own_on_map = analysis.state.upload is not None and _window(analysis) is not None
    return "the most similar piece" if own_on_map else "this answer"


def trust(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say how often answers with a similar lead over the second tile are right; empty where that is not known.

    It is not known under other part weights or for a region, as no other query was ranked so. For an uploaded picture it is not
    known either if the truth names junk, as its junk is unknown, nor among the tiles of a rendered city. Where the details of an
    uploaded picture are compared with a map, the trials of that map tell. Of a real flight it says what nobody has tried, too.
    """
    text = _trust(analysis, workspace)
    return f"{text} {place_text.untried(workspace)}".strip() if text and analysis.state.upload is None else text


def _trust(analysis: StateAnalysis, workspace: Workspace) -> str:
    state, task, result = analysis.state, analysis.task, workspace.rankings[analysis.task.key].result
    own = state.upload is not None
    if own and workspace.own_photos is not None and (_compared(analysis) or analysis.registered is not None):
        elsewhere, here = trials(workspace)
        tried = f"o{elsewhere[1:]}; {here}, and nobody measured how well. {place_text.UNTRIED}" if here else ""
        return " ".join(filter(None, (tried, _of_map(analysis, workspace))))
    if result is None or state.region or state.altered_weights or (own and _elsewhere(analysis, workspace)):
        return ""
    if own and (shows_rendered(workspace.root) or any(len(of.junk) or of.among is not None for of in task.truth or ())):
        return ""
    besides = None if own else state.query
    graded = workspace.graded(workspace.rankings[task.key])
    alike = answer_context.answers_alike(result.ranking, analysis.matches[0].gap, graded, besides)
    if alike is None:
        return _of_flight(workspace, task)
    which = "" if own else "other "
    unaltered = ", taken as they are," if state.change else ""
    text = (
        f"among the {alike.queries:,} {which}pictures here{unaltered} whose answer was about as far ahead of the second best, it "
        f"was right {_times(alike.right, alike.queries)}."
    )
    if not own:
        return text
    return f"{text} That holds for pictures like those of {workspace.data_name}, and only if one of these tiles shows the place."


def _of_map(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say that an own picture may be one of those that the map was made of; "" of one of another day."""
    picture, basemap, own = analysis.state.upload, workspace.basemap, analysis.registered
    if picture is None or basemap is None or own is None or not own.answer.accepted:
        return ""
    if not placing_sentence(basemap.notes) or picture.day not in (None, basemap.place.day):
        return ""
    day = "is of the day on which the map's photos were taken" if picture.day else "does not tell when it was taken"
    return f"Your picture {day}. If the map was made of it, too, then it fits by itself, and that proves nothing of other photos."


def _of_flight(workspace: Workspace, task: Task) -> str:
    """Say of a flight with too few photos for `answer_context.answers_alike` how often each method is right; else ""."""
    verdicts_of_all = workspace.verdicts
    if workspace.flight is None or verdicts_of_all is None or not few_photos(workspace, task):
        return ""
    right, graded = workspace.counts(workspace.rankings[task.key])
    which = "" if graded == len(task.queries) else "graded "
    look = f"of {graded} {which}photos, {right} were right by their look alone"
    tried = [located for located in workspace.flight.frames if "registration" in located.stages]
    placed = [located for located in tried if located.stages["registration"].accepted]
    if not tried:
        return f"{look}."
    count = f"all {len(tried)}" if len(placed) == len(tried) else f"{len(placed)} of {len(tried)}"
    look += f"; their details placed {count}{' so far' if len(tried) < len(workspace.flight.frames) else ''}"
    judged = verdicts_of_all.beliefs
    errors = [error for located in placed if (error := located.error("registration")) is not None]
    measured = workspace.flight.late_tags is None and bool(errors)
    if measured:
        truths = "their true places" if workspace.flight.rendered else "their GPS tags"
        look += f", at most {upper_bound(max(errors))} m from {truths}"
    look += doubted_clause(judged)
    if unchecked := len(unchecked_frames(workspace.flight.frames, judged)):
        more = " more" if any(one.in_doubt for one in judged) else ""
        look += f"; {unchecked}{more} could not be checked away from the middle"
    if measured:
        return f"{look}."
    elsewhere, _ = trials(workspace)
    return f"{look}. Nobody measured where they really are.{f' {elsewhere}.' if elsewhere else ''}"


def doubts(workspace: Workspace) -> str:
    """Say which photos of a flight that their details place are in doubt, and how many; "" without any."""
    judged = workspace.verdicts
    if judged is None:
        return ""
    left = {i for i, verdict in enumerate(judged.beliefs) if verdict.in_doubt}
    kinds: list[str] = []
    for other, kind in _DOUBTED.items():
        if of_kind := left & {
            one.frame for one in judged.contradictions if (one.one, one.other) == ("registration", other)
        }:
            kinds.append(f"{kind} ({len(of_kind)}{' more' if kinds else ''} here)")
            left -= of_kind
    return f"In doubt is a photo {', or one '.join(kinds)}." if kinds else ""


def few_photos(workspace: Workspace, task: Task) -> bool:
    """Return whether a flight has too few graded photos to tell how often answers with a similar lead are right."""
    if workspace.flight is None:
        return False
    _, graded = workspace.counts(workspace.rankings[task.key])
    return 0 < graded < answer_context.FEWEST_GRADED


def trials(workspace: Workspace) -> tuple[str, str]:
    """Say how many single photos of other places and of this place were placed on the map; "" where that was not measured.

    It holds for the matchers that were used alone, so it is not said where one of them is not installed.
    """
    counts = None if workspace.basemap is None else workspace.basemap.trials
    if counts is None or not {matcher.name for matcher in open_matchers()}.issuperset(counts.matchers):
        return "", ""
    none = "none was" if counts.misplaced == 0 else f"{counts.misplaced} were"
    return (
        f"Of {counts.elsewhere} photos of other places, {none} placed on this map",
        f"of {counts.here} of this place, {counts.placed} were",
    )


def context(analysis: StateAnalysis, workspace: Workspace, total: float) -> str:
    """Say how the lead of a right answer to a query as it is compares with all such leads; empty where that is not known.

    Args:
        total: the answer's lead over the best wrong picture.
    """
    state = analysis.state
    as_it_is = not state.upload and not state.change and not state.region and not state.altered_weights
    known = workspace.outcomes(analysis.task) if as_it_is and analysis.matches[0].true else None
    return "" if known is None else answer_context.describe_lead(known[0], total)


def overall(right: int, graded: int, altered: bool = False) -> str:
    """Return how often the top match is right over all graded queries of a task, in words; empty without any.

    Args:
        altered: the query or the search on the page is altered; the rate is of unaltered queries.
    """
    if not graded:
        return ""
    over_all = "Unaltered, over all" if altered else "Over all"
    return f"{over_all} {graded:,} pictures its first answer is right {_times(right, graded, 1)}."


def _times(right: int, of: int, digits: int = 0) -> str:
    """Return "41 times (32 %)"; the share is never rounded up to all."""
    share = 100 * right / of
    if right < of and float(f"{share:.{digits}f}") == 100:
        share = 100 - 10.0**-digits
    return f"{right:,} times ({share:.{digits}f} %)"
