"""One table of words: what the page calls a thing for everybody, and the glossary's term for those who know the field.

Sentences and templates take their words from here while they are made, by the vocabulary that is spoken around them. Reports, the
command line, and everything else that sets no vocabulary speak the glossary's terms.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass(frozen=True)
class Word:
    """The names of one thing.

    Attributes:
        plain: for everybody.
        expert: the field's term.
    """

    plain: str
    expert: str


# By the glossary's terms. A part is called a ring where all parts are rings, see `Vocabulary`.
WORDS: Mapping[str, Word] = {
    "part": Word("part", "part"),
    "query": Word("picture", "query"),
    "tile": Word("answer", "tile"),
    "positive": Word("right picture", "true tile"),
    "hardest negative": Word("best wrong picture", "best wrong tile"),
    "rank": Word("place in the list", "rank"),
    "failure": Word("wrong answer", "failure"),
    "R@1": Word("right at once", "R@1"),
    "R@5": Word("among the first 5", "R@5"),
    "R@10": Word("among the first 10", "R@10"),
    "AP": Word("order of the whole list", "AP"),
    "error in metres": Word("typical error", "median error"),
    "d²": Word("difference", "d²"),
    "score": Word("likeness", "score"),
    "part cosine": Word("likeness", "cosine"),
    "part weights": Word("counts", "weight"),
    "contribution": Word("share of the difference", "share of d²"),
    "margin": Word("lead", "margin"),
    "gap": Word("ahead by", "gap"),
    "activation": Word("where the model reacts", "activation"),
    "evidence": Word("what speaks for it", "evidence"),
    "constant": Word("fixed share", "constant"),
    "scoring": Word("compared", "ranked"),
    "plain": Word("as they are", "plain"),
    "calibration": Word("adjusted to each other", "calibrated"),
    "CSLS": Word("adjusted, no favourites", "CSLS"),
    "retrieval": Word("by its look alone", "Retrieval"),
    "sequence": Word("by its neighbours", "Sequence"),
    "registration": Word("by its details", "Registration"),
    "tag": Word("GPS", "GPS tags"),
    "audit": Word("contradictions", "audit"),
    # People who do not know the field read "rendered" as delivered.
    "rendered": Word("computer-generated", "rendered"),
}

# Plain words for columns that describe pictures; a name that is not here is plain enough.
_COLUMNS: Mapping[str, str] = {
    "seconds": "time since the first photo",
    "altitude": "height of the drone",
    "heading": "direction that the photo's top points",
    "tilt": "tilt of the camera",
    "pitch": "tilt of the camera",
    "roll": "tilt of the camera to the side",
    "fov": "field of view of the camera",
    "heading from": "source of the direction",
    "sequence off tag": "distance from GPS, by its neighbours",
    "registration off tag": "distance from GPS, by its details",
    "registration": "outcome by its details",
    "inliers": "number of details that agree",
}


@dataclass(frozen=True)
class Vocabulary:
    """The words that are spoken.

    Attributes:
        plain: take the plain words.
        part: the plain word for a part, such as "ring".
    """

    plain: bool = False
    part: str = "part"


EXPERT = Vocabulary()
_spoken: ContextVar[Vocabulary] = ContextVar("vocabulary", default=EXPERT)


@contextmanager
def speaking(vocabulary: Vocabulary) -> Iterator[None]:
    """Speak a vocabulary within the block, on the thread that runs it."""
    token = _spoken.set(vocabulary)
    try:
        yield
    finally:
        _spoken.reset(token)


def spoken() -> Vocabulary:
    """Return the vocabulary that is spoken, for work that another thread does later."""
    return _spoken.get()


def plain() -> bool:
    """Return True while plain words are spoken."""
    return _spoken.get().plain


def say(term: str, number: int = 1) -> str:
    """Return the word for a term of the glossary in the vocabulary that is spoken, in the plural for any number but 1.

    Raises:
        KeyError: when the table lacks the term.
    """
    vocabulary, word = spoken(), WORDS[term]
    text = (vocabulary.part if term == "part" else word.plain) if vocabulary.plain else word.expert
    if number == 1:
        return text
    return f"{text[:-1]}ies" if text.endswith("y") else f"{text}s"


def column_name(name: str) -> str:
    """Return the name of a column of a table in the vocabulary that is spoken."""
    return _COLUMNS.get(name, name) if plain() else name


def unit() -> str:
    """Return the unit of a difference as it stands behind a figure, " (d²)"; plain words have none."""
    return "" if plain() else " (d²)"


def capitalised(text: str) -> str:
    """Return a text with a capital first letter; the others stay as they are."""
    return f"{text[:1].upper()}{text[1:]}"
