"""Tests of the two vocabularies."""

from __future__ import annotations

import re
import threading
from pathlib import Path

import pytest

from lpn.drawing import words
from lpn.drawing.words import WORDS, Vocabulary, speaking

GLOSSARY = Path(__file__).parents[3] / "docs" / "glossary.md"


def test_the_table_s_terms_and_plain_words_are_those_of_the_glossary() -> None:
    terms, _, plain = GLOSSARY.read_text("utf-8").partition("## Plain words")
    defined = set(re.findall(r"\*\*([^*]+)\*\*", terms))
    assert WORDS.keys() <= defined
    listed = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", plain, re.MULTILINE))
    assert listed.items() >= {(word.expert, word.plain) for word in WORDS.values() if word.plain != word.expert}
    assert len(listed) == 2 + sum(word.plain != word.expert for word in WORDS.values())


def test_a_vocabulary_is_spoken_within_its_block_and_on_its_thread() -> None:
    elsewhere = []
    with speaking(Vocabulary(plain=True, part="ring")):
        assert [words.say(term) for term in ("part", "margin", "R@1")] == ["ring", "lead", "right at once"]
        assert words.say("query", 3) == "pictures"
        thread = threading.Thread(target=lambda: elsewhere.append(words.say("part")))
        thread.start()
        thread.join()
    assert elsewhere == ["part"]
    assert [words.say("query", 3), words.say("margin"), words.unit()] == ["queries", "margin", " (d²)"]
    with pytest.raises(KeyError):
        words.say("no such term")
