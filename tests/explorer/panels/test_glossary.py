from __future__ import annotations

import re

from explorer.panels import glossary
from explorer.web import terms


def test_the_glossary_has_the_terms_of_the_page_and_no_links() -> None:
    text = glossary.text(plain=False)
    assert all(f"| **{term}** |" in text for term in ("positive", "margin", "evidence", "workspace", "shard"))
    assert "](" not in text
    assert text.startswith("## ")


def test_in_plain_words_it_begins_with_the_few_words_of_the_plain_screens() -> None:
    whole = glossary.text(plain=True)
    first, rest = re.findall(r"^(## .+\n(?:(?!## ).*\n)*)", whole, re.MULTILINE)[:2]
    listed = re.findall(r"^\| \*\*([^*]+)\*\* \|", first, re.MULTILINE)
    assert first.startswith("## First words\n")
    assert 10 <= len(listed) <= 15
    assert {"model", "ring", "piece of the map", "by its look", "GPS tag", "radius", "lead"} <= set(listed)
    assert listed == list(dict.fromkeys(listed))
    assert set(listed) <= terms.meanings().keys()
    assert rest.startswith("## The task\n")
    expert = glossary.text(plain=False)
    assert expert.startswith("## The task\n")
    assert sorted(whole.split()) == sorted(expert.split())
