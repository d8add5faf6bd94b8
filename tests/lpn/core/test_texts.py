from __future__ import annotations

import pytest

from lpn.core.texts import listed


@pytest.mark.parametrize(
    ("words", "sentence"),
    [(["a"], "a"), (["a", "b"], "a or b"), (["a", "b", "c"], "a, b, or c"), ("abcd", "a, b, c, or d")],
)
def test_a_list_ends_with_its_conjunction(words: list[str], sentence: str) -> None:
    assert listed(words, "or") == sentence
    assert listed(words) == sentence.replace("or ", "and ")
