from __future__ import annotations

from explorer.panels import glossary


def test_the_glossary_has_the_terms_of_the_page_and_no_links() -> None:
    text = glossary.text()
    assert all(f"| **{term}** |" in text for term in ("positive", "margin", "evidence", "workspace", "shard"))
    assert "](" not in text
    assert text.startswith("## ")
